"""Noise that differs between parts of the field: shading corrections, gains of amplifiers, rows, columns or colour filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.detector.residual import Residual
from calibration.exposures.frames import Image
from noiseflow.described import described

CHANCE = 6.0
"""Standard errors of the χ² of noise above which a pattern is significant. The χ² of 13 patterns exceed it once in 10⁴ sets."""

LEAST_PIXELS = 100
"""Fewest pixels of a class; their mean square is then known to 14 %."""

Groups = Callable[[Any, Any, tuple[int, ...]], Any]


def _modulo(axis: int, period: int) -> Groups:
    return lambda y, x, shape: (y, x)[axis] % period


GROUPS: dict[str, Groups] = {
    "left and right halves": lambda y, x, shape: (2 * x >= shape[1]).astype(int),
    "upper and lower halves": lambda y, x, shape: (2 * y >= shape[0]).astype(int),
    "quadrants": lambda y, x, shape: 2 * (2 * y >= shape[0]) + (2 * x >= shape[1]),
    "every second column": _modulo(1, 2),
    "every second row": _modulo(0, 2),
    "2 × 2 mosaic": lambda y, x, shape: 2 * (y % 2) + x % 2,
    "every third column": _modulo(1, 3),
    "every third row": _modulo(0, 3),
    "every fourth column": _modulo(1, 4),
    "every fourth row": _modulo(0, 4),
}
"""Classes of pixels that may have amplifiers or filters of their own; functions of row, column and frame shape."""


@described(relative="of the noise variance", error="of the noise variance")
@dataclass(frozen=True)
class Pattern:
    """Dependence of the noise variance on the place, at equal signal.

    Attributes:
        name: ``"field"`` for a smooth dependence, else one of `GROUPS`; empty if there is none.
        relative: relative deviation (rms) of the variance; 0 if not significant.
        error: its standard error.
        factors: (C,) variance of each class over the mean.
    """

    name: str = ""
    relative: float = 0.0
    error: float = 0.0
    factors: tuple[float, ...] = ()


def pattern_of(residuals: Sequence[Residual], *, inflation: float = 1.0) -> Pattern:
    """Find the pattern that explains most of the differences of the noise variance over the field.

    Args:
        residuals: standardised residuals of frames of equal size.
        inflation: factor of the standard error of a variance due to correlation between pixels.
    """
    shape = residuals[0].mask.shape
    total, number = np.zeros((2, *shape))
    square = 0.0
    for one in residuals:
        squares = (one.z**2 * one.mask).reshape(-1, *shape)
        mean = float(squares.sum() / max(one.mask.sum() * len(squares), 1))
        relative = np.where(one.mask, squares / max(mean, np.finfo(float).tiny) - 1, 0.0)
        total, number = total + relative.sum(0), number + len(squares) * one.mask
        square += float(np.sum(relative**2))
    usual = inflation**2 * square / max(float(number.sum()), 1.0)  # variance of a relative square
    found: list[tuple[str, float, float, int, tuple[float, ...]]] = [
        (name, *_of_classes(total, number, group, usual)) for name, group in GROUPS.items()
    ]
    found.append(("field", *_of_field(total, number, usual)))
    best = max(found, key=lambda one: one[1])
    name, excess, deviation, freedom, factors = best
    if excess < CHANCE:
        return Pattern()
    error = float(np.sqrt(usual / number.sum()) * np.sqrt(freedom))
    return Pattern(name, deviation, error, factors)


def _of_classes(
    total: Image, number: Image, group: Groups, usual: float
) -> tuple[float, float, int, tuple[float, ...]]:
    """Return excess χ² in standard errors, relative deviation (rms), degrees of freedom, and the factor of each class."""
    y, x = np.indices(total.shape)
    label = group(y, x, total.shape).ravel()
    count = np.bincount(label, number.ravel())
    if len(count) < 2 or count.min() < LEAST_PIXELS:
        return 0.0, 0.0, 0, ()
    mean = np.bincount(label, total.ravel()) / count
    mean -= np.average(mean, weights=count)
    freedom = len(mean) - 1
    squared = float(np.sum(count * mean**2)) / usual
    deviation = np.sqrt(max(squared - freedom, 0.0) * usual / count.sum())
    return (squared - freedom) / np.sqrt(2 * freedom), float(deviation), freedom, tuple(float(1 + one) for one in mean)


def _of_field(total: Image, number: Image, usual: float) -> tuple[float, float, int, tuple[float, ...]]:
    """Return the same for a second-order polynomial of the position, without factors."""
    y, x = (index / max(size - 1, 1) - 0.5 for index, size in zip(np.indices(total.shape), total.shape, strict=True))
    weight = number.ravel()
    if weight.sum() < 10 * LEAST_PIXELS or min(total.shape) < 8:
        return 0.0, 0.0, 0, ()
    terms = np.stack([term.ravel() for term in (x, y, x * x, x * y, y * y)])
    terms -= (terms @ weight / weight.sum())[:, None]
    moment = terms @ (total.ravel() - weight * total.sum() / weight.sum())
    explained = float(moment @ np.linalg.solve(terms * weight @ terms.T, moment)) / usual
    freedom = len(terms)
    deviation = np.sqrt(max(explained - freedom, 0.0) * usual / weight.sum())
    return (explained - freedom) / np.sqrt(2 * freedom), float(deviation), freedom, ()
