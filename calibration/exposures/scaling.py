"""One scale for two exposures that are both noisy: slope, intercept and the long one's own noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.exposures.frames import Image
from noiseflow.described import described

Mask = NDArray[np.bool_]

CUT = 4.0
"""Standard deviations at which a residual is cut before its level's spread is taken: noise hardly reaches them; one outlier in a
hundred then adds 7 % to the deviation."""

BLOCK = 8
"""Side, pixels, of blocks whose sums are independent: the filter of the finest band and an interpolation reach 3 pixels."""


@described(intercept="counts", intercept_error="counts", level_error="counts")
@dataclass(frozen=True)
class Scaling:
    """signal = slope·long + intercept, in the short exposure's units.

    Attributes:
        slope: counts of the short exposure per unit of the long one; its inverse estimates the exposure ratio where
            both come from one detector setting.
        intercept: counts.
        slope_error: standard error of the slope.
        intercept_error: standard error of the intercept.
        centre: long reading at which slope and signal err independently.
        level_error: standard error of the signal there.
    """

    slope: float
    intercept: float
    slope_error: float
    intercept_error: float
    centre: float = 0.0
    level_error: float = 0.0

    def common_offset(self) -> tuple[float, float]:
        """Offset of both exposures, counts, and its standard error, if one detector setting took them: intercept/(1 − slope)."""
        offset = self.intercept / (1 - self.slope)
        lever = (offset - self.centre) / (1 - self.slope)
        return offset, float(np.hypot(self.level_error / (1 - self.slope), lever * self.slope_error))


@described(floor="counts²", rate="counts", rate_error="counts")
@dataclass(frozen=True)
class VarianceLine:
    """A variance that grows linearly with the signal, as shot noise with read noise does: floor + rate·signal,
    counts². `rate_error` is the standard error of the rate; 0 where it was not estimated."""

    floor: float
    rate: float
    rate_error: float = 0.0

    def __call__(self, signal: Image) -> Image:
        """Variance at each signal, never negative."""
        return np.maximum(self.floor + self.rate * signal, 0.0)


def fit_scaling(short: Image, long: Image, mask: Mask, *, num_iterations: int = 4) -> Scaling:
    """Scale and offset between registered exposures by instrumental variables, robust against outliers.

    Least squares of the short on the long exposure would be too flat, because the long one is noisy itself. The
    neighbours of each pixel in the short frame know its signal but neither pixel's noise, so they serve as the
    instrument (doi:10.1257/jep.15.4.69). Levels are weighted by their inverse variance, residuals above six of its
    roots left out.

    Args:
        short: (y, x) counts.
        long: (y, x) registered on it.
        mask: (y, x) pixels to use.
        num_iterations: rounds of weighting.

    Raises:
        ValueError: the two do not correlate, so that no scale exists.
    """
    instrument = ring_mean(short, mask, inner=0, blur=1.5)[mask]
    x, y = long[mask], short[mask]
    weight = np.ones_like(y)
    for _ in range(num_iterations):
        total = weight.sum()
        z = instrument - (weight @ instrument) / total
        covariance = weight * z @ x
        slope = (weight * z @ y) / covariance
        intercept = weight @ (y - slope * x) / total
        residual = y - slope * x - intercept
        spread = spread_by_level(instrument, residual)
        weight = (np.abs(residual) < 6 * spread) / spread**2
    error = np.sqrt(np.sum((weight * z * residual) ** 2)) / abs(covariance)
    if not np.isfinite(slope) or abs(slope) < 5 * error:
        raise ValueError(
            "the two exposures do not rise and fall together once registered; check that they show the same scene"
        )
    middle, own = float(weight @ x / total), float(1 / np.sqrt(total))
    intercept_error = float(np.hypot(own, error * middle))
    return Scaling(float(slope), float(intercept), float(error), intercept_error, middle, own)


def own_variance(
    short: Image, long: Image, mask: Mask, scaling: Scaling, warp: Callable[[Image], Image]
) -> VarianceLine:
    """The noise variance of the signal estimate itself, as a line in the signal, counts².

    The finest band of the long frame, before any interpolation, holds its noise and what detail the scene has there.
    That detail is common to both exposures, so their covariance in this band takes it out.

    Args:
        short: (y, x) counts.
        long: (y, x) as recorded.
        mask: (y, x) pixels of the short frame to use.
        scaling: of the long exposure.
        warp: brings the long frame onto the short one.
    """
    signal = scaling.slope * warp(long) + scaling.intercept
    squares = scaling.slope**2 * warp(finest_band(long) ** 2) - finest_band(short) * finest_band(signal)
    whole = np.asarray(ndimage.binary_erosion(mask, np.ones((3, 3)), border_value=0))
    whole &= np.abs(short - signal) < 6 * np.std((short - signal)[mask])
    chosen = signal[whole]
    weight = _inverse_square(
        fit_line(chosen, ((short - signal) ** 2)[whole]), chosen
    )  # better known than the own noise
    line = _weighted_line(chosen, squares[whole], weight)
    error = _rate_error(chosen, squares[whole] - line.floor - line.rate * chosen, weight, whole)
    kept = float(np.var(warp(np.random.default_rng(0).standard_normal(long.shape))[whole]))  # by the interpolation
    return VarianceLine(kept * line.floor, kept * line.rate, kept * error)


def _rate_error(signal: Image, departure: Image, weight: Image, mask: Mask) -> float:
    """Standard error of a line's rate, from the scatter between blocks of `BLOCK`² pixels."""
    row, column = np.indices(mask.shape) // BLOCK
    block = (row * (column.max() + 1) + column)[mask]
    lever = signal - np.average(signal, weights=weight)
    sums = np.bincount(block, weight * lever * departure)
    return float(np.sqrt(np.sum(sums**2)) / np.sum(weight * lever**2))


