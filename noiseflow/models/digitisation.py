"""Detection of the rounding step and clipping limits of a detector from its pixel values."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SAMPLE = 2**18
_MOST_LEVELS = 2**16
_LEAST_PILED = 10
_LEAST_ULPS = 8


class Digitisation(NamedTuple):
    """Rounding and clipping of a detector.

    Attributes:
        step: rounding step, detector units; 0 if pixel values are not rounded.
        low, high: clipping limits, detector units; infinite if there is none.
        origin: the level nearest to 0, detector units; not used if `low` is finite, which is a level itself.

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

    @property
    def found(self) -> bool:
        """Whether there is a rounding step or a clipping limit."""
        return self.step > 0 or math.isfinite(self.low) or math.isfinite(self.high)

    def in_words(self) -> str:
        """A short description."""
        parts = [f"rounded to steps of {self.step:g}"] if self.step > 0 else []
        rails = [f"{rail:g}" for rail in (self.low, self.high) if math.isfinite(rail)]
        return " and ".join([*parts, *([f"clipped at {' and '.join(rails)}"] if rails else [])]) or "not digitised"


def detect_digitisation(readings: ArrayLike) -> Digitisation:
    """Detect the rounding step and the clipping limits of pixel values.

    Pixel values are rounded if all of them are integer multiples of a step from the smallest one. Integers always are; other
    numbers must repeat. Rounding by the number format itself is ignored.

    A clipping limit is an extreme value with too many pixels: at least ten, and more than expected from the two levels next to it
    if the histogram is log-concave there, as noise tails and electron counts are. The largest value of an integer type is always
    a limit if it occurs. A smallest value of 0 alone is not a clipping limit, because counts end there too.

    Args:
        readings: pixel values of any shape and real type, detector units; NaN and infinite values are ignored.

    Example:
        >>> import noiseflow, numpy as np
        >>> values = np.random.default_rng(0).normal(200, 40, 10_000).round().clip(0, 255)
        >>> noiseflow.detect_digitisation(values).high
        255.0
    """
    values = np.asarray(readings.detach().cpu() if hasattr(readings, "detach") else readings)
    if isinstance(readings, np.ma.MaskedArray):
        values = readings.compressed()
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    values = values.reshape(-1)
    if values.dtype.kind == "f":
        values = values if np.isfinite(values).all() else values[np.isfinite(values)]
    if not values.size:
        return Digitisation()
    step = _step(values)
    low, high = _rail(values, step, high=False), _rail(values, step, high=True)
    return Digitisation(step, low, high, _origin(float(values.min()), step) if step and math.isinf(low) else 0.0)


def _origin(level: float, step: float) -> float:
    """The level nearest to 0, given any other; 0 within the rounding errors of the step."""
    nearest = level - step * round(level / step)
    return nearest if abs(nearest) > 1e-3 * step else 0.0


def _step(values: NDArray[Any]) -> float:
    levels = np.unique(values[:: max(1, values.size // _SAMPLE)])
    if levels.size <= 2:
        return 1.0 if levels.dtype.kind in "iu" else 0.0
    if levels.dtype.kind in "iu" or _are_whole(levels):
        step = float(np.gcd.reduce((levels - levels[0]).astype(np.uint64)))
    elif levels.size <= min(_MOST_LEVELS, values.size // 2):
        step = _spacing(levels.astype(np.float64))
    else:
        return 0.0
    if levels.dtype.kind == "f" and step < _LEAST_ULPS * float(np.spacing(np.abs(levels).max())):
        return 0.0
    return step


def _are_whole(levels: NDArray[Any]) -> bool:
    return float(np.abs(levels).max()) < 2**53 and np.array_equal(levels, np.round(levels))


def _spacing(levels: NDArray[np.float64]) -> float:
    """The common spacing of sorted levels, or 0 if there is none."""
    gaps = np.diff(levels)
    least = np.median(gaps[gaps < 1.5 * gaps.min()])
    # a gap has the rounding error of two pixel values; the whole span has it only once
    step = float((levels[-1] - levels[0]) / np.round(gaps / least).sum())
    steps = (levels - levels[0]) / step
    return step if float(np.abs(steps - np.round(steps)).max()) < 0.02 else 0.0


def _rail(values: NDArray[Any], step: float, *, high: bool) -> float:
    none = math.inf if high else -math.inf
    extreme = values.max() if high else values.min()
    if high and values.dtype.kind in "iu" and extreme == np.iinfo(values.dtype).max:
        return float(extreme)
    at_extreme = values == extreme
    count, rest = int(np.count_nonzero(at_extreme)), values[~at_extreme]
    if count < _LEAST_PILED or not rest.size:
        return none
    if step > 0:
        away = np.round(np.abs(rest.astype(np.float64) - float(extreme)) / step)
        piled = _piles_up(count, int(np.count_nonzero(away == 1)), int(np.count_nonzero(away == 2)))
    else:
        piled = count > 2 * int(np.count_nonzero(rest == (rest.max() if high else rest.min())))
    return float(extreme) if piled and np.ptp(rest) > 0 else none


def _piles_up(count: int, beside: int, beyond: int) -> bool:
    """Whether the outermost of three neighbouring levels holds more pixel values than a log-concave histogram allows."""
    log_ratio = math.log(count * (beyond + 1)) - 2 * math.log(max(beside, 1))
    error = math.sqrt(1 / count + 1 / (beyond + 1) + 4 / max(beside, 1))
    return (count > 2 * beside and log_ratio > 0.1) or (count > beside and log_ratio > 0.1 + 3 * error)
