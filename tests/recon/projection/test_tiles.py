"""The occupied part of a lattice is projected and regularised as the whole lattice with the rest empty."""

import pytest
import torch

from recon.fields.fields import Field
from recon.fields.kinds.grids import MultiresolutionField, VoxelField, upsample
from recon.fields.regularisers import total_variation
from recon.projection.projector import SliceProjector
from recon.projection.tiles import Tiles

SHAPE = (9, 11, 37)  # z, x, y


@pytest.fixture(params=["sparse", "edges", "whole"])
def mask(request):
    generator = torch.Generator().manual_seed(0)
    chosen = torch.rand(SHAPE, generator=generator) > 0.98
    if request.param == "edges":
        chosen = torch.zeros(SHAPE, dtype=torch.bool)
        chosen[0, :, 3] = chosen[-1, 4] = chosen[2, -1, -1] = chosen[5, 0, 0] = True
        chosen[6, 8, 16] = chosen[3, 3, 32] = True  # alone in the first slice of a tile
    return torch.ones(SHAPE, dtype=torch.bool) if request.param == "whole" else chosen


def operators(mask):
    projector = SliceProjector(tilt_angles=[-50.0, 0.0, 35.0, 70.0], depth=9, width=11, dtype=torch.float64)
    tiles = Tiles(mask, projector)
    generator = torch.Generator().manual_seed(1)
    values = torch.zeros(tiles.filled.numel(), dtype=torch.float64)
    values[tiles.occupied] = torch.rand(tiles.occupied.numel(), dtype=torch.float64, generator=generator)
    lattice = torch.zeros(mask.numel(), dtype=torch.float64)
    lattice[tiles.voxels] = values[tiles.occupied]
    return projector, tiles, values.requires_grad_(), lattice.view(9 * 11, 37).requires_grad_()


def test_every_occupied_voxel_is_listed_once(mask):
    _, tiles, values, lattice = operators(mask)
    assert torch.equal(tiles.voxels.sort().values, mask.reshape(-1).nonzero()[:, 0])
    torch.testing.assert_close(tiles.lattice(values), lattice, rtol=0, atol=0)
    assert mask.sum() <= tiles.filled.numel() <= mask.numel()


def test_line_integrals_and_their_gradient_are_those_of_the_whole(mask):
    projector, tiles, values, lattice = operators(mask)
    expected, found = projector.project(lattice), tiles.project(values)
    torch.testing.assert_close(found, expected)
    weights = torch.rand(expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (expected * weights).sum().backward()
    (found * weights).sum().backward()
    torch.testing.assert_close(values.grad, tiles.gathered(lattice.grad.view(SHAPE)))


def test_total_variation_and_its_gradient_are_those_of_the_whole(mask):
    _, tiles, values, lattice = operators(mask)
    expected = total_variation(lattice.view(SHAPE), smoothing=0.02)
    found = total_variation(tiles.spread(values), smoothing=0.02)
    torch.testing.assert_close(found, expected)
    expected.backward()
    found.backward()
    torch.testing.assert_close(values.grad, tiles.gathered(lattice.grad.view(SHAPE)))


def test_a_coarse_grid_is_interpolated_to_the_list(mask):
    _, tiles, _, _ = operators(mask)
    generator = torch.Generator().manual_seed(3)
    grid = torch.rand(5, 6, 19, dtype=torch.float64, generator=generator, requires_grad=True)
    found, expected = tiles.upsampled(grid), tiles.gathered(upsample(grid, SHAPE))
    torch.testing.assert_close(found, expected)
    weights = torch.rand(found.shape, dtype=torch.float64, generator=generator)
    gradients = [torch.autograd.grad((values * weights).sum(), grid) for values in (found, expected)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("make_field", [MultiresolutionField, VoxelField])
def test_field_and_its_gradient_on_tiles_are_those_of_the_whole(mask, make_field):
    _, tiles, _, _ = operators(mask)
    field, generator = make_field((9, 37, 11)).double(), torch.Generator().manual_seed(4)
    for values in field.parameters():
        torch.nn.init.normal_(values, generator=generator)
    weights = torch.rand(tiles.filled.numel(), dtype=torch.float64, generator=generator)
    found, gradients = [], []
    for values in (field.on(tiles), Field.on(field, tiles)):
        found.append(values)
        gradients.append(torch.autograd.grad((values * weights).sum(), list(field.parameters())))
    torch.testing.assert_close(*found)
    torch.testing.assert_close(*gradients)


def test_what_is_the_same_is_taken_over_from_other_tiles(mask):
    projector, before, _, _ = operators(mask)
    wider = mask.clone()
    wider[4, 4, 20] = True
    kept = next(iter(before)).matrix
    tiles, expected = Tiles(wider, projector, known=before), Tiles(wider, projector)
    assert next(iter(tiles)).matrix is kept
    with pytest.raises(AttributeError):  # their matrices are gone
        before.project(torch.zeros(before.filled.numel(), dtype=torch.float64))
    values = torch.rand(expected.filled.numel(), dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(tiles.project(values), expected.project(values), rtol=0, atol=0)


def test_parts_of_a_projector_need_one_of_its_two_matrices(mask):
    projector = SliceProjector(tilt_angles=[0.0, 40.0], depth=SHAPE[0], width=SHAPE[1])
    tiles = Tiles(mask, projector)
    rays = tiles.project(torch.ones(tiles.filled.numel()))
    projector.backproject(rays)
    assert "matrix" not in vars(projector)
    assert projector.project(torch.ones(SHAPE[0] * SHAPE[1], 1)).shape[0] == rays.shape[0]
    assert "matrix" in vars(projector)


def test_nothing_occupied_projects_to_nothing():
    projector = SliceProjector(tilt_angles=[0.0, 40.0], depth=9, width=11)
    tiles = Tiles(torch.zeros(SHAPE, dtype=torch.bool), projector)
    assert tiles.filled.numel() == 0
    assert not tiles.project(torch.zeros(0)).any()
    assert not tiles.spread(torch.zeros(0)).any()
