"""Noise that differs between parts of the field: shading corrections, gains of amplifiers, rows, columns or colour filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.detector.residual import Residual
from calibration.exposures.frames import Image
from calibration.registration.aligned import MINIMUM_PIXELS
from calibration.tolerances import STANDS_OUT
from noiseflow.described import described

PERIOD = 12
"""Smallest common multiple of the periods of `MOSAICS`, pixels."""

Groups = Callable[[Any, Any, tuple[int, ...]], Any]


def _modulo(axis: int, period: int) -> Groups:
    return lambda y, x, shape: (y, x)[axis] % period


AMPLIFIERS: dict[str, Groups] = {
    "left and right halves": lambda y, x, shape: (2 * x >= shape[1]).astype(int),
    "upper and lower halves": lambda y, x, shape: (2 * y >= shape[0]).astype(int),
    "quadrants": lambda y, x, shape: 2 * (2 * y >= shape[0]) + (2 * x >= shape[1]),
}
"""Parts of the field that may have amplifiers of their own: functions of row, column and frame shape."""

MOSAICS: dict[str, Groups] = {
    "every second column": _modulo(1, 2),
    "every second row": _modulo(0, 2),
    "2 × 2 mosaic": lambda y, x, shape: 2 * (y % 2) + x % 2,
    "every third column": _modulo(1, 3),
    "every third row": _modulo(0, 3),
    "every fourth column": _modulo(1, 4),
    "every fourth row": _modulo(0, 4),
}
"""Classes of pixels that repeat, and may have amplifiers or filters of their own."""


@described(relative="of the noise variance", error="of the noise variance")
@dataclass(frozen=True)
class Pattern:
    """Dependence of the noise variance on the place, at equal signal.

    Attributes:
        name: ``"field"`` for a smooth dependence, else one of `AMPLIFIERS` or `MOSAICS`; empty if there is none.
        relative: relative deviation (rms) of the variance; 0 if not significant.
        error: its standard error.
        factors: (C,) variance of each class over the mean.
    """

    name: str = ""
    relative: float = 0.0
    error: float = 0.0
    factors: tuple[float, ...] = ()


def pattern_of(residuals: Sequence[Residual], *, inflation: float = 1.0) -> Pattern:
    """Find the pattern that explains most of the differences of the noise variance over the field, in standardised residuals of
    frames of equal size. Correlation between pixels multiplies the standard error of a variance by `inflation`."""
    shape = residuals[0].mask.shape
    total, number, known, fourth = np.zeros((4, *shape))
    for one in residuals:
        squares = (one.z**2 * one.mask).reshape(-1, *shape)
        mean = max(float(squares.sum()) / max(float(one.mask.sum()) * len(squares), 1.0), np.finfo(float).tiny)
        relative = np.where(one.mask, squares / mean - 1, 0.0)
        total, number = total + relative.sum(0), number + len(squares) * one.mask
        fourth = fourth + inflation**2 * (relative**2).sum(0)
        if one.expected is not None:
            known = known + np.where(one.mask, one.expected / one.expected[one.mask].mean() - 1, 0.0) * len(squares)
    sums = [_by_class(one) for one in (total, number, fourth, total - known)]
    found = [(name, *_of_classes(shape, group, *sums[:3])) for name, group in AMPLIFIERS.items()]
    # only classes that are everywhere see the same scene, so that the line of variance may replace the levels
    found += [(name, *_of_classes(shape, group, sums[3], *sums[1:3])) for name, group in MOSAICS.items()]
    found.append(("field", *_of_field(*(_by_tile(one) for one in (total, number, fourth)))))
    name, excess, deviation, error, factors = max(found, key=lambda one: one[1])
    return Pattern(name, deviation, error, factors) if excess > STANDS_OUT else Pattern()


Found = tuple[float, float, float, tuple[float, ...]]
"""Excess of χ² in its standard errors, relative deviation (rms) and its standard error, factors of the classes."""


def _cells(size: int) -> Any:
    """Cell of each of `size` rows or columns: its remainder by `PERIOD`, and its half."""
    place = np.arange(size)
    return place % PERIOD + PERIOD * (2 * place >= size)


def _by_class(image: Image) -> Image:
    """Sums over pixels that no pattern distinguishes: (2·`PERIOD`, 2·`PERIOD`) rows and columns of equal remainder and half."""
    for _ in range(2):
        image = ((_cells(len(image)) == np.arange(2 * PERIOD)[:, None]).astype(float) @ image).T
    return image


def _by_tile(image: Image, *, most: int = 64) -> Image:
    """Sums over tiles, at most so many along an axis."""
    for _ in range(2):
        number = min(most, len(image))
        image = np.add.reduceat(image, np.arange(number) * len(image) // number, axis=0).T
    return image


def _of_classes(shape: tuple[int, ...], group: Groups, total: Image, number: Image, fourth: Image) -> Found:
    """Compare the mean squares of classes; `fourth` is the sum of squared relative squares, the variance of `total`."""
    rows, columns = (np.zeros(2 * PERIOD, int) for _ in range(2))
    for places, size in ((rows, shape[0]), (columns, shape[1])):
        places[_cells(size)] = np.arange(size)  # any pixel of a cell stands for it
    y, x = np.meshgrid(rows, columns, indexing="ij")
    label = group(y, x, shape).ravel()
    count = np.bincount(label, number.ravel())
    if len(count) < 2 or count.min() < MINIMUM_PIXELS:
        return 0.0, 0.0, 0.0, ()
    mean = np.bincount(label, total.ravel()) / count
    mean -= np.average(mean, weights=count)
    variance = np.bincount(label, fourth.ravel()) / count**2
    freedom = len(mean) - 1
    chi_squared = float(np.sum(mean**2 / np.maximum(variance, np.finfo(float).tiny))) * freedom / len(mean)
    usual = float(np.average(variance, weights=count)) * freedom
    deviation = np.sqrt(max(float(np.average(mean**2, weights=count)) - usual, 0.0))
    factors = tuple(float(1 + one) for one in mean)
    return (chi_squared - freedom) / np.sqrt(2 * freedom), float(deviation), float(np.sqrt(usual)), factors


def _of_field(total: Image, number: Image, fourth: Image) -> Found:
    """Fit a second-order polynomial of the position, with errors that allow for another scatter in each pixel (White)."""
    if number.sum() < 2 * MINIMUM_PIXELS or min(total.shape) < 8:
        return 0.0, 0.0, 0.0, ()
    y, x = (index / max(size - 1, 1) - 0.5 for index, size in zip(np.indices(total.shape), total.shape, strict=True))
    weight = number.ravel()
    terms = np.stack([term.ravel() for term in (x, y, x * x, x * y, y * y)])
    terms -= (terms @ weight / weight.sum())[:, None]
    gram = np.linalg.inv(terms * weight @ terms.T)
    coefficients = gram @ (terms @ (total.ravel() - weight * total.sum() / weight.sum()))
    covariance = gram @ (terms * fourth.ravel() @ terms.T) @ gram
    freedom = len(terms)
    chi_squared = float(coefficients @ np.linalg.solve(covariance, coefficients))
    shape = coefficients @ terms
    usual = float(np.sum(weight * np.einsum("ip,ij,jp->p", terms, covariance, terms)) / weight.sum())
    deviation = np.sqrt(max(float(np.average(shape**2, weights=weight)) - usual, 0.0))
    return (chi_squared - freedom) / np.sqrt(2 * freedom), float(deviation), float(np.sqrt(usual)), ()
