"""Signal levels: the pixel values of like signal, counted into histograms that hold all the detector's likelihood needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image

NUM_LEVELS = 16
"""Signal levels into which the pixels of a pair are sorted, equally filled."""

NUM_BINS = 128
"""Bins of each level's residual histogram."""

REACH = 8.0
"""Standard deviations of the residual that the histogram covers either way; pixel values beyond it are defects, not
noise."""


NUM_DARKEST = 64
"""Pixels whose mean signal stands for the darkest of a scene: few enough to be the darkest, and known to an eighth of their
scatter."""


@dataclass(frozen=True)
class Readings:
    """Pixel values of one exposure beside an independent estimate of their signal.

    Attributes:
        observation: (N,) counts.
        signal: (N,) estimate of its expectation, counts.
        level: (N,) what sorts the pixels, known without the noise of either: the neighbours' signal.
        shot_share: variance of the estimate's shot noise over that of the observation.
        read_share: the same for read noise.
        weight: independent information per pixel value, 1 unless pixel values share their estimates.
        dark: taken without light: read noise alone.
        step: rounding step of the observation, counts; 0 if it is not rounded.
        rails: the converter's lower and upper clipping limit, counts; infinite where there is none.
        scale: whose signals they are, see `Scale`; None where each level's mean is taken from its pixel values.
    """

    observation: Image
    signal: Image
    level: Image
    shot_share: float = 0.0
    read_share: float = 0.0
    weight: float = 1.0
    dark: bool = False
    step: float = 1.0
    rails: tuple[float, float] = (-np.inf, np.inf)
    scale: Scale | None = None

    def darkest(self) -> tuple[float, float]:
        """Mean signal of the pixels whose neighbours are the darkest, and its standard error."""
        signal = self.signal[np.argsort(self.level)[:NUM_DARKEST]]
        return float(signal.mean()), float(np.hypot(signal.std(), self.step) / np.sqrt(len(signal)))

    def rescaled(self, scale: Scale) -> Readings:
        """The same pixel values with their signals on another scale of the same long exposure."""
        old = self.scale or scale
        factor = scale.slope / old.slope
        signal = factor * (self.signal - old.intercept) + scale.intercept
        return replace(self, signal=signal, scale=scale)


@dataclass(frozen=True)
class Scale:
    """How the signals of one exposure pair came from its long exposure, so that the likelihood may doubt it.

    Attributes:
        pair: number of the pair.
        slope, intercept: signal = slope·long + intercept, counts.
        centre: a signal in the middle, counts.
        common_offset: one detector setting took both exposures, so that intercept = offset·(1 − slope).
    """

    pair: int
    slope: float
    intercept: float
    centre: float = 0.0
    common_offset: bool = False

    def rescaled(self, factor: float, shift: float) -> Scale:
        """When the signals become factor·signal + shift."""
        moved = {name: factor * getattr(self, name) + shift for name in ("intercept", "centre")}
        return replace(self, slope=factor * self.slope, **moved)


@dataclass(frozen=True)
class Levels:
    """Histograms at L signal levels, of residuals (observation − signal), or of the pixel values themselves.

    Attributes:
        signal: (L,) mean signal, counts.
        spread: (L,) variance of the true signals within the level, counts²; in histograms of pixel values that of the
            estimated ones.
        variance: (L,) variance of observation − signal, counts².
        count: (L,) pixel values.
        width: (L,) of a histogram cell, counts.
        origin: (L,) left edge of the first cell, counts.
        histogram: (L, cells) pixel values.
        shot_share, read_share, weight, dark, step: (L,) as in `Readings`.
        low, high: (L,) clipping limits; the cells that hold them hold all pixel values beyond them too.
        own: (L,) variance of the estimate's own noise that the next two go by, counts².
        shift: (L,) how far the mean true signal lies above the mean estimate, counts.
        excess: (L,) by how many times `own` the true signals' variance exceeds that of the estimates.
        darkest, darkest_error: (L,) signal of the darkest pixels of an exposure and its standard error, counts, beside its first
            level; infinite beside the others, and where no light was.
        scales: of the pairs.
        scale: (L,) index into `scales`; −1 where the mean of the level is its pixel values' own.
        absolute: the histograms are of the pixel values themselves.
    """

    signal: Image
    spread: Image
    variance: Image
    count: Image
    width: Image
    origin: Image
    histogram: Image
    shot_share: Image
    read_share: Image
    weight: Image
    dark: Image
    step: Image
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
    def slope(self) -> Image:
        """(L,) slope of each level's scale."""
        return np.array([self.scales[index].slope for index in self.scale])

    @property
    def intercept(self) -> Image:
        """(L,) intercept of each level's scale, counts."""
        return np.array([self.scales[index].intercept for index in self.scale])

    @property
    def common(self) -> NDArray[np.bool_]:
        """(L,) whether the offset is that of both exposures."""
        return np.array([index >= 0 and self.scales[index].common_offset for index in self.scale])

    def clipped(self) -> Image:
        """(L,) share of the pixel values in a clipping limit's cell."""
        cell = [
            np.floor((np.nan_to_num(rail, posinf=-1e300, neginf=-1e300) - self.origin) / self.width)
            for rail in (self.low, self.high)
        ]
        rows, cells = np.arange(len(self.signal)), self.histogram.shape[1]
        held = [
            np.where((index >= 0) & (index < cells), self.histogram[rows, index.clip(0, cells - 1).astype(int)], 0.0)
            for index in cell
        ]
        return np.asarray(sum(held) / self.count if self.absolute else np.zeros_like(self.signal))

    def rescaled(self, change: dict[int, tuple[float, float]]) -> Levels:
        """The same pixel values when the signals of some scales become factor·signal + shift.

        Args:
            change: factor and shift by index of the scale.
        """
        factor, shift = np.ones_like(self.signal), np.zeros_like(self.signal)
        scales = list(self.scales)
        for index, (times, plus) in change.items():
            if index not in self.scale:
                continue
            factor[self.scale == index], shift[self.scale == index] = times, plus
            scales[index] = scales[index].rescaled(times, plus)
        signal = factor * self.signal + shift
        moved = self.origin if self.absolute else self.origin + self.signal - signal
        return replace(
            self,
            signal=signal,
            origin=moved,
            spread=factor**2 * self.spread,
            shift=factor * self.shift,
            darkest=factor * self.darkest + shift,
            darkest_error=factor * self.darkest_error,
            scales=tuple(scales),
        )


