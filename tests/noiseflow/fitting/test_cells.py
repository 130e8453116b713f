"""Cells of alike pixels."""

from __future__ import annotations

import pytest
import torch

from noiseflow.fitting.cells import count


@pytest.mark.parametrize(("span", "deviation"), [(10.0, 5.0), (100.0, 2.0), (400.0, 8.0)])
def test_counted_pixels_have_the_variance_of_the_noise(span: float, deviation: float) -> None:
    generator = torch.Generator().manual_seed(0)
    signal = span * torch.rand(50_000, generator=generator, dtype=torch.float64)
    observation = (signal + deviation * torch.randn(50_000, generator=generator, dtype=torch.float64)).round()
    cells = count(signal, observation)
    assert cells is not None
    assert cells.signal.numel() < 16_384
    variance = float((cells.weight * (cells.values - cells.signal) ** 2).sum())
    assert variance == pytest.approx(float((observation - signal).var()), rel=0.005)
    assert float(cells.weight.sum()) == pytest.approx(1)


@pytest.mark.slow
def test_more_pixels_than_single_precision_counts_are_counted() -> None:
    number = 2**24 + 4
    signal = torch.arange(number, dtype=torch.float32) % 3
    counted = count(signal, signal)
    assert counted is not None
    torch.testing.assert_close(counted.weight, torch.full((3,), 1 / 3))
