"""Linear scaling between two noisy exposures: slope, intercept, and the noise of the long exposure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image, rounding_step
from calibration.tolerances import CLEAR, STANDS_OUT
from noiseflow.described import described
from noiseflow.statistics import uniform_variance, weighted_line

Mask = NDArray[np.bool_]

Warp = Callable[[Image], tuple[Image, Mask]]

MOST_PIXELS = 2**18
"""Largest number of pixels from which scalings, the variance of a long exposure and fits to the scene are computed. The standard
deviations of 24 levels are then known to 0.7 %, slopes better than the signal of any pixel, and 100 coefficients add 0.04 % to a
variance by their errors."""
BLUR = 1.5  # pixels, of a signal: suppresses its noise


@described(intercept="counts", intercept_error="counts", level_error="counts")
@dataclass(frozen=True)
class Scaling:
    """Linear scaling signal = slope·long + intercept, in the units of the short exposure.

    Attributes:
        slope: counts of the short exposure per unit of the long one; its inverse estimates the exposure ratio if both were
            recorded at one detector setting.
        intercept: counts.
        slope_error, intercept_error: standard errors of both.
        centre: value of the long exposure at which the errors of slope and signal are independent.
        level_error: standard error of the signal at `centre`.
    """

    slope: float
    intercept: float
    slope_error: float
    intercept_error: float
    centre: float
    level_error: float

    def common_offset(self) -> tuple[float, float]:
        """Offset of both exposures, intercept/(1 − slope), and its standard error, counts; valid for one detector setting."""
        offset = self.intercept / (1 - self.slope)
        lever = (offset - self.centre) / (1 - self.slope)
        return offset, float(np.hypot(self.level_error / (1 - self.slope), lever * self.slope_error))


@described(floor="counts²", rate="counts", rate_error="counts", centre="counts", level_error="counts²")
@dataclass(frozen=True)
class VarianceLine:
    """Variance that is linear in the signal, as for shot noise with read noise: floor + rate·signal, counts².

    `rate_error` is the standard error of the rate, and `level_error` that of the variance at the signal `centre`, where both are
    independent; 0 if they were not estimated.
    """

    floor: float
    rate: float
    rate_error: float = 0.0
    centre: float = 0.0
    level_error: float = 0.0

    @classmethod
    def fitted(cls, signal: Image, squares: Image) -> VarianceLine:
        """Fit a line to squared residuals by least squares, weighted by the inverse square of the expected variance."""
        every = max(1, -(-len(signal) // MOST_PIXELS)) | 1
        signal, squares = signal[::every], squares[::every]
        weight = np.ones_like(signal)
        for _ in range(3):
            found = weighted_line(signal, squares, weight)
            line = cls(found.intercept, found.slope)
            weight = 1 / line.bounded(signal) ** 2
        return line

    def __call__(self, signal: Image) -> Image:
        """Return the variance at each signal, clipped at 0."""
        return np.maximum(self.floor + self.rate * signal, 0.0)

    def bounded(self, signal: Image) -> Image:
        """Return the variance at each signal, bounded below by a tenth of its mean."""
        level = self.floor + self.rate * signal
        return np.asarray(np.maximum(level, max(0.1 * abs(float(level.mean())), np.finfo(float).tiny)))


def fit_scaling(short: Image, long: Image, mask: Mask, *, burst: bool = False, num_iterations: int = 4) -> Scaling:
    """Fit the scaling between registered exposures by instrumental variables, robust against outliers.

    Least squares would underestimate the slope, because the long exposure is noisy too. The neighbours of each pixel in the short
    frame depend on its signal but not on the noise of either pixel, and serve as the instrument (doi:10.1257/jep.15.4.69).
    Pixels are weighted by their inverse variance; residuals above six standard deviations are excluded.

    Args:
        short: (y, x) counts.
        long: (y, x) exposure registered on `short`.
        burst: whether `long` is a mean of other frames of a burst, whose neighbours serve then: they are less noisy, and no
            interpolation correlates their noise.

    Raises:
        ValueError: the exposures are not correlated.
    """
    instrument, x, y = (one[mask] for one in (ring_mean(long if burst else short, mask), long, short))
    every = max(1, -(-len(y) // MOST_PIXELS)) | 1  # odd: else every second column may be left out
    instrument, x, y = instrument[::every], x[::every], y[::every]
    weight, step = np.ones_like(y), rounding_step(short)
    for _ in range(num_iterations):
        total = weight.sum()
        z = instrument - (weight @ instrument) / total
        covariance = weight * z @ x
        slope = (weight * z @ y) / covariance
        intercept = weight @ (y - slope * x) / total
        residual = y - slope * x - intercept
        spread = np.interp(instrument, *spread_by_level(instrument, residual, step=step))
        weight = (np.abs(residual) < STANDS_OUT * spread) / spread**2
    error = np.sqrt(np.sum((weight * z * residual) ** 2)) / abs(covariance)
    if not np.isfinite(slope) or abs(slope) < CLEAR * error:
        raise ValueError("the registered exposures are not correlated; check that both show one unsaturated scene")
    middle, own = float(weight @ x / total), float(1 / np.sqrt(total))
    intercept_error = float(np.hypot(own, error * middle))
    return Scaling(float(slope), float(intercept), float(error), intercept_error, middle, own)


def own_variance(
    frames: tuple[Image, Image, Image, Mask], slope: float, warp: Warp, noise: Image, less: tuple[Any, float] = (0, 0)
) -> VarianceLine:
    """Estimate the noise variance of the signal estimate, as a line in the signal, counts².

    The finest band of the long frame, before any interpolation, contains its noise and the finest detail of the scene. The detail
    is common to both exposures and is removed by subtracting their covariance in this band.

    Args:
        frames: (y, x) short and long exposure as recorded, long exposure warped and scaled by `slope`, counts, and mask.
        warp, noise: function that warps a long frame onto the short one, and warped white noise of unit variance, (y, x).
        less: (y, x) variance of the pixels' gains before interpolation, counts², and the part of it that both exposures share.
    """
    short, long, signal, mask = frames
    apart = alike_apart(long)
    total = VarianceLine.fitted(signal[mask], ((short - signal) ** 2)[mask])
    # a dark background says nothing of the noise of few bright pixels
    whole = eroded(mask, apart) & (np.abs(short - signal) < STANDS_OUT * np.sqrt(total.bounded(signal)))
    blocks = blocks_of(whole.shape)
    whole &= blocks % (np.count_nonzero(whole) // MOST_PIXELS + 1) == 0
    block, shared = blocks[whole], np.broadcast_to(less[0], whole.shape)[whole]
    squares = slope**2 * warp(finest_band(long, step=apart) ** 2)[0][whole] - shared
    common = [
        (finest_band(short, step=step) * finest_band(signal, step=step))[whole]
        for step in (apart, 2 * apart, 4 * apart)
    ]
    common[0] -= shared * less[1]
    chosen = finest_band(signal, step=apart, power=2)[whole]  # of the pixels that a value of the band mixes

    def error_of(values: Image) -> float:
        return float(np.linalg.norm(np.bincount(block, values)))

    # the detail of smooth scenes is less than what the noise of the short exposure adds to the covariance, but falls off from
    # that in coarser bands as steeply as between these, or more: it lies between nothing and what this extrapolates to
    detail = [float(one.mean()) for one in common]
    unsure = error_of(common[0] - detail[0]) / len(chosen)
    fall = min(max(detail[1] / detail[2], 0.0), 1.0) if detail[2] > 0 else 0.0
    most = fall * max(detail[1], 0.0)
    doubt = uniform_variance(most) + max(max(detail[0] - most, 0.0) ** 2 - unsure**2, 0.0)
    shown = doubt / max(doubt + unsure**2, np.finfo(float).tiny)
    squares = squares - shown * common[0] - (1 - shown) * fall / 2 * common[1]
    weight = 1 / total.bounded(chosen)  # the total variance is better known than that of the long exposure
    # the scatter follows the detail, which is that of neighbours whose noise is not in the band
    near = ring_mean(finest_band(signal, step=apart) ** 2, mask, inner=2)[whole]
    weight /= near + np.median(near) + np.finfo(float).tiny
    line = weighted_line(chosen, squares, weight)
    departure = weight * (squares - line.intercept - line.slope * chosen)
    centre = float(np.average(chosen, weights=weight))
    lever = chosen - centre
    level, rate = error_of(departure) / np.sum(weight), error_of(lever * departure) / np.sum(weight * lever**2)
    level = np.hypot(level, (1 - shown) * np.sqrt(doubt))
    kept = float(np.var(noise[whole]))  # the fraction that interpolation preserves
    return VarianceLine(kept * line.intercept, kept * line.slope, kept * float(rate), centre, kept * float(level))


def blocks_of(shape: tuple[int, ...], *, side: int = 8) -> NDArray[np.int64]:
    """(y, x) numbers of blocks that scatter independently of each other: band filter and interpolation reach 3 pixels."""
    down, across = (np.arange(size) // side for size in shape)
    return np.asarray(np.add.outer(down * (across[-1] + 1), across))


def mean_and_error(values: Image, mask: Mask) -> tuple[float, float]:
    """Mean over the mask, and its standard error from the scatter between blocks."""
    sums = np.bincount(blocks_of(mask.shape)[mask], values[mask] - (middle := float(values[mask].mean())))
    return middle, float(np.sqrt(np.sum(sums**2)) / mask.sum())


def finest_band(image: Image, *, step: int = 1, power: int = 1) -> Image:
    """Mixed second difference of pixels `step` apart, free of slopes, with unit gain for white noise; or, with a `power` of 2,
    the mean by its squared weights, which is the share of each pixel in its variance."""
    kernel = spaced((np.array([1.0, -2.0, 1.0]) / np.sqrt(6)) ** power, step)
    return separable(image, kernel, kernel)


def spaced(weights: Image, step: int) -> Image:
    """A kernel of weights for pixels `step` apart."""
    kernel = np.zeros((len(weights) - 1) * step + 1)
    kernel[::step] = weights
    return kernel


def alike_apart(image: Image, *, least: float = 0.3) -> int:
    """Distance between pixels of one colour in a (y, x) image: 2 pixels in a mosaic of filters, whose finest band alternates in
    sign, so that the mean sign exceeds the `least` one; that of the noise of 32 × 32 pixels reaches 0.08. Otherwise 1."""
    even = np.add.outer(*map(np.arange, image.shape)) % 2 == 0
    return 2 if abs(np.mean(np.where(even, 1, -1) * np.sign(finest_band(image)))) > least else 1


def separable(image: Image, along_y: Image, along_x: Image, *, beyond: str = "REFLECT") -> Image:
    """Correlate a (y, x) image with one kernel along y and one along x; `beyond` is OpenCV's name of the continued border."""
    border = getattr(cv2, f"BORDER_{beyond}")
    return np.asarray(cv2.sepFilter2D(np.asarray(image, float), cv2.CV_64F, along_x, along_y, borderType=border))


