"""Detection of the rounding step and clipping limits of a detector from its pixel values."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import scipy  # its packages load when they are first used
from numpy.typing import ArrayLike, NDArray

from noiseflow.arrays import as_array
from noiseflow.distributions.laws.base import ROUNDINGS
from noiseflow.distributions.wrappers.numerical import MOST_LEVELS
from noiseflow.statistics import ENOUGH, STANDARD_ERRORS

_SAMPLE = 2**18
FEWEST = 10
"""Pixels of one value without which nothing is concluded from it."""
MOST_CODES = 1024
"""Unequal levels are at most so many: of more, the pixels say little."""
GROUPS = 64
"""Groups of equal signal in which pixels are judged."""


class Digitisation(NamedTuple):
    """Rounding and clipping of a detector.

    Attributes:
        step: rounding step, detector units; 0 if pixel values are not rounded.
        low, high: clipping limits, detector units; infinite if there is none.
        origin: the level nearest to 0, detector units; not used if `low` is finite, which is a level itself.
        levels: all levels, detector units, if they are not equally spaced; empty otherwise.

    Example:
        >>> import noiseflow
        >>> detector = noiseflow.Digitisation(step=1.0, low=0.0, high=255.0)
        >>> model = noiseflow.Digitised(noiseflow.Poisson(), *detector)
        >>> model.low, model.high
        (0.0, 255.0)
    """

    step: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    origin: float = 0.0
    levels: tuple[float, ...] = ()

    def __repr__(self) -> str:
        shown = f", {len(self.levels)} unequal levels" if self.levels else ""
        return f"Digitisation(step={self.step!r}, low={self.low!r}, high={self.high!r}, origin={self.origin!r}{shown})"

    @property
    def found(self) -> bool:
        """Whether there are levels or a clipping limit."""
        return bool(self.levels) or self.step > 0 or math.isfinite(self.low) or math.isfinite(self.high)

    def raised(self, level: float) -> Digitisation:
        """That of values raised by a level, and `origin` with them."""
        step, low, high, origin, levels = self
        levels = tuple(each + level for each in levels)
        return Digitisation(step, low + level, high + level, origin + level * bool(step), levels)

    def in_words(self) -> str:
        """A short description."""
        equal = self.step > 0 and np.allclose(np.diff(self.levels), self.step)
        if self.levels and not equal:
            return f"coded in {len(self.levels)} unequal levels"
        parts = [f"rounded to steps of {self.step:g}{' of unequal width' * bool(self.levels)}"] if self.step > 0 else []
        rails = [f"{rail:g}" for rail in (self.low, self.high) if math.isfinite(rail)]
        return " and ".join([*parts, *([f"clipped at {' and '.join(rails)}"] if rails else [])]) or "not digitised"


def detect_digitisation(
    readings: ArrayLike, signal: ArrayLike | None = None, *, use: ArrayLike | None = None
) -> Digitisation:
    """Detect the rounding step and the clipping limits of pixel values.

    Pixel values are rounded if all of them are integer multiples of a step from the smallest one. Integers always are; other
    numbers must repeat. Rounding by the number format itself is ignored.

    Levels that are not equally spaced, such as decoded square roots, are recognised if they are at most 1024 and hold enough
    pixels to show that those between them do not occur.

    A clipping limit is an extreme value with at least ten pixels, and with more than the two levels next to it allow if the
    histogram is log-concave there, as noise tails and electron counts are. The histogram of a whole image does not show a low
    limit, because counts with an empty background end at 0 with many pixels too. A low limit is therefore reported only if a
    signal is given and the pixels of equal signal are more likely under clipped normal noise than under counts (a negative
    binomial distribution, which also describes pixels whose signals differ a little). The largest value of an integer type is
    always a limit if it occurs.

    Args:
        readings: pixel values of any shape and real type, detector units; NaN and infinite values are ignored.
        signal: known or predicted clean signals shaped like `readings`, detector units; the last two axes are those of images.
        use: boolean mask of the pixels to use; all by default. Masked values of masked arrays are not used.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> import noiseflow, numpy as np
        >>> signal = np.linspace(50, 250, 10_000)
        >>> values = np.random.default_rng(0).normal(signal, 40).round().clip(0, 255)
        >>> noiseflow.detect_digitisation(values, signal)
        Digitisation(step=1.0, low=0.0, high=255.0, origin=0.0)
    """
    values = _numbers(readings)
    values = values.astype(np.uint8) if values.dtype.kind == "b" else values
    used = ~np.ma.getmaskarray(values) & np.isfinite(np.ma.getdata(values))
    used = used if use is None else used & _numbers(use)
    values = np.ma.getdata(values)
    if not used.any():
        return Digitisation()
    predicted = None if signal is None else _numbers(signal).astype(np.float64)
    if predicted is not None and predicted.shape != values.shape:
        raise ValueError(f"signal has shape {predicted.shape}, pixel values {values.shape}; they must be equal")
    seen = values.ravel() if used.all() else values[used]
    levels = np.unique(seen[:: max(1, seen.size // _SAMPLE)])
    step = _step(levels, seen.size)
    unequal = _unequal_levels(seen, levels, step)
    if unequal:
        return Digitisation(step, levels=unequal)
    limits = [_limit(seen, levels, (values, used, predicted), high=which) for which in (False, True)]
    if predicted is not None:
        reached = (_is_reached(seen, predicted[used], limit, step) for limit in limits)
        ends = zip(limits, reached, (-math.inf, math.inf), strict=True)
        limits = [limit if each else none for limit, each, none in ends]
    low, high = limits
    lowest = float(seen.min()) if step and math.isinf(low) else 0.0
    origin = lowest - step * round(lowest / (step or 1.0))  # the level nearest to 0, up to rounding errors of the step
    return Digitisation(step, low, high, origin if abs(origin) > 1e-3 * step else 0.0)


def _numbers(given: Any) -> NDArray[Any]:
    """An array, which may be masked, or a tensor as an array with an axis."""
    return np.atleast_1d(given if np.ma.isMaskedArray(given) else as_array(given))


def _step(levels: NDArray[Any], size: int) -> float:
    if levels.size <= 2:
        return 1.0 if levels.dtype.kind in "iu" else 0.0
    if levels.dtype.kind in "iu" or (float(np.abs(levels).max()) < 2**53 and not (levels % 1).any()):
        step = float(np.gcd.reduce((levels - levels[0]).astype(np.uint64)))
    elif levels.size <= min(MOST_LEVELS, size // 2):
        step = _spacing(levels.astype(np.float64))
    else:
        return 0.0
    if levels.dtype.kind == "f" and step < ROUNDINGS * float(np.spacing(np.abs(levels).max())):
        return 0.0
    return step


def _unequal_levels(
    values: NDArray[Any], levels: NDArray[Any], step: float, *, unequal: float = 0.02
) -> tuple[float, ...]:
    """The levels, given those of a sample, if they are few, populated, and not one step apart; empty otherwise. Each has enough
    pixels that an empty level beside it is no chance; below such a share of the pixels, missing levels cost less than 0.02 nats
    per pixel."""
    if levels.size > MOST_CODES:
        return ()
    levels, counts = np.unique(values, return_counts=True)
    if not 2 < levels.size <= min(MOST_CODES, values.size // (2 * FEWEST)):
        return ()
    gaps = np.diff(levels.astype(np.float64))
    # between two values of a scene, gaps are wide too, but there the pixels become fewer towards the gap
    before, after = np.r_[0, counts[:-2]], np.r_[counts[2:], 0]
    populated = np.minimum(counts[1:], counts[:-1]) >= 2 * FEWEST
    populated &= (2 * counts[1:] > after) & (2 * counts[:-1] > before)
    wide = populated & (gaps > 1.5 * (step or gaps.min()))
    share = (counts[1:][wide].sum() + counts[:-1][wide].sum()) / (2 * values.size)
    return tuple(map(float, levels)) if share > unequal else ()


def _spacing(levels: NDArray[np.float64]) -> float:
    """The common spacing of sorted levels, or 0 if there is none."""
    gaps = np.diff(levels)
    least = np.median(gaps[gaps < 1.5 * gaps.min()])
    # a gap has the rounding error of two pixel values; the whole span has it only once
    step = float((levels[-1] - levels[0]) / np.round(gaps / least).sum())
    steps = (levels - levels[0]) / step
    return step if float(np.abs(steps - np.round(steps)).max()) < 0.02 else 0.0


def _limit(seen: NDArray[Any], levels: NDArray[Any], image: tuple[Any, Any, Any], *, high: bool) -> float:
    """The clipping limit at one end, or infinity; of the pixel values that are used, the levels of a sample of them, and the
    image: values, which of them are used, and signal or None."""
    none = math.inf if high else -math.inf
    if image[-1] is None and not high:
        return none
    extreme = seen.max() if high else seen.min()
    if high and seen.dtype.kind in "iu" and extreme == np.iinfo(seen.dtype).max:
        return float(extreme)
    levels = np.union1d(levels, extreme)
    levels = (levels[::-1] if high else levels)[:3].astype(np.float64)
    if levels.size < 3:
        return none
    count, beside, beyond = (int(np.count_nonzero(seen == level)) for level in levels)
    if count < FEWEST:
        return none
    # whether the level holds more pixel values than a log-concave histogram allows
    log_ratio = math.log(count * (beyond + 1)) - 2 * math.log(max(beside, 1))
    error = math.sqrt(1 / count + 1 / (beyond + 1) + 4 / max(beside, 1))
    if not ((count > 2 * beside and log_ratio > 0.1) or (count > beside and log_ratio > 0.1 + 3 * error)):
        return none
    return float(extreme) if high or _shows(*image, levels) else none


def _is_reached(
    values: NDArray[Any], signal: NDArray[np.float64], limit: float, step: float, *, near: float = 0.1
) -> bool:
    """Whether pixels are also near a limit, where the noise that it clips is: not if the value marks dead or empty pixels. Of
    other pixels of equal signal, clipped normal and Student noise has, within a tenth of their mean distance, at least a tenth of
    the product of the shares that are at the limit and that are not."""
    found = 0.0
    for group in np.array_split(np.argsort(signal)[:: max(1, signal.size // ENOUGH)], GROUPS):
        away = np.abs(values[group] - limit)
        others = away[away > 0]
        if math.isfinite(limit) and others.size:
            beside = np.count_nonzero(others < max(near * others.mean(), 1.5 * step))
            found += beside - near / 2 * others.size * (1 - others.size / away.size)
    return found >= 0


def _shows(
    values: NDArray[Any],
    use: NDArray[np.bool_],
    signal: NDArray[np.float64],
    levels: NDArray[np.float64],
    *,
    least: int = 100,
    alike: float = 0.3,
    bins: int = 4,
) -> bool:
    """Whether pixels of equal signal are more likely under clipped normal noise than under counts that end at the limit. Pixels
    at edges are left out, because errors of a predicted signal mix different signals there. A group has at least so many pixels,
    as it determines two parameters, and signals that scatter less than the noise by a factor that widens it by 5 %; fine or
    missing steps have so many bins in a standard deviation of the noise."""
    size = (1,) * max(0, signal.ndim - 2) + (3,) * min(2, signal.ndim)
    span = scipy.ndimage.maximum_filter(signal, size) - scipy.ndimage.minimum_filter(signal, size)
    places = np.flatnonzero(use & np.isfinite(span))
    places = places[:: max(1, places.size // ENOUGH)]
    order = places[np.argsort(signal.flat[places], kind="stable")]
    # signals brighter than any on the limit show nothing, and would widen the groups
    order = order[: 1 + np.flatnonzero(values.flat[order] == levels[0]).max(initial=-1)]
    gain, square = 0.0, 0.0
    for group in np.array_split(order, min(GROUPS, max(1, order.size // least))):
        noise = float((values.flat[group] - signal.flat[group]).std())
        group = group[span.flat[group] <= noise] if signal.ndim > 1 else group
        if group.size < FEWEST or signal.flat[group].std() > alike * noise:
            continue
        step = max(levels[1] - levels[0], noise / bins)
        number = np.ceil((values.flat[group] - levels[0]) / step - 0.5)
        counts, repeats = np.unique(np.where(values.flat[group] > levels[0], number.clip(1), 0), return_counts=True)
        if counts.size > 2 and counts[0] == 0:
            difference = _log_clipped(counts, repeats) - _log_counted(counts, repeats)
            gain, square = gain + float(repeats @ difference), square + float(repeats @ difference**2)
    return gain > STANDARD_ERRORS * math.sqrt(square) and gain > FEWEST


def _log_clipped(counts: NDArray[np.float64], repeats: NDArray[np.int64]) -> NDArray[np.float64]:
    """Log-probabilities of counts under the most likely normal distribution that is rounded and clipped at 0."""

    def log_prob(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        mean, width = parameters[0], math.exp(parameters[1])
        above, below = (counts + 0.5 - mean) / width, np.where(counts == 0, -np.inf, (counts - 0.5 - mean) / width)
        mirror = below > 0  # differences of probabilities near 1 lose all digits
        high, low = np.where(mirror, -below, above), np.where(mirror, -above, below)
        return np.asarray(np.log(np.maximum(scipy.special.ndtr(high) - scipy.special.ndtr(low), np.finfo(float).tiny)))

    mean = float(np.average(counts, weights=repeats))
    width = math.sqrt(float(np.average((counts - mean) ** 2, weights=repeats)))
    start = np.array([mean, math.log(width)])
    found = scipy.optimize.minimize(lambda each: -float(repeats @ log_prob(each)), start, method="Nelder-Mead").x
    return log_prob(found)


def _log_counted(counts: NDArray[np.float64], repeats: NDArray[np.int64]) -> NDArray[np.float64]:
    """Log-probabilities of counts under the most likely negative binomial distribution, whose mean is that of the counts."""
    mean = float(np.average(counts, weights=repeats))

    def log_prob(log_size: float) -> NDArray[np.float64]:
        size = math.exp(log_size)
        ways = scipy.special.gammaln(counts + size) - scipy.special.gammaln(size) - scipy.special.gammaln(counts + 1)
        total = size + mean
        return np.asarray(ways + size * math.log(size / total) + counts * math.log(mean / total))

    best = scipy.optimize.minimize_scalar(
        lambda each: -float(repeats @ log_prob(each)), bounds=(-7, 12), method="bounded"
    ).x
    return log_prob(float(best))
