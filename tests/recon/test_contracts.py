"""Every projector, field and regulariser keeps the contract of its kind."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from recon.fields.fields import Field
from recon.fields.kinds import network
from recon.fields.kinds.gaussians import GaussianField
from recon.fields.kinds.grids import MultiresolutionField, VoxelField
from recon.fields.kinds.network import CoordinateNetwork, PaperField
from recon.fields.occupancy import Occupancy
from recon.fields.regularisers import DirectionalVariation, Regulariser, SecondOrderVariation, TotalVariation
from recon.projection.base import Projector
from recon.projection.defocused_projector import DefocusedProjector, ImageDefocusedProjector
from recon.projection.projector import SliceProjector
from recon.projection.tiles import Tiles

pytestmark = pytest.mark.usefixtures("one_thread")

_ANGLES = np.array([-71.0, -20.0, 0.0, 33.0, 90.0])


def in_focus():
    return SliceProjector(tilt_angles=_ANGLES, depth=6, width=9, detector_width=11, dtype=torch.float64)


PROJECTORS = {
    "slices": in_focus,
    "defocused": lambda: DefocusedProjector(in_focus(), 0.2),
    "defocused in the image": lambda: ImageDefocusedProjector(in_focus(), 0.2),
}


class SumOfAttenuation(Regulariser):
    """The plainest there is: the sum of attenuation, which is not negative."""

    def __call__(self, volume, scale):
        return volume.sum()


FIELDS = {
    "voxels": VoxelField,
    "multiresolution": MultiresolutionField,
    "network": partial(CoordinateNetwork, width=16, layers=2),
    "network of the paper": partial(PaperField, width=8, layers=2, frequencies=3, skip=0),
    "gaussians": partial(GaussianField, count=40),
}
REGULARISERS = {
    "total variation": TotalVariation,
    "directional": DirectionalVariation,
    "second order": SecondOrderVariation,
    "sum": SumOfAttenuation,
}


@pytest.mark.parametrize("name", PROJECTORS)
def test_projector_contract(name):
    A = PROJECTORS[name]()
    generator = torch.Generator().manual_seed(0)
    volume = torch.rand(A.depth, 4, A.width, generator=generator, dtype=A.dtype)
    images = torch.rand(A.num_tilts, 4, A.detector_width, generator=generator, dtype=A.dtype)
    assert isinstance(A, Projector)
    assert A(volume).shape == images.shape
    assert float((A(volume) * images).sum()) == pytest.approx(float((volume * A.T(images)).sum()), rel=1e-10)
    torch.testing.assert_close(A(2 * volume + 1), 2 * A(volume) + A(torch.ones_like(volume)))
    volume.requires_grad_()
    (slope,) = torch.autograd.grad((A(volume) * images).sum(), volume)
    torch.testing.assert_close(slope, A.T(images))
    with pytest.raises(ValueError, match="attenuation"):
        A(volume[:, :, 1:])
    if A.has_parts:
        columns = torch.tensor([3, 17, 40])
        some = torch.zeros(A.depth * A.width, 4, dtype=A.dtype)
        some[columns] = torch.rand(3, 4, generator=generator, dtype=A.dtype)
        matrix, transposed = A.part(columns)
        torch.testing.assert_close(matrix @ some[columns], A.project(some))
        rays = torch.rand(A.num_tilts * A.detector_width, 4, generator=generator, dtype=A.dtype)
        torch.testing.assert_close(transposed @ rays, A.backproject(rays)[columns])
    else:
        with pytest.raises(ValueError, match="no parts"):
            A.part(torch.tensor([0]))


@pytest.mark.parametrize("name", FIELDS)
def test_field_contract(name):
    torch.manual_seed(0)
    field = FIELDS[name]((6, 8, 10), scale=0.3)
    assert isinstance(field, Field)
    assert (field.depth, field.height, field.width) == (6, 8, 10)
    rough = torch.zeros(3, 4, 5)
    rough[1:, 1:3, 2:4] = 0.3
    field.start_from(rough)
    units = field.units()
    assert units.shape == (6, 10, 8)
    assert bool((units >= 0).all())
    torch.testing.assert_close(field(), (units * field.scale).reshape(60, 8))
    torch.testing.assert_close(field.volume(), (units * field.scale).transpose(1, 2).detach())
    places = torch.tensor([0, 5, 479])
    torch.testing.assert_close(field.of_voxels(places), units.reshape(-1)[places])
    field().square().sum().backward()
    assert all(p.grad is not None and math.isfinite(float(p.grad.sum())) for p in field.parameters())
    tiles = some_tiles()
    torch.testing.assert_close(tiles.spread(field.on(tiles)), field.units() * tiles.mask)
    coarse = field.coarser()
    assert coarse is None or (coarse.depth, coarse.height, coarse.width) == (3, 4, 5)


def test_coarser_network_is_the_same_function():
    field = started("network", (8, 10, 12))
    coarse = field.coarser()
    assert coarse.network is field.network
    z, y, x = torch.meshgrid(*(2 * torch.arange(float(size)) + 0.5 for size in (4, 5, 6)), indexing="ij")
    between = field.at(torch.stack([z, y, x], -1).view(-1, 3)).detach()
    torch.testing.assert_close(coarse.volume().view(-1), 2 * between)


def test_a_network_in_parts_is_the_same_function(monkeypatch):
    field = started("network", (8, 10, 12))
    found = []
    for together in (2**17, 500):
        monkeypatch.setattr(network, "LONG", together)
        for cached in (2**12, 300):
            monkeypatch.setattr(network, "_CACHED", cached)
            field.zero_grad()
            values = field.units()
            values.square().sum().backward()
            found.append((values.detach(), *(parameter.grad for parameter in field.parameters())))
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], rtol=1e-4, atol=1e-4)


def started(name, shape=(6, 8, 10)):
    torch.manual_seed(0)
    field = FIELDS[name](shape, scale=0.3)
    rough = torch.zeros(3, 4, 5)
    rough[1:, 1:3, 2:4] = 0.3
    field.start_from(rough)
    return field


@pytest.mark.parametrize("name", FIELDS)
def test_field_has_values_between_voxels(name):
    field = started(name)
    z, y, x = torch.meshgrid(*(torch.arange(float(size)) for size in (6, 8, 10)), indexing="ij")
    points = torch.stack([z, y, x], -1).view(-1, 3)
    volume = field.volume()
    torch.testing.assert_close(field.at(points).view(6, 8, 10), volume, rtol=1e-4, atol=1e-5)
    field.voxel_size = 2.5
    torch.testing.assert_close(field.at(2.5 * points, unit="Å"), volume.view(-1), rtol=1e-4, atol=1e-5)
    found = field.at(points.numpy())
    assert isinstance(found, np.ndarray)
    between = field.at(points[:1] + torch.tensor([[2.3, 3.4, 4.6]]))
    near = volume[2:4, 3:5, 4:6]
    between.sum().backward()
    assert float(near.min()) - 0.05 <= between.item() <= float(near.max()) + 0.05
    field.flipped = (0, 2)
    torch.testing.assert_close(field.at(points).view(6, 8, 10), volume.flip(0, 2), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(field.volume(), volume.flip(0, 2))
    field.margin = 2
    inner = volume[:, :, 2:8].flip(0, 2)
    torch.testing.assert_close(field.volume(), inner)
    torch.testing.assert_close(
        field.at(points.view(6, 8, 10, 3)[:, :, :6].reshape(-1, 3)).view(6, 8, 6), inner, rtol=1e-4, atol=1e-5
    )
    torch.testing.assert_close(field.sampled(1.0), inner, rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="outside"):
        field.at(points[-1:])


@pytest.mark.parametrize("name", FIELDS)
def test_field_takes_points_only(name):
    field = started(name)
    for wrong, words in (
        (torch.tensor([0, 1, 2]), "coordinates"),
        (torch.zeros(4, 3, dtype=torch.long), "coordinates"),
        (torch.zeros(4, 2), "coordinates"),
        (torch.tensor([[0.0, 0.0, 9.6]]), "outside"),
        (torch.tensor([[0.0, 7.6, 0.0]]), "outside"),
        (torch.tensor([[0.0, math.nan, 0.0]]), "outside"),
    ):
        with pytest.raises(ValueError, match=words):
            field.at(wrong)
    with pytest.raises(ValueError, match="voxel size"):
        field.at(torch.zeros(1, 3), unit="Å")
    with pytest.raises(ValueError, match="unit"):
        field.at(torch.zeros(1, 3), unit="nm")


@pytest.mark.parametrize("name", FIELDS)
def test_field_keeps_its_vacuum_and_its_mass_on_other_grids(name):
    field = started(name)
    field.occupied = torch.zeros(6, 10, 8, dtype=torch.bool)
    field.occupied[2:, 4:, 2:6] = True
    volume = field.volume()
    assert not volume[:2].any()
    assert bool(volume.any())
    torch.testing.assert_close(field.sampled(1.0), volume, rtol=1e-4, atol=1e-5)
    fine, coarse = field.sampled(0.5), field.sampled(2.0)
    assert fine.shape == (12, 16, 20)
    assert coarse.shape == (3, 4, 5)
    # the sum of line integrals over pixels of equal size; a wrong power of the ratio would be a factor of two
    assert float(coarse.sum() * 4) == pytest.approx(float(volume.sum()), rel=0.25)
    assert float(fine.sum() / 4) == pytest.approx(float(volume.sum()), rel=0.25)
    with pytest.raises(ValueError, match="ratio"):
        field.sampled(0.0)


class Swapped(VoxelField):
    """Its author took the lattice for (z, y, x)."""

    def units(self):
        return super().units().transpose(1, 2)


def test_field_with_swapped_axes_is_refused():
    with pytest.raises(ValueError, match=r"Swapped.units\(\) is .*\(z, x, y\)"):
        Swapped((6, 8, 10))()
    rough = torch.zeros(3, 4, 4)
    rough[1:, 1:3, 2:4] = 0.3
    field = Swapped((6, 8, 8), scale=0.3)
    field.start_from(rough)
    with pytest.raises(ValueError, match="y and x swapped"):
        field.check_axes(rough)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("symmetric", [False, True])
def test_field_with_right_axes_passes_the_check(name, symmetric):
    rough = torch.zeros(3, 4, 4)
    rough[1:, 1:3, 1:3] = 0.3
    rough[0, 0, 3] = 0.0 if symmetric else 0.3
    field = FIELDS[name]((6, 8, 8), scale=0.3)
    field.start_from(rough)
    field.check_axes(rough)


def some_tiles():
    projector = SliceProjector(tilt_angles=_ANGLES, depth=6, width=10)
    rough = torch.zeros(6, 8, 10)
    rough[2:4, 3:5, 4:7] = 1.0
    return Tiles(Occupancy(rough, (6, 8, 10), margin=1).mask, projector)


@pytest.mark.parametrize("name", REGULARISERS)
def test_regulariser_contract(name):
    cost = REGULARISERS[name]()
    assert isinstance(cost, Regulariser)
    assert "(" in repr(cost)
    tiles = some_tiles()
    values = torch.rand(tiles.filled.numel(), generator=torch.Generator().manual_seed(0)) * tiles.filled
    values.requires_grad_()
    volume = tiles.spread(values)
    torch.testing.assert_close(cost(torch.zeros(3, 4, 5), 0.3), torch.zeros(()), atol=1e-6, rtol=0)
    torch.testing.assert_close(cost(5 * volume, 1.5), 5 * cost(volume, 0.3))
    (gradient,) = torch.autograd.grad(cost(volume, 0.3), values)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("kind", [Projector, Field, Regulariser])
def test_contracts_are_abstract_for_real(kind):
    with pytest.raises(TypeError, match="abstract"):
        kind((2, 2, 2)) if kind is Field else kind()