def correlated(image: Image, kernel: Image) -> Image:
    """Correlate a (y, x) image with a small kernel; the border is continued by its nearest pixels."""
    return np.asarray(cv2.filter2D(np.asarray(image, float), cv2.CV_64F, kernel, borderType=cv2.BORDER_REPLICATE))


def smoothed(image: Image, blur: float, *, order: tuple[int, int] = (0, 0)) -> Image:
    """Smooth a (y, x) image with a Gaussian of `blur` pixels, or return derivatives of that, of the orders along y and x."""
    place = np.arange(-int(4 * blur + 0.5), int(4 * blur + 0.5) + 1.0)
    kernel = np.exp(-0.5 * (place / blur) ** 2)
    kernel /= kernel.sum()
    derivatives = kernel, kernel * place / blur**2, kernel * (place**2 / blur**2 - 1) / blur**2
    return separable(image, derivatives[order[0]], derivatives[order[1]])


def eroded(mask: Mask, margin: int) -> Mask:
    """Remove the pixels within `margin` rows and columns of others that are not in the mask, or of the frame's edge."""
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return np.asarray(cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0), bool)


def dilated(mask: Mask, reach: int, *, square: bool = False) -> Mask:
    """Add the pixels within `reach` steps along the axes to a mask; with `square`, those within `reach` rows and columns."""
    kernel = np.ones((3, 3), np.uint8) if square else cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel, iterations=reach), bool)