def collect_levels(readings: Sequence[Readings], *, num_levels: int = NUM_LEVELS) -> Levels:
    """Sort pixel values into levels of like signal and count their residuals.

    The neighbours sort the pixels, so that no pixel's own noise does. Rounded values are dithered by one step, so that their
    steps do not beat with the bins; the likelihood knows.

    Args:
        readings: of one detector setting; each is sorted into levels of its own.
        num_levels: at most, per exposure; fewer where a level would hold under 200 pixel values.

    Example:
        >>> import calibration, numpy as np
        >>> from calibration.detector.levels import Readings
        >>> rng = np.random.default_rng(0)
        >>> electrons = np.linspace(20, 400, 20_000)
        >>> counts = 100 + 2 * rng.poisson(electrons) + 2 * rng.normal(size=20_000)
        >>> levels = calibration.collect_levels([Readings(counts, 100 + 2 * electrons, electrons, step=0.0)])
        >>> levels.signal.shape
        (16,)
    """
    rows = []
    generator = np.random.default_rng(0)
    for one in readings:
        dither = one.step * (generator.random(one.observation.shape) - 0.5)
        dithered = replace(one, observation=one.observation + dither)
        number = 1 if one.dark else max(1, min(num_levels, len(one.level) // 200))
        groups = np.array_split(np.argsort(one.level), number)
        rows += with_darkest([_residual_level(dithered, group) for group in groups], one)
    return gathered(rows, readings, absolute=False)


def gathered(rows: list[dict[str, Any]], readings: Sequence[Readings], *, absolute: bool) -> Levels:
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    known = {one.scale.pair: one.scale for one in readings if one.scale}
    scales = tuple(known.get(pair, Scale(pair, 1.0, 0.0)) for pair in range(max(known, default=0) + 1))
    return Levels(**columns, scales=scales, absolute=absolute)


def with_darkest(rows: list[dict[str, Any]], one: Readings) -> list[dict[str, Any]]:
    """The levels of an exposure, the darkest signal of all beside the first."""
    if rows and not one.dark:
        rows[0]["darkest"], rows[0]["darkest_error"] = one.darkest()
    return rows


def constants(one: Readings) -> dict[str, Any]:
    names = ("shot_share", "read_share", "weight", "step")
    rails = {"low": one.rails[0], "high": one.rails[1]}
    rest = {"dark": float(one.dark), "own": 1.0, "shift": 0.0, "excess": 0.0} | {
        "darkest": np.inf,
        "darkest_error": 1.0,
    }
    return {name: getattr(one, name) for name in names} | rails | rest | {"scale": one.scale.pair if one.scale else -1}


def _residual_level(one: Readings, group: NDArray[np.int64]) -> dict[str, Any]:
    observation, signal = one.observation[group], one.signal[group]
    residual = observation - signal
    inner = np.percentile(residual, (15.87, 84.13))
    robust = max((inner[1] - inner[0]) / 2, one.step / np.sqrt(12), np.finfo(float).tiny)
    kept = np.abs(residual - np.median(residual)) < REACH * robust
    width = 2 * REACH * robust / NUM_BINS
    middle = float(residual[kept].mean())
    centre = 0.0 if one.scale else middle
    index = np.floor((residual[kept] - centre) / width + NUM_BINS / 2)
    histogram = np.bincount(index.clip(0, NUM_BINS - 1).astype(int), minlength=NUM_BINS).astype(float)
    variance = float(np.mean((residual[kept] - middle) ** 2))
    share = one.shot_share / (1 + one.shot_share)
    found = {
        "signal": float(signal.mean()),
        "spread": 0.0 if one.dark else max(float(np.var(signal)) - share * variance, 0.0),
        "variance": variance,
        "count": float(kept.sum()),
        "width": width,
        "origin": -width * NUM_BINS / 2,
        "histogram": histogram,
    }
    return found | constants(one)
