"""The likelihood table beyond its rows, and its promise of accuracy."""

from __future__ import annotations

import pytest
import torch

import noiseflow
from noiseflow.fitting.observation_table import ObservationTable


@pytest.fixture(scope="module")
def table() -> tuple[torch.nn.Module, torch.Tensor, ObservationTable]:
    model = noiseflow.Gaussian(0.1)
    signal = torch.rand(4000, generator=torch.Generator().manual_seed(0))
    noisy = signal + 0.1 * torch.randn(4000, generator=torch.Generator().manual_seed(1))
    return model, noisy, ObservationTable(model, noisy, 0.0, 1.0)


def exact(model: torch.nn.Module, signal: torch.Tensor, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    signal = signal.clone().requires_grad_()
    value = model(signal).log_prob(observation)
    (slope,) = torch.autograd.grad(value.sum(), signal)
    return value.detach(), slope


@pytest.mark.parametrize(("edge", "beyond"), [(1.0, 0.3), (0.0, -0.2)])
def test_beyond_its_rows_the_likelihood_goes_on_along_its_slope(table, edge: float, beyond: float) -> None:
    model, observation, found = table
    near = (observation - edge).abs() < 0.3
    value, slope = exact(model, torch.full_like(observation, edge), observation)
    outside = found.log_prob(torch.full_like(observation, edge + beyond))
    expected = value + beyond * slope
    scale = float((beyond * slope)[near].abs().mean())
    assert float((outside - expected)[near].abs().mean()) < 0.05 * scale
    steep = found.slope(torch.full_like(observation, edge + beyond))
    assert float((steep - slope)[near].abs().mean()) < 0.05 * float(slope[near].abs().mean())


def test_within_its_rows_value_and_slope_are_those_of_the_model(table) -> None:
    model, observation, found = table
    signal = (observation + 0.05).clamp(0.02, 0.98)
    value, slope = exact(model, signal, observation)
    assert found.error <= 1e-3
    assert float((found.log_prob(signal) - value).abs().mean()) < 2e-3
    assert float((found.slope(signal) - slope).abs().mean()) < 0.02 * float(slope.abs().mean())
