"""Signal levels: histograms of pixel values with similar signal, as required by the detector's likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image
from calibration.exposures.scaling import VarianceLine, groups_of, one_sigma
from calibration.tolerances import CERTAIN

NUM_BINS = 128
"""Number of bins in the residual histogram of a level."""


@dataclass(frozen=True)
class Readings:
    """Pixel values of one exposure with an independent estimate of their signal.

    Attributes:
        observation: (N,) counts.
        signal: (N,) estimate of the expected observation, counts.
        level: (N,) sort key of the pixels, independent of the noise of both: the signal of the neighbours.
        shot_share, read_share: variances of shot noise and read noise of the estimate over those of the observation.
        weight: independent information per pixel value; below 1 if pixel values share their estimates.
        step: rounding step of the observation, counts; 0 if it is not rounded.
        rounded: variance of the estimate by the rounding of the long exposure and its dither, counts².
        rails: lower and upper clipping limits of the converter, counts; infinite if there is none.
        scale: scaling of the signals, see `Scale`; None if the mean of each level is taken from its pixel values.
    """

    observation: Image
    signal: Image
    level: Image
    shot_share: float
    read_share: float
    weight: float
    step: float
    rounded: float
    rails: tuple[float, float] = (-np.inf, np.inf)
    scale: Scale | None = None

    def darkest(self, *, number: int = 64) -> tuple[float, float]:
        """Return the mean signal of the pixels with the darkest neighbours, and its standard error, counts."""
        signal = self.signal[np.argpartition(self.level, min(number, len(self.level) - 1))[:number]]
        return float(signal.mean()), float(np.hypot(signal.std(), self.step) / np.sqrt(len(signal)))

    def rescaled(self, scale: Scale) -> Readings:
        """Return the same pixel values with signals computed by another scaling of the same long exposure."""
        old = self.scale or scale
        factor = scale.slope / old.slope
        signal = factor * (self.signal - old.intercept) + scale.intercept
        return replace(self, signal=signal, scale=scale)


@dataclass(frozen=True)
class Scale:
    """Scaling of the long exposure of one pair to signals; the likelihood treats it as uncertain.

    Attributes:
        pair: number of the pair.
        slope, intercept: signal = slope·long + intercept, counts.
        centre: central signal, counts.
        common_offset: whether both exposures were recorded at one detector setting, so that intercept = offset·(1 − slope).
        gains: signal without light, counts, variance of the residuals by the gains of pixels, over its square above that, and
            the relative error of this variance.
    """

    pair: int
    slope: float
    intercept: float
    centre: float
    common_offset: bool = False
    gains: tuple[float, ...] = ()

    def rescaled(self, factor: float, shift: float) -> Scale:
        """Return the scaling after the transformation signal → factor·signal + shift."""
        moved = {name: factor * getattr(self, name) + shift for name in ("intercept", "centre")}
        return replace(self, slope=factor * self.slope, **moved)


@dataclass(frozen=True)
class Levels:
    """Histograms at L signal levels, of residuals (observation − signal) or of pixel values.

    Attributes:
        signal: (L,) mean signal, counts.
        spread: (L,) variance of the true signals within the level, counts²; in histograms of pixel values, variance of the
            estimated signals.
        parts: (L, J, 3) share of each part of the level, 0 if there is none, mean and variance of its true signals about that of
            the level, counts and counts².
        variance: (L,) variance of observation − signal, counts².
        fourth: (L,) fourth central moment of observation − signal over the square of that; 3 in histograms of pixel values.
        count: (L,) number of pixel values.
        width: (L,) width of a histogram cell, counts.
        origin: (L,) left edge of the first cell, counts.
        histogram: (L, cells) number of pixel values per cell.
        shot_share, read_share, weight, step, rounded: (L,) as in `Readings`.
        low, high: (L,) clipping limits, counts; their cells include all pixel values beyond them.
        own: (L,) noise variance of the estimate for which `shift` and `excess` are given, counts².
        shift: (L,) mean true signal minus mean estimate, counts.
        excess: (L,) variance of the true signals minus that of the estimates, in units of `own`.
        darkest, darkest_error: (L,) signal of the darkest pixels of an exposure and its standard error, counts, at its first
            level; infinite at the other levels.
        scales: scalings of the pairs.
        scale: (L,) index into `scales`; −1 if the mean of the level is taken from its pixel values.
        absolute: whether the histograms are of pixel values.
    """

    signal: Image
    spread: Image
    parts: Image
    variance: Image
    fourth: Image
    count: Image
    width: Image
    origin: Image
    histogram: Image
    shot_share: Image
    read_share: Image
    weight: Image
    step: Image
    rounded: Image
    low: Image
    high: Image
    own: Image
    shift: Image
    excess: Image
    darkest: Image
    darkest_error: Image
    scale: NDArray[np.int64]
    scales: tuple[Scale, ...] = ()
    absolute: bool = False

    @property
    def scaling(self) -> tuple[Image, Image]:
        """(L,) slope and (L,) intercept, counts, of the scaling of each level."""
        scales = [self.scales[index] for index in self.scale]
        return np.array([one.slope for one in scales]), np.array([one.intercept for one in scales])

    @property
    def common(self) -> NDArray[np.bool_]:
        """(L,) whether both exposures have the same offset."""
        return np.array([index >= 0 and self.scales[index].common_offset for index in self.scale])

    def by_gains(self) -> tuple[Image, Image]:
        """Return the (L,) variance of the residuals by the gains of pixels and by rounded estimates, and its error, which all
        levels share, counts²."""
        known = [self.scales[index].gains if index >= 0 else () for index in self.scale]
        dark, factor, unsure = np.array([each or (0.0, 0.0, 0.0) for each in known]).T
        found = factor * ((self.signal - dark) ** 2 + self.spread)
        return found + self.rounded, unsure * found

    def clipped(self) -> Image:
        """Return the (L,) share of pixel values in the cell of a clipping limit."""
        width = self.width[:, None]
        left = self.origin[:, None] + width * np.arange(self.histogram.shape[1])
        rails = self.low[:, None], self.high[:, None]
        held = sum(np.where((left <= rail) & (rail < left + width), self.histogram, 0.0).sum(1) for rail in rails)
        return np.asarray(held / self.count if self.absolute else np.zeros_like(self.signal))

    def rescaled(self, change: dict[int, tuple[float, float]]) -> Levels:
        """Return the levels after the transformation signal → factor·signal + shift for some scalings.

        Args:
            change: factor and shift by index of the scaling.
        """
        factor, shift = np.ones_like(self.signal), np.zeros_like(self.signal)
        scales = list(self.scales)
        for index, (times, plus) in change.items():
            if index not in self.scale:
                continue
            factor[self.scale == index], shift[self.scale == index] = times, plus
            scales[index] = scales[index].rescaled(times, plus)
        signal, darkest = (factor * one + shift for one in (self.signal, self.darkest))
        moved = self.origin if self.absolute else self.origin + self.signal - signal
        parts = self.parts * np.stack([np.ones_like(factor), factor, factor**2], -1)[:, None]
        scaled = {name: factor * getattr(self, name) for name in ("shift", "darkest_error")}
        scaled["spread"] = factor**2 * self.spread
        rest: dict[str, Any] = {"signal": signal, "origin": moved, "parts": parts, "darkest": darkest}
        return replace(self, scales=tuple(scales), **scaled, **rest)


def collect_levels(readings: Sequence[Readings], *, num_levels: int = 16, least: int = 200) -> Levels:
    """Sort pixel values into levels of similar signal and compute the histograms of their residuals.

    Pixels are sorted by the signal of their neighbours, which is independent of their own noise. Rounded values are dithered by
    one step to avoid aliasing with the bins; the likelihood accounts for the dither.

    Args:
        readings: pixel values of one detector setting; each item is sorted into levels of its own.
        num_levels: largest number of levels per exposure.
        least: smallest number of pixel values per level.
    """
    rows = []
    generator = np.random.default_rng(0)
    for one in readings:
        dither = one.step * (generator.random(one.observation.shape) - 0.5)
        dithered = replace(one, observation=one.observation + dither)
        groups = groups_of(one.level, num_levels, least)
        weight = 1 / VarianceLine.fitted(one.signal, (one.observation - one.signal) ** 2).bounded(one.signal) ** 2
        octave = np.log2(weight.max() / weight).astype(int) // 2
        rows += with_darkest([_residual_level(dithered, group, octave[group]) for group in groups], one)
    most = max(len(row["parts"]) for row in rows)
    for row in rows:
        row["parts"] = np.pad(row["parts"], ((0, most - len(row["parts"])), (0, 0)))
    return gathered(rows, readings, absolute=False)


def gathered(rows: list[dict[str, Any]], readings: Sequence[Readings], *, absolute: bool) -> Levels:
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    known = {one.scale.pair: one.scale for one in readings if one.scale}
    scales = tuple(known.get(pair, Scale(pair, 1.0, 0.0, 0.0)) for pair in range(max(known, default=0) + 1))
    return Levels(**columns, scales=scales, absolute=absolute)


def with_darkest(rows: list[dict[str, Any]], one: Readings) -> list[dict[str, Any]]:
    """Add the darkest signal of the exposure to its first level."""
    if rows:
        rows[0]["darkest"], rows[0]["darkest_error"] = one.darkest()
    return rows


def constants(one: Readings) -> dict[str, Any]:
    names = ("shot_share", "read_share", "weight", "step", "rounded")
    rails = {"low": one.rails[0], "high": one.rails[1]}
    rest: dict[str, Any] = {"own": 1.0, "shift": 0.0, "excess": 0.0, "fourth": 3.0}
    rest |= {"darkest": np.inf, "darkest_error": 1.0, "parts": np.zeros((0, 3))}
    return {name: getattr(one, name) for name in names} | rails | rest | {"scale": one.scale.pair if one.scale else -1}


def _residual_level(
    one: Readings, group: NDArray[np.int64], octave: NDArray[np.int64], *, least: int = 25
) -> dict[str, Any]:
    """Histogram of the residuals of a group, and the law of its signals in parts of one `octave` of their variances each."""
    enough = (number := np.bincount(octave)) >= min(least, number.max())
    group, octave = group[enough[octave]], octave[enough[octave]]
    observation, signal = one.observation[group], one.signal[group]
    residual = observation - signal
    tiny = float(np.finfo(float).tiny)
    spreads = (np.ptp(one_sigma(residual[octave == part])) / 2 for part in np.flatnonzero(enough))
    robust = max(one.step / np.sqrt(12), tiny, *spreads)
    kept = residual[np.abs(residual - np.median(residual)) < CERTAIN * robust]  # values beyond are defects
    width = 2 * CERTAIN * robust / NUM_BINS
    middle = float(kept.mean())
    index = (kept - (0.0 if one.scale else middle)) / width + NUM_BINS / 2
    histogram = np.bincount(index.clip(0, NUM_BINS - 1).astype(int), minlength=NUM_BINS).astype(float)
    variance = float(np.mean(squares := (kept - middle) ** 2))
    own, scatter = one.shot_share / (1 + one.shot_share) * variance, float(np.var(signal))
    spread = max(scatter - own, 0.0)
    away = np.sqrt(spread / max(scatter, tiny)) * (signal - signal.mean())  # without their own noise
    mean, square = (np.bincount(octave, each, len(number))[enough] / number[enough] for each in (away, away**2))
    found: dict[str, Any] = {
        "signal": float(signal.mean()),
        "spread": spread,
        "parts": np.column_stack([number[enough] / len(group), mean, np.maximum(square - mean**2, 0.0)]),
        "variance": variance,
        "fourth": float(np.mean(squares**2)) / max(variance, tiny) ** 2,
        "count": float(len(kept)),
        "width": width,
        "origin": -width * NUM_BINS / 2,
        "histogram": histogram,
    }
    return constants(one) | found
