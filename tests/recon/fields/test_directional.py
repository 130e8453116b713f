"""The directional regulariser is its formula, layer by layer; it leaves flat noise to total variation and faces their jump."""

import math

import pytest
import torch

from recon.fields.regularisers import DirectionalVariation, TotalVariation, base, find_regulariser
from recon.projection.projector import SliceProjector
from recon.projection.tiles import Tiles


def by_formula(volume, discount, certain, smoothing):
    """Every term written out."""

    def slopes(array):
        steps = [torch.diff(array, dim=axis, append=array.narrow(axis, -1, 1)) for axis in range(3)]
        return torch.stack(steps)

    def means(array):
        kernel = torch.ones(1, 1, 3, 3, 3, dtype=array.dtype)
        sums, counts = (
            torch.conv3d(each[None, None], kernel, padding=1)[0, 0] for each in (array, torch.ones_like(array))
        )
        return sums / counts

    slope, step = slopes(volume), slopes(means(volume))
    normal = step / ((step**2).sum(0) + certain**2).sqrt()
    squared = (slope**2).sum(0) - discount * (slope * normal).sum(0) ** 2
    return ((squared + smoothing**2).sqrt() - smoothing).sum()


@pytest.fixture(params=[1, 3, 8], autouse=True)
def layers(request, monkeypatch):
    """How many are computed at a time."""
    monkeypatch.setattr(base, "_FEWEST", request.param)
    monkeypatch.setattr(base, "LONG", 1)


@pytest.mark.parametrize("depth", [1, 2, 9, 18])
def test_value_and_gradient_are_those_of_the_formula(depth):
    generator = torch.Generator().manual_seed(0)
    volume = torch.rand(depth, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    found, expected = DirectionalVariation(0.7, 0.2, 0.1)(volume, 2.0), by_formula(volume, 0.7, 0.4, 0.2)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    here, there = (torch.autograd.grad(value, volume)[0] for value in (found, expected))
    torch.testing.assert_close(here, there, rtol=1e-9, atol=1e-9)


def some_mask(shape, seed):
    """A few random boxes, some at the edges, with vacuum between."""
    generator, mask = torch.Generator().manual_seed(seed), torch.zeros(shape, dtype=torch.bool)
    for _ in range(3):
        starts = [int(torch.randint(0, size, (), generator=generator)) for size in shape]
        z, x, y = (slice(start, start + 1 + seed % 5) for start in starts)
        mask[z, x, y] = True
    return mask & (torch.rand(shape, generator=generator) < 0.8)


@pytest.mark.parametrize("seed", range(24))
def test_the_occupied_part_costs_what_the_whole_volume_does(seed):
    shape = (19, 13, 37)
    mask = some_mask(shape, seed)
    projector = SliceProjector(tilt_angles=[0.0, 30.0], depth=shape[0], width=shape[1], dtype=torch.float64)
    tiles = Tiles(mask, projector)
    assert len(list(tiles)) > 1
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(tiles.filled.numel(), generator=generator, dtype=torch.float64) * tiles.filled
    values.requires_grad_()
    found = DirectionalVariation(0.7, 0.2, 0.1)(tiles.spread(values), 2.0)
    volume = tiles.spread(values.detach()).requires_grad_()
    expected = by_formula(volume, 0.7, 0.4, 0.2)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    (here,), (there,) = torch.autograd.grad(found, values), torch.autograd.grad(expected, volume)
    torch.testing.assert_close(here, tiles.gathered(there), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 1, 2), (2, 2, 1), (9, 9, 11)])
@pytest.mark.parametrize("seed", range(4))
def test_empty_voxels_beside_occupied_ones_have_the_gradient_of_the_formula(shape, seed):
    mask = some_mask(shape, seed)
    volume = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * mask
    volume.requires_grad_()
    found, expected = DirectionalVariation(0.7, 0.2, 0.1)(volume, 2.0), by_formula(volume, 0.7, 0.4, 0.2)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    here, there = (torch.autograd.grad(value, volume)[0] for value in (found, expected))
    torch.testing.assert_close(here, there, rtol=1e-10, atol=1e-10)


def test_a_flat_step_costs_a_share_of_its_jump():
    volume = torch.zeros(12, 6, 6, dtype=torch.float64)
    volume[6:] = 3.0
    cost = float(DirectionalVariation(0.75, certain=1e-6, smoothing=1e-6)(volume, 1.0))
    assert cost == pytest.approx(math.sqrt(1 - 0.75) * 3.0 * 36, rel=1e-4)


def test_without_a_discount_it_is_total_variation():
    volume = torch.rand(9, 5, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(DirectionalVariation(0.0)(volume, 0.7), TotalVariation()(volume, 0.7))


def test_it_has_a_name_and_refuses_settings_without_meaning():
    assert isinstance(find_regulariser("directional"), DirectionalVariation)
    with pytest.raises(ValueError, match="discount"):
        DirectionalVariation(discount=1)
    with pytest.raises(ValueError, match="certain"):
        DirectionalVariation(certain=0)
