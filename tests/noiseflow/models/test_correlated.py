"""Correlated noise: every pixel keeps its law, neighbours have the correlation of the kernel, and residuals show it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import signal as filters
from scipy import stats

import noiseflow
from noiseflow import Correlated, Digitised, Gaussian, Poisson
from noiseflow.metrics.spatial import correlation_kernel

KERNEL = torch.tensor([[0.1, 0.3, 0.1], [0.4, 1.0, 0.4], [0.1, 0.3, 0.1]])
SIGNAL = torch.full((4, 96, 96), 6.0)


def _correlations(images: torch.Tensor) -> np.ndarray:
    z = (images - images.mean()).double().numpy()
    found = sum(filters.fftconvolve(image, image[::-1, ::-1]) for image in z)
    middle = found.shape[0] // 2
    return found[middle - 2 : middle + 3, middle - 2 : middle + 3] / found[middle, middle]


@pytest.mark.parametrize("inner", [Gaussian(2.0), Poisson(), Digitised(Gaussian(2.0), 1.0, low=4.0)])
def test_samples_have_the_law_of_the_inner_model_and_the_correlation_of_the_kernel(
    inner: noiseflow.NoiseModelBase,
) -> None:
    drawn = Correlated(inner, KERNEL)(SIGNAL).sample(generator=torch.Generator().manual_seed(0))
    apart = drawn[:, ::4, ::4].reshape(-1)  # pixels that do not depend on each other
    alone = inner(SIGNAL).sample(generator=torch.Generator().manual_seed(1)).reshape(-1)
    assert stats.ks_2samp(apart.numpy(), alone.numpy()).pvalue > 0.01
    expected = filters.convolve2d(KERNEL, KERNEL)
    # discrete laws and clipping lower the correlation of the quantiles a little
    tolerance = 0.02 if isinstance(inner, Gaussian) else 0.08
    np.testing.assert_allclose(_correlations(drawn), expected / expected[2, 2], atol=tolerance)


def test_the_kernel_is_found_in_residuals_and_white_noise_has_none() -> None:
    model, generator = Poisson(), torch.Generator().manual_seed(2)
    signal = torch.linspace(20, 80, SIGNAL.numel()).reshape(SIGNAL.shape)
    kernel = correlation_kernel(model, signal, Correlated(model, KERNEL)(signal).sample(generator=generator))
    again = filters.convolve2d(kernel, kernel)
    expected = filters.convolve2d(KERNEL, KERNEL)
    np.testing.assert_allclose(again[2:7, 2:7], expected / expected[2, 2], atol=0.03)
    narrow = correlation_kernel(model, signal[..., :2, :], model(signal[..., :2, :]).sample(generator=generator))
    assert torch.isfinite(narrow).all()  # lags that no pair of pixels has
    white = correlation_kernel(model, signal, model(signal).sample(generator=generator))
    assert Correlated(model, white).effective_share == pytest.approx(1, abs=0.1)


def test_a_flow_of_neighbouring_signals_has_independent_noise_until_it_is_correlated() -> None:
    flow, generator = noiseflow.SplineFlow(neighbourhood=3), torch.Generator().manual_seed(5)
    signal = torch.rand(96, 96, generator=generator)
    kernel = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.4], [0.0, 0.0, 0.0]])
    for model, expected in ((flow, 0.0), (Correlated(flow, kernel), 0.4 / 1.16)):
        first, second = (model(signal).sample(generator=generator) for _ in range(2))
        z = (first - second) / (first - second).std()
        assert float((z[:, 1:] * z[:, :-1]).mean()) == pytest.approx(expected, abs=0.05)
        assert float((z[1:] * z[:-1]).mean()) == pytest.approx(0, abs=0.05)
    assert Correlated(flow, kernel)(signal).sample((2,)).shape == (2, 96, 96)


def test_the_effective_share_is_that_of_the_mean_of_an_image() -> None:
    model = Correlated(Gaussian(), torch.ones(3, 3))
    drawn = model(torch.zeros(200, 60, 60)).sample(generator=torch.Generator().manual_seed(3))
    assert model.effective_share == pytest.approx(1 / 9)
    assert float(drawn.mean((1, 2)).var()) == pytest.approx(float(drawn.var()) * 9 / 3600, rel=0.25)


def test_what_cannot_be_correlated_is_refused() -> None:
    with pytest.raises(ValueError, match="odd"):
        Correlated(Gaussian(), torch.ones(2, 3))
    with pytest.raises(ValueError, match="zero"):
        Correlated(Gaussian(), torch.zeros(3, 3))
    with pytest.raises(ValueError, match="offset"):
        Correlated(noiseflow.ScanNoise(Gaussian()))
    with pytest.raises(ValueError, match="images"):
        Correlated(Gaussian(), KERNEL)(torch.zeros(9)).sample()
