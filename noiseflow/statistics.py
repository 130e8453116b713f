"""Statistics that several packages need: robust spread, products of neighbours, weighted lines, White's errors, block means."""

import zlib
from typing import Any, NamedTuple

import numpy as np
import scipy  # its packages load when they are first used
from numpy.typing import NDArray

Array = NDArray[Any]

# Standard deviation of a normal distribution per median absolute deviation: 1 / Φ⁻¹(3/4).
_PER_MAD = 1.4826
STANDARD_ERRORS = 3
"""Standard errors from which a difference is believed."""
ENOUGH = 1_000_000
"""Pixels that suffice to compare noise models and to measure their scaling, and the most copies of weighted pixels."""
SAMPLE = 2**16
"""Pixels that suffice where these take too long: for searches, and for what is seen in all of them."""


def robust_deviation(values: Array, centre: float | None = None) -> float:
    """Standard deviation from the median absolute deviation, which outliers in less than half of the values hardly change.

    Args:
        values: any shape, any unit.
        centre: the value to measure from; the median by default.
    """
    return _PER_MAD * float(np.median(np.abs(values - (np.median(values) if centre is None else centre))))


def uniform_variance(width: Array | float) -> Any:
    """Variance of values that are spread evenly over a width, as rounding spreads errors over a step."""
    return width**2 / 12


def bulk(values: Array) -> tuple[float, float]:
    """The range of nearly all values: their quantiles 0.001 and 0.999."""
    low, high = np.quantile(values, (0.001, 0.999))
    return float(low), float(high)


def rarely_exceeded(score: float, freedom: int) -> float:
    """Standard errors of few degrees of freedom that are exceeded by chance as rarely as a score of known ones (Student's t)."""
    return -float(scipy.special.stdtrit(freedom, scipy.special.ndtr(-score)))


def rare_chi_squared(score: float, freedom: int) -> float:
    """The χ² that is exceeded by chance as rarely as a score of normal values; its tail is heavier than theirs."""
    return float(scipy.special.chdtri(freedom, scipy.special.ndtr(-score)))


def neighbour_products(values: Array, *, axis: int = -1) -> Array:
    """Products of each value with the next one along an axis, shorter by one there.

    Noise that is independent between neighbours does not contribute to their mean, which therefore measures common structure
    (the autocovariance at lag one, if the values have mean zero).

    Args:
        values: any shape.
        axis: the axis along which values are neighbours.
    """
    along = np.moveaxis(values, axis, 0)
    return np.moveaxis(along[1:] * along[:-1], 0, axis)


class Line(NamedTuple):
    """A fitted line, y = intercept + slope·x.

    Attributes:
        slope_error: standard error of the slope, for weights that are inverse variances.
        chi_squared: χ² per degree of freedom.
    """

    slope: float
    intercept: float
    slope_error: float
    chi_squared: float


def weighted_line(x: Array, y: Array, weight: Array) -> Line:
    """Fit a line by weighted least squares; the slope of points at a single x, up to rounding, is 0.

    Args:
        x, y, weight: (N,) places, values, and their inverse variances.
    """
    middle = float(np.average(x, weights=weight))
    information = max(float(np.sum(weight * (x - middle) ** 2)), np.finfo(float).tiny)
    apart = np.ptp(x) > 64 * np.finfo(float).eps * np.abs(x).max()
    slope = float(np.sum(weight * (x - middle) * y)) / information if apart else 0.0
    intercept = float(np.average(y, weights=weight)) - slope * middle
    chi_squared = float(np.sum(weight * (y - intercept - slope * x) ** 2)) / max(len(x) - 2, 1)
    return Line(slope, intercept, float(np.sqrt(1 / information)), chi_squared)


def white_regression(
    columns: Array, values: Array, *, ridge: float = 0.0, clusters: Array | None = None
) -> tuple[Array, Array]:
    """Least squares, with errors of the jackknife for noise of any variance (HC3 and CR3, doi:10.1016/0304-4076(85)90158-7).

    Args:
        columns: (N, K) regressors; their scales do not matter.
        values: (..., N) one or several series of values.
        ridge: addition to the diagonal of the normal matrix of scaled columns, for columns that are nearly alike.
        clusters: (N,) numbers of groups of values whose noise may be correlated.

    Returns:
        (..., K) coefficients and their standard errors; an undetermined coefficient is 0; columns that are alike share theirs.
    """
    scale, least = np.sqrt((columns**2).sum(0)) + 1e-30, np.finfo(float).eps
    scaled = columns / scale
    normal = scaled.T @ scaled + ridge * np.eye(columns.shape[1])
    spread = scaled @ np.linalg.pinv(normal)
    found = values @ spread
    left = values - found @ scaled.T
    if clusters is None:
        power = (left / np.maximum(1 - (spread * scaled).sum(1), least)) ** 2 @ spread**2
    else:
        order = np.argsort(clusters, kind="stable")
        scaled, starts = scaled[order], np.unique(clusters[order], return_index=True)[1]
        slopes = np.add.reduceat(left[..., order, None] * scaled, starts, axis=-2)
        own = np.stack([np.add.reduceat(scaled * each[:, None], starts) for each in scaled.T], -1)
        moved = np.linalg.solve(normal - own + least * np.eye(columns.shape[1]), slopes[..., None])
        power = (moved[..., 0] ** 2).sum(-2)
    return found / scale, np.maximum(np.sqrt(power), 1e-15) / scale


def block_means(images: Array, *sizes: int) -> Array:
    """Means of blocks of `sizes` pixels along the last axes, float64; incomplete blocks at the far edges are dropped."""
    counts = [length // size for length, size in zip(images.shape[-len(sizes) :], sizes, strict=True)]
    inner: tuple[Any, ...] = ..., *(slice(count * size) for count, size in zip(counts, sizes, strict=True))
    pairs = [part for pair in zip(counts, sizes, strict=True) for part in pair]
    blocks, axes = images[inner].reshape(*images.shape[: -len(sizes)], *pairs), tuple(range(1 - len(pairs), 0, 2))
    return np.asarray(blocks.mean(axes, dtype=np.float64))


def own_random(seed: int) -> np.random.Generator:
    """A random stream that shares no numbers with ``np.random.default_rng(seed)``, which may have drawn the data.

    A split of pixels drawn with the numbers of their signals would hold out the darkest pixels.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(b"noiseflow"),)))
