"""Noise that differs between parts of the field: shading corrections, gains of amplifiers, rows, columns or colour filters."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.exposures.frames import Image
from calibration.exposures.scaling import VarianceLine
from calibration.registration.aligned import MINIMUM_PIXELS, Residual
from calibration.tolerances import CLEAR
from noiseflow.described import described
from noiseflow.statistics import rare_chi_squared

PARTS = 64  # most levels of the noise, and tiles along an axis, that are compared
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
        relative, error: relative deviation (rms) of the variance, and its standard error; 0 if not significant.
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
    total, number, alone, fourth = np.zeros((4, *shape))
    tables = []
    for one in residuals:
        squares = (one.z**2 * one.mask).reshape(-1, *shape)
        mean = max(float(squares.sum()) / max(float(one.mask.sum()) * len(squares), 1.0), np.finfo(float).tiny)
        relative = np.where(one.mask, squares / mean - 1, 0.0)
        total, number = total + relative.sum(0), number + len(squares) * one.mask
        fourth = fourth + (scatter := inflation**2 * (relative**2).sum(0))
        own = relative.sum(0)
        if one.expected is not None:  # the smooth level is too high beside bright parts of a scene
            own -= np.where(one.mask, one.expected / one.expected[one.mask].mean() - 1, 0.0) * len(squares)
        alone = alone + own
        tables.append(_by_quadrant(one, (own, len(squares) * one.mask, scatter)))
    table, places = np.sum(tables, axis=0), [np.array([0, size - 1]) for size in shape]
    slopes = [_slopes_by_quadrant(one, inflation) for one in residuals if one.level is not None]
    both = [table, *(sum(slopes[1:], one) for one in slopes[:1])]
    found = [(name, *_of_classes(shape, group, one, places)) for one in both for name, group in AMPLIFIERS.items()]
    # only classes that are everywhere see the same scene, so that the line of variance may replace the levels
    table = np.stack([_summed(one, _cells) for one in (alone, number, fourth)], -1)[None]
    places = [np.unique(_cells(size), return_index=True)[1] for size in shape]
    found += [(name, *_of_classes(shape, group, table, places)) for name, group in MOSAICS.items()]
    found.append(("field", *_of_field(*(_summed(one, _tiles) for one in (total, number, fourth)))))
    name, rarity, deviation, error, factors = max(found, key=lambda one: one[1])
    return Pattern(name, deviation, error, factors) if rarity > 1 else Pattern()


Found = tuple[float, float, float, tuple[float, ...]]
"""χ² over one that is rare by chance, relative deviation (rms) and its standard error, factors of the classes."""


def _by_quadrant(one: Residual, images: Sequence[Any]) -> Image:
    """Sums of images over the pixels of equal expected noise in each quadrant, (level, 2, 2, images)."""
    spread = one.spread[one.mask] if one.signal is not None else np.zeros(one.mask.sum())  # flats are of one level
    level = np.searchsorted(np.quantile(spread, np.arange(1, PARTS) / PARTS), spread)
    return _sums(2 * 2 * level + _quadrants(one.mask), [each[one.mask] for each in images], 2 * 2 * PARTS)


def _slopes_by_quadrant(one: Residual, inflation: float) -> Image:
    """The same of slopes of variance against signal within quadrants, which need no common level; the signal of the neighbours,
    whose noise is not that of the pixel, is the instrument."""
    squares, signal, level = (np.asarray(each)[one.mask] for each in ((one.z * one.spread) ** 2, one.signal, one.level))
    weight, place = VarianceLine.fitted(level, squares).bounded(level) ** -2, _quadrants(one.mask)
    whole, middle = (np.bincount(place, each) for each in (weight, weight * level))
    lever = weight * (level - (middle / np.maximum(whole, np.finfo(float).tiny))[place])
    lever *= len(lever) / (lever @ signal)  # slopes that are determined evenly count as so many pixels
    gain, tails = lever @ squares / len(lever), np.var(one.z[one.mask] ** 2)
    return _sums(
        place, (lever * (squares / gain - signal), lever * signal, tails * (inflation * lever / gain) ** 2 / weight)
    )


def _quadrants(mask: Any) -> Any:
    y, x = (2 * np.arange(size) >= size for size in mask.shape)
    return np.add.outer(2 * y, x)[mask]


def _sums(place: Any, values: Sequence[Image], number: int = 2 * 2) -> Image:
    return np.stack([np.bincount(place, each, number).reshape(-1, 2, 2) for each in values], -1)


def _cells(size: int, *, period: int = 12) -> Any:
    """Cell of each of `size` rows or columns: its remainder by the common multiple of the periods of `MOSAICS`, and its half."""
    place = np.arange(size)
    return place % period + period * (2 * place >= size)


def _summed(image: Image, labels: Callable[[int], Any]) -> Image:
    """Sums over the pixels of equal labels along both axes, which are functions of its size."""
    for _ in range(2):
        label = labels(len(image))
        image = ((np.unique(label)[:, None] == label).astype(float) @ image).T
    return image


def _tiles(size: int) -> Any:
    """Tile of each of `size` rows or columns."""
    return np.arange(size) * min(PARTS, size) // size


def _of_classes(shape: tuple[int, ...], group: Groups, table: Image, places: Sequence[Any]) -> Found:
    """Compare the mean squares of classes at equal level only, as parts of a scene may be of unequal brightness: from the sums,
    (level, row, column, 3), of relative squares, their number and variance, at `places` that stand for all pixels summed."""
    y, x = np.meshgrid(*places, indexing="ij")
    label = group(y, x, shape).ravel()
    classes = (label == np.arange(label.max() + 1)[:, None]).astype(float)
    total, number, fourth = np.moveaxis(classes @ table.reshape(len(table), len(label), -1), -1, 0)
    share, weight, freedom = number / np.maximum(number.sum(1, keepdims=True), 1), number.sum(0), len(classes) - 1
    apart = (np.eye(len(classes)) - share[:, None])[..., 1:]  # (level, class, class) without the first
    both, scatter = (np.einsum("lk,lkc,lkd->cd", one, apart, apart) for one in (number, fourth))
    moment = np.einsum("lk,lkc->c", total, apart)
    if not freedom or min(weight.min(), np.diag(both).min()) < MINIMUM_PIXELS:
        return 0.0, 0.0, 0.0, ()
    centred = (np.eye(len(classes)) - weight / weight.sum())[:, 1:] @ np.linalg.inv(both)
    mean = centred @ moment
    usual = float(np.average(np.diag(centred @ scatter @ centred.T), weights=weight))
    chi_squared = float(moment @ np.linalg.solve(scatter, moment))
    deviation = np.sqrt(max(float(np.average(mean**2, weights=weight)) - usual, 0.0))
    factors = tuple(float(1 + one) for one in mean)
    return chi_squared / rare_chi_squared(CLEAR, freedom), float(deviation), float(np.sqrt(usual)), factors


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
    return chi_squared / rare_chi_squared(CLEAR, freedom), float(deviation), float(np.sqrt(usual)), ()