def around(values: Image, number: int) -> Image:
    """Each of (N,) values with its nearest neighbours, (N, number), reflected at the ends; `number` is odd."""
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, number // 2, mode="symmetric"), number)


def one_sigma(values: Image) -> Image:
    """Percentiles that lie one standard deviation below the median, at it, and one above it for normal values, (3,)."""
    place = np.array((0.1587, 0.5, 0.8413)) * (len(values) - 1)
    low, high = (side(place).astype(int) for side in (np.floor, np.ceil))
    ordered = np.partition(values, [*low, *high])  # a fifth of the time of np.percentile for 1000 values
    return np.asarray(ordered[low] + (place - low) * (ordered[high] - ordered[low]))


def ring_mean(image: Image, mask: Mask, *, inner: int = 0, blur: float = BLUR) -> Image:
    """Gaussian-weighted mean of each pixel's neighbours in the mask, without those within `inner` rows and columns."""
    weight = _ring_sum(mask.astype(float), inner, blur)
    total = _ring_sum(np.where(mask, image, 0.0), inner, blur)
    return np.asarray(np.divide(total, weight, out=image.astype(float), where=weight > 1e-6))


def _ring_sum(image: Image, inner: int, blur: float) -> Image:
    radius = int(np.ceil(3 * blur))
    profile = np.exp(-0.5 * (np.arange(-radius, radius + 1) / blur) ** 2)
    whole, middle = separable(image, profile, profile, beyond="CONSTANT"), profile[radius - inner : radius + inner + 1]
    return whole - (separable(image, middle, middle, beyond="CONSTANT") if inner else image)


