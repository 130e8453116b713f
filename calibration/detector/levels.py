"""Signal levels: histograms of pixel values with similar signal, as the likelihood requires, of residuals or of pixel values.

The latter keep what residuals blur: codes, clipping, and single-electron peaks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image
from calibration.exposures.scaling import VarianceLine, groups_of, one_sigma
from calibration.tolerances import CERTAIN, CLIPPED, PEAK

NUM_BINS = 128
"""Number of bins in the residual histogram of a level."""


class NotMeasurable(ValueError):
    """Raised if the exposures do not determine the detector's gain; a noise model can still be fitted."""


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
        rows += _with_darkest([_residual_level(dithered, group, octave[group]) for group in groups], one)
    most = max(len(row["parts"]) for row in rows)
    for row in rows:
        row["parts"] = np.pad(row["parts"], ((0, most - len(row["parts"])), (0, 0)))
    return _gathered(rows, readings, absolute=False)


def _gathered(rows: list[dict[str, Any]], readings: Sequence[Readings], *, absolute: bool) -> Levels:
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    known = {one.scale.pair: one.scale for one in readings if one.scale}
    scales = tuple(known.get(pair, Scale(pair, 1.0, 0.0, 0.0)) for pair in range(max(known, default=0) + 1))
    return Levels(**columns, scales=scales, absolute=absolute)


def _with_darkest(rows: list[dict[str, Any]], one: Readings) -> list[dict[str, Any]]:
    """Add the darkest signal of the exposure to its first level."""
    if rows:
        rows[0]["darkest"], rows[0]["darkest_error"] = one.darkest()
    return rows


def _constants(one: Readings) -> dict[str, Any]:
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
    return _constants(one) | found


def collect_cells(readings: Sequence[Readings], *, guess: tuple[float, float, float]) -> Levels:
    """Sort pixel values by their estimated signal and compute histograms on the converter's codes.

    These histograms keep what residuals blur: rounding, clipping and single-electron peaks. Selection by a noisy estimate causes
    regression of the true signals towards more frequent signals, which `true_moments` quantifies, for a `guess` of gain, offset
    and read noise that defines the levels, too.

    Raises:
        NotMeasurable: no level has enough pixel values.
    """
    rows = [row for one in readings for row in _cell_levels(one, *guess)]
    if not rows:
        raise NotMeasurable("too few pixels of each brightness are left to compare; use larger or unsaturated frames")
    cells = max(len(row["histogram"]) for row in rows)
    for row in rows:
        row["histogram"] = np.pad(row["histogram"], (0, cells - len(row["histogram"])))
    return _gathered(rows, readings, absolute=True)


def _cell_levels(
    one: Readings, gain: float, offset: float, read_noise: float, *, width: float = 0.8, least: int = 100
) -> list[dict[str, Any]]:
    """Levels of at least so many pixel values, `width` standard deviations of the noise wide."""
    signal = one.signal
    low, high, beyond = np.percentile(signal, (0.05, 99.8, 99.99))
    grid = np.linspace(low, beyond, 1500)
    shot, read = gain * np.maximum(grid - offset, 0.0), (gain * read_noise) ** 2
    deviation = np.sqrt(np.maximum(shot + read + one.step**2 / 12, 0.05 * gain**2))
    steps = np.concatenate([[0.0], np.cumsum(np.diff(grid) * 0.5 * (1 / deviation[1:] + 1 / deviation[:-1]))])
    last = float(np.interp(high, grid, steps))
    number = int(np.clip(np.ceil(last / width), 8, 40))
    edges = np.interp(np.linspace(0, last, number + 1), steps, grid)
    normal = one.read_share * read + one.rounded
    own = one.shot_share * shot + normal
    blur = np.maximum(np.sqrt(own) / 4, grid[1] - grid[0])
    density = _density(signal, grid, blur)
    moments = true_moments(grid - offset, density, one.shot_share * gain, normal)
    index = np.searchsorted(edges, signal) - 1
    place = np.searchsorted(edges, grid, side="right") - 1
    rows = []
    for level in range(number):
        group, cells = np.flatnonzero(index == level), place == level
        if len(group) < least or cells.sum() < 3:
            continue
        row = _cells(one, group, float(np.interp(signal[group].mean(), grid, deviation)), float(deviation.min()) / 5)
        noise = float(np.average(own[cells], weights=density[cells]))
        if noise > 0:
            mass, first, second = (float(moment[cells].sum()) for moment in moments)
            mean = float(np.average(grid[cells], weights=density[cells]))
            about = float(np.average((grid[cells] - mean) ** 2, weights=density[cells]))
            excess = (second / mass - (first / mass) ** 2 - about) / noise
            row |= {"own": noise, "shift": first / mass + offset - mean, "excess": excess}
        rows.append(row)
    return _with_darkest(rows, one)


