"""Noise of phases is found, its density integrates to one over the period, and other noise has no period."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import noiseflow
from noiseflow.models.wrapped import wrapping
from tests.contracts import check_distribution, check_fixed_part, check_noise_model

SIGNALS = torch.tensor([-3.1, -1.5, 0.2, 2.9], dtype=torch.float64)
COUNT = 20_000


def pixels(width: float = 0.3, low: float = -math.pi, high: float = math.pi) -> tuple[torch.Tensor, torch.Tensor]:
    """Phases, even between two ends, and phases with normal noise."""
    generator = torch.Generator().manual_seed(0)
    signal = low + (high - low) * torch.rand(COUNT, generator=generator)
    return signal, turned(signal + width * torch.randn(COUNT, generator=generator))


def turned(value: torch.Tensor) -> torch.Tensor:
    return torch.remainder(value + math.pi, 2 * math.pi) - math.pi


@pytest.mark.parametrize("width", [0.1, 0.5, 2.0])
def test_wrapped_noise_keeps_the_contract_and_integrates_to_one(width: float) -> None:
    model = noiseflow.Wrapped(noiseflow.Gaussian(width)).double()
    unwrapped = model(SIGNALS + 2 * math.pi * torch.tensor([-7.0, 1.0, 4.0, 90.0], dtype=torch.float64))
    assert_close(unwrapped.log_prob(SIGNALS.flip(0)), model(SIGNALS).log_prob(SIGNALS.flip(0)))
    assert_close(unwrapped.cdf(SIGNALS.flip(0)), model(SIGNALS).cdf(SIGNALS.flip(0)))
    check_noise_model(model, SIGNALS)
    check_distribution(model(SIGNALS))
    check_fixed_part(model, SIGNALS, model(SIGNALS).sample(generator=torch.Generator().manual_seed(1)))
    value = torch.linspace(-math.pi, math.pi, 4001, dtype=torch.float64)[:, None].expand(-1, 4)
    with torch.no_grad():
        density = model(SIGNALS).log_prob(value).exp()
        assert torch.allclose(torch.trapezoid(density, value, dim=0), torch.ones(4).double(), atol=1e-6)
        total = torch.cumulative_trapezoid(density, value, dim=0)
        assert torch.allclose(model(SIGNALS).cdf(value[1:]), total, atol=1e-5)
        # the two ends are one place, whether it is written as −π or π
        assert torch.allclose(density[0], density[-1], atol=1e-6)


@pytest.mark.parametrize("width", [0.003, 0.01, 0.1, 0.7, 2.0])
def test_moments_of_wrapped_noise_are_those_of_a_fine_sum_at_the_ends_of_the_period_too(width: float) -> None:
    signals = torch.tensor([3.13, math.pi - 4 * width, -math.pi, 0.0], dtype=torch.float64)
    latent = torch.linspace(-9, 9, 1_000_001, dtype=torch.float64)
    mass = torch.exp(-(latent**2) / 2)
    law = noiseflow.Wrapped(noiseflow.Gaussian(width).double())(signals)
    for pixel, signal in enumerate(signals):
        value = turned(signal + width * latent)
        mean = (mass * value).sum() / mass.sum()
        variance = (mass * (value - mean) ** 2).sum() / mass.sum()
        assert_close(law.mean[pixel], mean, rtol=0, atol=1e-5 * math.pi)
        assert_close(law.variance[pixel], variance, rtol=1e-3, atol=0)


def test_phases_have_a_period_whatever_part_of_it_the_signals_cover_and_however_wide_the_noise_is() -> None:
    for width in (0.01, 0.3, 1.0):
        start, period = wrapping(*pixels(width))
        assert start == pytest.approx(-math.pi, abs=0.01)
        assert period == pytest.approx(2 * math.pi, abs=0.01)
    assert wrapping(*pixels(0.3, 1.0, math.pi)) is not None
    orientation, noisy = (each * 90 / math.pi + 90 for each in pixels(0.5))
    assert wrapping(orientation, noisy)[1] == pytest.approx(180, abs=0.5)
    signal, seen = (each * 128 / math.pi + 128 for each in pixels(0.3))
    assert wrapping(signal, seen.floor(), 1.0) == (-0.5, 256.0)


def test_other_noise_has_no_period() -> None:
    signal, _ = pixels()
    generator = torch.Generator().manual_seed(1)
    even = torch.rand(COUNT, generator=generator)
    normal = torch.randn(COUNT, generator=generator)
    others = {
        "normal": signal + 0.3 * normal,
        "clipped": (signal + 0.3 * normal).clamp(-3, 3),
        "even, whatever the signal": even,
        "impulses": torch.where(even < 0.1, 10 * (2 * torch.rand(COUNT, generator=generator) - 1), signal),
        "within limits": signal * (1 - 0.2 * even),
    }
    assert [name for name, seen in others.items() if wrapping(signal, seen) is not None] == []
    assert wrapping(even**3, torch.rand(COUNT, generator=generator)) is None


@pytest.mark.parametrize("levels", [0, 256])
def test_noise_of_phases_is_described_as_well_as_before_wrapping(levels: int) -> None:
    signal, seen = pixels()
    expected = 0.5 * math.log(2 * math.pi * math.e * 0.3**2)
    if levels:
        signal, seen = ((each + math.pi) * levels / (2 * math.pi) for each in (signal, seen))
        seen, expected = seen.floor(), expected + math.log(levels / (2 * math.pi))
    candidates = None
    selection = noiseflow.select(signal, seen, candidates=candidates)
    assert isinstance(selection.chosen.model.one_pixel, noiseflow.NoiseModelBase)
    assert "Wrapped" in repr(selection.chosen.model)
    # four standard errors of 4000 validation pixels
    assert selection.chosen.nll == pytest.approx(expected, abs=4 * math.sqrt(0.5 / 4000))


def test_wrapped_noise_is_saved_and_refuses_discrete_models_and_periods_that_are_none(tmp_path) -> None:
    signal, seen = pixels()
    fitted = noiseflow.fit(noiseflow.Wrapped(noiseflow.SignalDependentGaussian()), signal, seen).noise_model
    again = noiseflow.load(noiseflow.save(fitted, tmp_path / "wrapped.safetensors"))
    assert torch.equal(again(signal).log_prob(seen), fitted(signal).log_prob(seen))
    assert float(fitted(torch.tensor(0.0)).stddev) == pytest.approx(0.3, rel=0.05)
    with pytest.raises(ValueError, match="around Wrapped"):
        noiseflow.Wrapped(noiseflow.Poisson())
    with pytest.raises(ValueError, match="period is 0"):
        noiseflow.Wrapped(noiseflow.Gaussian(), 0.0, 0.0)
