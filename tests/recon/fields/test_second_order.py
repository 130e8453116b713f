"""The second-order regulariser is its formula, layer by layer, and finds its names."""

import math

import pytest
import torch

from recon.fields.regularisers import SecondOrderVariation, base, find_regulariser, regulariser_names


def by_formula(volume, curvature, smoothing):
    """Every term written out."""

    def forward(array, axis):
        ends = array.narrow(axis, array.shape[axis] - 1, 1)
        return torch.diff(array, dim=axis, append=ends)

    slopes = [forward(volume, axis) for axis in range(3)]
    squared = sum(slope**2 for slope in slopes)
    for first in range(3):
        back = torch.diff(slopes[first], dim=first, prepend=torch.zeros_like(volume.narrow(first, 0, 1)))
        squared = squared + curvature * back**2
        for second in range(first + 1, 3):
            squared = squared + 2 * curvature * forward(slopes[first], second) ** 2
    total = (torch.sqrt(squared + smoothing**2) - smoothing).sum()
    return total / (math.sqrt(1 + curvature) + math.sqrt(curvature))


@pytest.mark.parametrize("depth", [1, 2, 8, 17])
def test_value_and_gradient_are_those_of_the_formula(depth, monkeypatch):
    monkeypatch.setattr(base, "LONG", 1)
    generator = torch.Generator().manual_seed(0)
    volume = torch.rand(depth, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    found, expected = SecondOrderVariation(0.7, 0.1)(volume, 2.0), by_formula(volume, 0.7, 0.2)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    here, there = (torch.autograd.grad(value, volume)[0] for value in (found, expected))
    torch.testing.assert_close(here, there, rtol=1e-9, atol=1e-9)


def test_a_flat_step_costs_its_jump():
    volume = torch.zeros(12, 6, 6, dtype=torch.float64)
    volume[6:] = 3.0
    assert float(SecondOrderVariation(smoothing=1e-6)(volume, 1.0)) == pytest.approx(3.0 * 36, rel=1e-4)


def test_names_lead_to_regularisers():
    assert regulariser_names()[:3] == ["directional", "second-order", "total-variation"]
    assert isinstance(find_regulariser("second-order"), SecondOrderVariation)
    with pytest.raises(ValueError, match="choose one of"):
        find_regulariser("third-order")
    with pytest.raises(ValueError, match="smoothing"):
        SecondOrderVariation(smoothing=0)