def finest_band(image: Image) -> Image:
    """The mixed second difference: blind to slopes and curvature along the axes, of unit gain for white noise."""
    kernel = np.array([1.0, -2.0, 1.0]) / np.sqrt(6)
    return np.asarray(ndimage.convolve1d(ndimage.convolve1d(image, kernel, axis=0), kernel, axis=1))


def fit_line(signal: Image, squares: Image) -> VarianceLine:
    """Least-squares line through squared residuals, weighted by their expected spread (that of a variance is the
    variance)."""
    weight = np.ones_like(signal)
    for _ in range(3):
        line = _weighted_line(signal, squares, weight)
        weight = _inverse_square(line, signal)
    return line


def _weighted_line(signal: Image, squares: Image, weight: Image) -> VarianceLine:
    centre = signal.mean()
    design = np.stack([np.ones_like(signal), signal - centre])
    floor, rate = np.linalg.solve(design * weight @ design.T, design * weight @ squares)
    return VarianceLine(float(floor - rate * centre), float(rate))


def _inverse_square(line: VarianceLine, signal: Image) -> Image:
    """Weights of squares whose expectation is the line, but for its lowest tenth."""
    level = np.maximum(line.floor + line.rate * signal, 0.1 * abs(line.floor + line.rate * signal.mean()))
    return np.asarray(1 / np.maximum(level, np.finfo(float).tiny) ** 2)


def ring_mean(image: Image, mask: Mask, *, inner: int, blur: float) -> Image:
    """Gaussian mean of each pixel's neighbours in the mask, leaving out those within `inner` rows and columns of
    itself."""
    weight = _ring_sum(mask.astype(float), inner, blur)
    total = _ring_sum(np.where(mask, image, 0.0), inner, blur)
    result: Image = np.divide(total, weight, out=image.astype(float), where=weight > 1e-6)
    return result


def _ring_sum(image: Image, inner: int, blur: float) -> Image:
    radius = int(np.ceil(3 * blur))
    profile = np.exp(-0.5 * (np.arange(-radius, radius + 1) / blur) ** 2)
    whole = ndimage.convolve1d(
        ndimage.convolve1d(image, profile, axis=0, mode="constant"), profile, axis=1, mode="constant"
    )
    middle = profile[radius - inner : radius + inner + 1]
    return np.asarray(whole - ndimage.convolve(image, np.outer(middle, middle), mode="constant"))


def spread_by_level(level: Image, residual: Image, *, num_levels: int = 24) -> Image:
    """Standard deviation of the residual at each pixel's level, interpolated between equally filled levels.

    Residuals are cut at `CUT` standard deviations, so that outliers count little. Percentiles would move in whole rounding
    steps where the noise has few.
    """
    number = max(1, min(num_levels, len(level) // 50))
    groups = np.argsort(level)[: len(level) // number * number].reshape(number, -1)
    centres, values = level[groups].mean(1), residual[groups]
    low, middle, high = np.percentile(values, (15.87, 50, 84.13), axis=1, keepdims=True)
    spread = np.where(high > low, (high - low) / 2, values.std(axis=1, keepdims=True))
    for _ in range(2):  # the first still has the percentiles' steps in its cut
        spread = np.clip(values, middle - CUT * spread, middle + CUT * spread).std(axis=1, keepdims=True)
    spreads = spread[:, 0]
    return np.asarray(np.maximum(np.interp(level, centres, spreads), max(spreads.max() * 1e-3, np.finfo(float).tiny)))
