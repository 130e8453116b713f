"""Fourier shells against a slow sum, frequency by frequency."""

import itertools

import numpy as np
import pytest

from recon.metrics.metrics import fourier_shell_correlation


@pytest.mark.parametrize("shape", [(8, 8, 8), (7, 9, 7), (11, 6)])
def test_every_frequency_is_in_its_nearest_shell(shape):
    first, second = np.random.default_rng(0).normal(size=(2, *shape))
    second += first
    shells = min(shape) // 2
    cross, one, other = np.zeros((3, shells + 1))
    f, g = np.fft.fftn(first), np.fft.fftn(second)
    for index in itertools.product(*map(range, shape)):
        cycles = [(i if i < (n + 1) // 2 else i - n) / n for i, n in zip(index, shape, strict=True)]
        length = sum(c * c for c in cycles) ** 0.5
        nearest = min(range(4 * shells), key=lambda shell: abs(length - shell / (2 * shells)))
        if nearest <= shells:
            cross[nearest] += (f[index] * np.conj(g[index])).real
            one[nearest] += abs(f[index]) ** 2
            other[nearest] += abs(g[index]) ** 2
    frequency, correlation = fourier_shell_correlation(first, second)
    np.testing.assert_allclose(frequency, np.arange(shells + 1) / (2 * shells))
    np.testing.assert_allclose(correlation, cross / np.sqrt(one * other), atol=1e-12)
