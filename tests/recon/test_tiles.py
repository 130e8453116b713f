"""The occupied part of a lattice is projected and regularised as the whole lattice with the rest empty."""

import pytest
import torch

from recon.projector import SliceProjector
from recon.regularisers import total_variation
from recon.tiles import Tiles

SHAPE = (9, 11, 37)  # z, x, y


@pytest.fixture(params=["sparse", "edges", "whole"])
def mask(request):
    generator = torch.Generator().manual_seed(0)
    chosen = torch.rand(SHAPE, generator=generator) > 0.98
    if request.param == "edges":
        chosen = torch.zeros(SHAPE, dtype=torch.bool)
        chosen[0, :, 3] = chosen[-1, 4] = chosen[2, -1, -1] = chosen[5, 0, 0] = True
    return torch.ones(SHAPE, dtype=torch.bool) if request.param == "whole" else chosen


def operators(mask):
    projector = SliceProjector(tilt_angles=[-50.0, 0.0, 35.0, 70.0], depth=9, width=11, dtype=torch.float64)
    tiles = Tiles(mask, projector)
    generator = torch.Generator().manual_seed(1)
    values = torch.zeros(tiles.places.numel(), dtype=torch.float64)
    values[tiles.occupied] = torch.rand(tiles.occupied.numel(), dtype=torch.float64, generator=generator)
    lattice = torch.zeros(mask.numel(), dtype=torch.float64)
    lattice[tiles.places] = values
    return projector, tiles, values.requires_grad_(), lattice.view(9 * 11, 37).requires_grad_()


def test_every_occupied_voxel_is_listed_once(mask):
    _, tiles, values, lattice = operators(mask)
    assert tiles.places.unique().numel() == tiles.places.numel()
    assert torch.equal(tiles.places[tiles.occupied].sort().values, mask.reshape(-1).nonzero()[:, 0])
    torch.testing.assert_close(tiles.lattice(values), lattice, rtol=0, atol=0)
    assert mask.float().mean() <= tiles.share <= 1


def test_line_integrals_and_their_gradient_are_those_of_the_whole(mask):
    projector, tiles, values, lattice = operators(mask)
    expected, found = projector.project(lattice), tiles.project(values)
    torch.testing.assert_close(found, expected)
    weights = torch.rand(expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (expected * weights).sum().backward()
    (found * weights).sum().backward()
    torch.testing.assert_close(values.grad, lattice.grad.view(-1)[tiles.places])


def test_total_variation_and_its_gradient_are_those_of_the_whole(mask):
    _, tiles, values, lattice = operators(mask)
    expected = total_variation(lattice.view(SHAPE), smoothing=0.02)
    found = tiles.total_variation(values, smoothing=0.02)
    torch.testing.assert_close(found, expected)
    expected.backward()
    found.backward()
    torch.testing.assert_close(values.grad, lattice.grad.view(-1)[tiles.places])


def test_nothing_occupied_projects_to_nothing():
    projector = SliceProjector(tilt_angles=[0.0, 40.0], depth=9, width=11)
    tiles = Tiles(torch.zeros(SHAPE, dtype=torch.bool), projector)
    assert tiles.share == 0
    assert not tiles.project(torch.zeros(0)).any()
    assert float(tiles.total_variation(torch.zeros(0), smoothing=0.1)) == 0