def groups_of(values: Image, number: int, least: int) -> list[NDArray[np.int64]]:
    """Split the indices of (N,) values into at most `number` groups of `least` values or more, in their order; unsorted within.

    Half of the groups would share the values equally, and half their range: no simple law describes a few bright pixels that
    spread widely.
    """
    every = max(1, len(values) // MOST_PIXELS) | 1
    ordered = np.sort(values[::every])
    low, high = ordered[[0, max(len(ordered) - 1 - least // every, 0)]]
    width = max(high - low, np.finfo(float).tiny)
    share = np.linspace(0, 1, len(ordered)) + np.minimum(ordered - low, width) / width
    edges = np.interp(2 / number * np.arange(1, number), share, ordered)
    index = np.searchsorted(edges, values, side="right").astype(np.uint16)  # 16 bits are sorted several times faster
    kept = [0]
    for count in np.cumsum(np.bincount(index, minlength=number))[:-1]:
        if min(count - kept[-1], len(values) - count) >= least:
            kept.append(int(count))
    return np.split(np.argsort(index, kind="stable"), kept[1:])


def spread_by_level(
    level: Image, residual: Image, *, step: float, num_levels: int = 24, cut: float = 4.0
) -> tuple[Image, Image]:
    """Levels of `groups_of`, (K,), and standard deviations of (N,) residuals there, between which `np.interp` interpolates.

    Residuals are clipped at `cut` standard deviations, which noise rarely reaches, so that 1 % outliers increase the result by
    7 %. Percentiles are not used for the result, because they change in whole rounding steps where the noise spans few of
    them. The rounding `step` is added to them: where most counts are 0, they do not show the others.
    """
    every = max(1, -(-len(level) // MOST_PIXELS)) | 1
    groups = groups_of(level[::every], num_levels, 50)
    order, number = np.concatenate(groups), np.array([len(group) for group in groups])
    first = np.cumsum(number) - number
    level, residual = level[::every][order], residual[::every][order]
    low, middle, high = np.transpose([one_sigma(part) for part in np.split(residual, first[1:])])
    away = residual - np.repeat(middle, number)

    def deviations(values: Image) -> Image:
        mean, squares = (np.add.reduceat(each, first) / number for each in (values, values**2))
        return np.asarray(np.sqrt(np.maximum(squares - mean**2, 0.0)))

    spread = np.hypot(np.where(high > low, (high - low) / 2, deviations(away)), step)
    for _ in range(2):  # the first pass still clips at percentiles, which have rounding steps
        most = np.repeat(cut * spread, number)
        spread = deviations(away.clip(-most, most))
    least = max(spread.max() * 1e-3, np.finfo(float).tiny)
    return np.add.reduceat(level, first) / number, np.maximum(spread, least)
