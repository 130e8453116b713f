"""Scaling of the data along the signal."""

from __future__ import annotations

import pytest
import torch

import noiseflow
from noiseflow.models.standardisation import Standardisation

PIXELS = 20_000


def scaled(deviation_at, location_at) -> tuple[Standardisation, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(PIXELS, generator=generator, dtype=torch.float64)
    deviation, location = deviation_at(signal), location_at(signal)
    scale = Standardisation().double()
    scale.smooths = True
    scale.set_from(
        signal, signal + location + deviation * torch.randn(PIXELS, generator=generator, dtype=torch.float64)
    )
    return scale, signal, location, deviation


def test_smooth_noise_is_measured_without_the_scatter_of_single_levels() -> None:
    scale, signal, location, deviation = scaled(lambda s: 0.1 + 0.2 * s, lambda s: 0.05 * s)
    found, log_scale = scale(scale.coordinate(signal))
    # a level has 1200 pixels: errors of 3.6 % of its median and 2.8 % of its scale
    assert float(((found - location) / deviation).square().mean().sqrt()) < 0.02
    assert float((log_scale - deviation.log()).square().mean().sqrt()) < 0.017


def test_a_noise_that_changes_at_once_is_followed() -> None:
    scale, signal, _, deviation = scaled(lambda s: torch.where(s < 0.5, 0.1, 0.3).double(), torch.zeros_like)
    away = (signal - 0.5).abs() > 0.2
    log_scale = scale(scale.coordinate(signal))[1]
    assert float((log_scale - deviation.log())[away].square().mean().sqrt()) < 0.1


def test_a_few_signal_levels_keep_their_own_scales() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.tensor([10.0, 100.0, 400.0, 1000.0], dtype=torch.float64).repeat_interleave(2000)
    deviation = signal.sqrt()
    scale = Standardisation().double()
    scale.smooths = True
    scale.set_from(signal, signal + deviation * torch.randn(signal.shape, generator=generator, dtype=torch.float64))
    log_scale = scale(scale.coordinate(signal))[1]
    assert float((log_scale - deviation.log()).abs().max()) < 0.1


def test_noise_of_five_hundred_pixels_is_measured_without_scatter() -> None:
    lost, generator = [], torch.Generator().manual_seed(3)
    for _ in range(4):
        signal = 0.2 + 0.8 * torch.rand(4500, generator=generator)
        law = torch.distributions.Normal(signal, 0.1 * (0.5 + signal))
        observation = signal + law.scale * torch.randn(signal.shape, generator=generator)
        found = noiseflow.fit(noiseflow.Mixture(2), signal[:500], observation[:500], generator=generator).noise_model
        lost.append(float((law.log_prob(observation) - found(signal).log_prob(observation))[500:].mean()))
    assert sum(lost) < 4 * 0.015  # 0.008 in the mean of eight; 0.032 with the width of every knot


@pytest.mark.parametrize(
    "model", [noiseflow.SignalDependentGaussian(), noiseflow.Mixture()], ids=["gaussian", "mixture"]
)
def test_noise_in_proportion_to_signals_of_six_decades_is_followed(model: noiseflow.NoiseModelBase) -> None:
    generator = torch.Generator().manual_seed(2)
    signal = 10 ** (6 * torch.rand(2, PIXELS, generator=generator) - 3)
    law = torch.distributions.Normal(signal, 0.2 * signal)
    observation = signal + law.scale * torch.randn(signal.shape, generator=generator)
    fitted = noiseflow.fit(model, signal[0], observation[0]).noise_model
    assert (law.log_prob(observation) - fitted(signal).log_prob(observation))[
        1
    ].mean() < 0.01  # 0.1 or more along two roots


def test_few_bright_pixels_do_not_bend_a_straight_variance() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.cat([100 * torch.rand(PIXELS, generator=generator) ** 2, torch.full((40,), 100.0)])
    noise = noiseflow.SignalDependentGaussian(straight=True)
    observation = signal + (4 + signal).sqrt() * torch.randn(len(signal), generator=generator)
    observation[PIXELS:] -= 30  # misfit of a peak that is too smooth
    noise.standardise(signal, observation)
    at = torch.tensor([0.0, 30.0, 60.0, 100.0])
    torch.testing.assert_close(noise(at).variance.detach(), 4 + at, rtol=0.15, atol=0.5)
    again = noiseflow.SignalDependentGaussian(**noise.config())
    again.load_state_dict(noise.state_dict())
    again.standardise(signal, observation)
    torch.testing.assert_close(again(at).variance, noise(at).variance)


def test_a_straight_variance_may_fall_or_stay() -> None:
    for low, high in ((9.0, 1.0), (4.0, 4.0)):
        signal = torch.rand(PIXELS, generator=torch.Generator().manual_seed(0))
        deviation = (low + (high - low) * signal).sqrt()
        noise = noiseflow.SignalDependentGaussian(straight=True)
        noise.standardise(signal, signal + deviation * torch.randn(PIXELS, generator=torch.Generator().manual_seed(1)))
        # the last level is half as wide as others, and its pixels are a quarter of its width away
        assert float((noise(signal).stddev / deviation - 1).abs().mean()) < 0.03


def mostly_weak(signals: int = 60_000) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Signals of which six tenths are below 0.2 % of the range, where the noise is narrowest; its width; observations."""
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(signals, generator=generator)
    signal[: 6 * signals // 10] *= 0.002
    deviation = 2e-5 + 0.2 * signal
    return signal, deviation, signal + deviation * torch.randn(signals, generator=generator)


@pytest.mark.parametrize("kind", [noiseflow.SignalDependentGaussian, noiseflow.SplineFlow])
def test_noise_that_grows_a_hundredfold_among_weak_signals_is_fitted(kind) -> None:
    signal, deviation, observation = mostly_weak()
    fitted = noiseflow.fit(kind(), signal, observation, generator=torch.Generator().manual_seed(1)).noise_model
    truth = torch.distributions.Normal(signal, deviation).log_prob(observation)
    with torch.no_grad():
        assert float((truth - fitted(signal).log_prob(observation)).mean()) < 0.01


def test_a_file_with_an_impossible_number_of_roots_is_refused_by_name(tmp_path) -> None:
    noise = noiseflow.SplineFlow()
    noise.standardisation.roots.fill_(1e9)  # so many square roots would never end
    noiseflow.save(noise, tmp_path / "noise.safetensors")
    with pytest.raises(ValueError, match=r"noise\.safetensors.*roots"):
        noiseflow.load(tmp_path / "noise.safetensors")
