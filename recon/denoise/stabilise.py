"""Variance stabilisation: transforms signal-dependent noise to unit standard deviation, with an exact unbiased inverse.

The generalised Anscombe transform (doi:10.1109/TIP.2012.2202675) stabilises a variance that is linear in the signal. The exact
unbiased inverse is the clean signal whose *expected* stabilised value is the given one; the algebraic inverse is biased.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

Array = NDArray[Any]
_LEVELS = 256
_QUANTILES = 512


@dataclass(frozen=True)
class Stabiliser:
    """An increasing map under which the noise has unit standard deviation, and its exact unbiased inverse, as tables.

    Attributes:
        pixel values, stabilised: (N,) the map of pixel values.
        signals, expected: (N,) the mean of the stabilised value at each clean signal, increasing.
    """

    readings: Array
    stabilised: Array
    signals: Array
    expected: Array

    def forward(self, image: Array) -> Array:
        """Stabilise pixel values of any shape, so that the noise has unit standard deviation."""
        return _extended(image, self.readings, self.stabilised)

    def inverse(self, image: Array) -> Array:
        """Convert denoised stabilised values to clean signals, detector units, within the range of the table."""
        return np.interp(image, self.expected, self.signals)


def of_noise_model(noise_model: nn.Module, images: Array) -> Stabiliser:
    """The stabiliser of a fitted noise model, for images in its units.

    The map is ∫ ds / σ(s) over the model's own standard deviation; for Poisson–Gaussian noise that is the generalised Anscombe
    transform. The inverse uses the model's quantiles, so that it accounts for skewness, rounding and clipping.

    Args:
        noise_model: called with signals, returns distributions with ``variance`` and ``icdf``.
        images: the noisy pixel values, any shape; they determine the range of signals.
    """
    low, high = (float(value) for value in np.quantile(images, (0.002, 0.998)))
    margin = 0.05 * (high - low)
    signals = torch.linspace(low - margin, high + margin, _LEVELS)
    with torch.no_grad():
        variance = noise_model(signals).variance.double().numpy()
        probabilities = ((torch.arange(_QUANTILES) + 0.5) / _QUANTILES)[:, None].expand(-1, _LEVELS)
        readings = noise_model(signals.expand(_QUANTILES, -1)).icdf(probabilities).double().numpy()
    deviation = np.sqrt(np.maximum(variance, 1e-4 * np.median(variance)))
    at = signals.double().numpy()
    stabilised = np.concatenate([[0.0], np.cumsum(np.diff(at) * (1 / deviation[1:] + 1 / deviation[:-1]) / 2)])
    expected = _extended(readings, at, stabilised).mean(0)
    return Stabiliser(at, stabilised, at, _increasing(expected))


def anscombe(gain: float, offset: float, read_noise: float, images: Array) -> Stabiliser:
    """The generalised Anscombe transform of pixel values gain·Poisson + N(offset, read_noise²). Raises ValueError if the gain
    is not positive.

    Args:
        gain: detector units per electron.
        read_noise: standard deviation at zero dose, detector units.
        images: the noisy pixel values, any shape; they determine the range of signals.
    """
    if not gain > 0:
        raise ValueError(f"gain {gain} must be positive")
    from scipy.stats import norm, poisson

    reach = float(np.quantile(images, 0.999)) - offset + 4 * gain
    rates = np.linspace(0, math.sqrt(max(reach / gain, 1.0)), _LEVELS) ** 2
    nodes = norm.ppf((np.arange(33) + 0.5) / 33)
    uniform = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    electrons = poisson.ppf(uniform[:, None], rates[None])
    readings = (gain * electrons + offset)[None] + (read_noise * nodes)[:, None, None]
    lowest, highest = float(readings.min()), max(float(readings.max()), float(images.max()))
    grid = np.linspace(lowest, highest, 16 * _LEVELS)
    inside = gain * (grid - offset) + 0.375 * gain**2 + read_noise**2
    map_of = 2 / gain * np.sqrt(np.maximum(inside, 0))
    expected = np.interp(readings, grid, map_of).mean((0, 1))
    return Stabiliser(grid, map_of, gain * rates + offset, _increasing(expected))


def estimated(images: Array) -> Stabiliser:
    """The stabiliser for noise whose variance, linear in the signal, is estimated from the images.

    The noise is estimated robustly from second differences along both axes, in groups of equal local mean.

    Args:
        images: (image, y, x).
    """
    slope, intercept = _variance_line(np.asarray(images, dtype=np.float64))
    low, high = float(images.min()), float(images.max())
    middle = intercept + slope * (low + high) / 2
    if slope * (high - low) < 0.05 * abs(middle):  # hardly signal-dependent: scaling alone stabilises
        deviation = math.sqrt(max(middle, 1e-12 * (high - low) ** 2))
        at = np.array([low, high])
        return Stabiliser(at, at / deviation, at, at / deviation)
    if intercept > 0:
        return anscombe(slope, 0.0, math.sqrt(intercept), images)
    return anscombe(slope, -intercept / slope, 0.0, images)


def _variance_line(images: Array) -> tuple[float, float]:
    mask = np.outer([1, -2, 1], [1, -2, 1]) / 6.0  # unit gain for white noise, zero for planes
    means, squares = [], []
    for image in images:
        windows = np.lib.stride_tricks.sliding_window_view(image, (3, 3))
        squares.append((np.einsum("ijkl,kl->ij", windows, mask) ** 2)[::2, ::2].ravel())
        means.append(windows.mean((2, 3))[::2, ::2].ravel())
    mean, square = np.concatenate(means), np.concatenate(squares)
    order = np.argsort(mean)
    groups = np.array_split(order, max(4, min(40, order.size // 500)))
    level = np.array([mean[group].mean() for group in groups])
    # the median of χ² with one degree of freedom
    variance = np.array([np.median(square[group]) / 0.4549 for group in groups])
    slope, intercept = np.polyfit(level, variance, 1, w=1 / np.maximum(variance, 1e-3 * variance.max()))
    return float(slope), float(intercept)


def _increasing(values: Array) -> Array:
    """Make values strictly increasing with the smallest change, so that an inverse exists where clipping makes them flat."""
    step = 1e-9 * max(float(np.ptp(values)), 1e-12)
    raised: Array = np.maximum.accumulate(values) + step * np.arange(values.size)
    return raised


def _extended(values: Array, at: Array, table: Array) -> Array:
    """Linear interpolation with linear extrapolation beyond both ends."""
    inside = np.interp(values, at, table)
    first = (table[1] - table[0]) / (at[1] - at[0])
    last = (table[-1] - table[-2]) / (at[-1] - at[-2])
    result: Array = inside + np.minimum(values - at[0], 0) * first + np.maximum(values - at[-1], 0) * last
    return result