def true_moments(estimate: Image, density: Image, unit: float, variance: float) -> tuple[Image, Image, Image]:
    """Return the density of noisy estimates times 1, the mean and the mean square of the true values given the estimate.

    An estimate is a Poisson count of mean true/unit, times unit, plus Gaussian noise. Robbins' and Tweedie's formulas
    (doi:10.1198/jasa.2011.tm11181) give the moments of the true values from the density of the estimates alone.

    Args:
        estimate: (N,) evenly spaced values above the offset, counts.
        density: (N,) density of the estimates.
        unit: counts of the estimate per electron of the long exposure; 0 without Poisson noise.
        variance: variance of the Gaussian noise, counts².
    """

    def times_truth(values: Image) -> Image:
        gaussian = estimate * values + variance * np.gradient(values, estimate)
        return np.asarray(np.interp(estimate + unit, estimate, gaussian, right=0.0))

    first = times_truth(density)
    return density, first, times_truth(first)


def _cells(
    one: Readings, group: NDArray[np.int64], deviation: float, finest: float, *, most: int = 512
) -> dict[str, Any]:
    """Histogram of the pixel values of one level on whole rounding steps, wide enough to include the noise."""
    observation, signal = one.observation[group], one.signal[group]
    span = 2 * CERTAIN * deviation
    width = max(min(deviation / 6, finest), span / most)
    if one.step:
        width = one.step * max(1.0, np.ceil(width / one.step - 0.5))
    cells = max(32, 2 ** int(np.ceil(np.log2(span / width))))
    origin = float(signal.mean()) - 0.45 * cells * width
    if one.step:
        origin = observation[0] + one.step * (np.round((origin - observation[0]) / one.step) - 0.5)
    index = np.floor((observation - origin) / width)
    inside = (index >= 0) & (index < cells)
    return {
        "signal": float(signal.mean()),
        "spread": float(np.var(signal)),
        "variance": float(np.var((observation - signal)[inside])),
        "count": float(inside.sum()),
        "width": width,
        "origin": origin,
        "histogram": np.bincount(index[inside].astype(int), minlength=cells).astype(float),
    } | _constants(one)


def _density(values: Image, at: Image, blur: Image) -> Image:
    """Kernel density estimate, in pixel values per count, at the increasing values `at` with bandwidths `blur`."""
    count, edges = np.histogram(values, bins=4000)
    centre, found = 0.5 * (edges[1:] + edges[:-1]), np.empty_like(at)
    for part in np.array_split(np.arange(len(at)), 32):  # of which each sees its neighbourhood only
        reach = CERTAIN * blur[part].max()
        near = slice(*np.searchsorted(centre, (at[part[0]] - reach, at[part[-1]] + reach)))
        found[part] = np.exp(-0.5 * ((centre[near] - at[part, None]) / blur[part, None]) ** 2) @ count[near]
    return np.asarray(found / (blur * np.sqrt(2 * np.pi)))


def electrons_show(levels: Sequence[Levels], gain: float) -> bool:
    """Test whether histograms of pixel values have peaks one `gain` apart, as for a read noise below about 0.4 e⁻ rms.

    Their power is N·|mean of exp(2πi·value/gain)|²; a search tries a few hundred gains. Histograms of residuals are ignored,
    because the noise of the signals blurs the peaks, and levels with clipped values, whose peak at the limit has power at every
    distance. Below two rounding steps, peaks cannot be distinguished from codes.
    """
    total, count = 0j, 0.0
    for one in levels:
        fine = one.absolute & (np.maximum(one.width, one.step) < gain / 2) & (one.clipped() < CLIPPED)
        place = one.origin[fine, None] + one.width[fine, None] * (np.arange(one.histogram.shape[1]) + 0.5)
        total += complex(np.sum(one.histogram[fine] * np.exp(2j * np.pi * place / gain)))
        count += float(one.histogram[fine].sum())
    return count > 0 and abs(total) ** 2 / count > PEAK
