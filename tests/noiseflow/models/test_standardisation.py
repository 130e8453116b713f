"""Scaling of the data along the signal."""

from __future__ import annotations

import torch

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
