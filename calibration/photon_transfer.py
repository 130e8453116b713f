"""Photon transfer: how the scatter of readings grows with their signal, level by level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.exposures import Image
from calibration.scaling import fit_line

NUM_LEVELS = 16
"""Signal levels into which the pixels of a pair are sorted, equally filled."""

NUM_BINS = 128
"""Bins of each level's residual histogram."""

REACH = 8.0
"""Standard deviations of the residual that the histogram covers either way; readings beyond it are defects, not
noise."""


class NotMeasurable(ValueError):
    """The exposures cannot tell the detector's gain, though a noise model can still be fitted."""


@dataclass(frozen=True)
class Readings:
    """Readings of one exposure beside an independent estimate of their signal.

    Attributes:
        observation: (N,) counts.
        signal: (N,) estimate of its expectation, counts.
        level: (N,) what sorts the pixels, known without the noise of either: the neighbours' signal.
        shot_share: variance of the estimate's shot noise over that of the observation.
        read_share: the same for read noise.
        weight: independent information per reading, 1 unless readings share their estimates.
        dark: taken without light: read noise alone.
        step: rounding step of the observation, counts; 0 if it is not rounded.
    """

    observation: Image
    signal: Image
    level: Image
    shot_share: float = 0.0
    read_share: float = 0.0
    weight: float = 1.0
    dark: bool = False
    step: float = 1.0


@dataclass(frozen=True)
class Levels:
    """Residual histograms (observation − signal) at L signal levels: all that the detector's likelihood needs.

    Attributes:
        signal: (L,) mean signal, counts.
        spread: (L,) variance of the true signals within the level, counts².
        variance: (L,) variance of observation − signal, counts².
        count: (L,) readings.
        width: (L,) of a histogram bin, counts.
        histogram: (L, NUM_BINS) readings, the middle of the bins at residual 0.
        shot_share, read_share, weight, dark, step: (L,) as in `Readings`.
    """

    signal: Image
    spread: Image
    variance: Image
    count: Image
    width: Image
    histogram: Image
    shot_share: Image
    read_share: Image
    weight: Image
    dark: Image
    step: Image


@dataclass(frozen=True)
class PhotonTransfer:
    """The straight line of variance against signal: ``variance = gain·signal + intercept``
    (doi:10.1109/TIP.2008.2001399).

    Attributes:
        signal: (L,) counts.
        variance: (L,) of the exposure alone, counts².
        variance_error: (L,) standard error.
        gain: counts per electron.
        intercept: counts²; (gain·read noise)² − gain·offset.
    """

    signal: Image
    variance: Image
    variance_error: Image
    gain: float
    intercept: float


def collect_levels(readings: Sequence[Readings], *, num_levels: int = NUM_LEVELS) -> Levels:
    """Sort readings into levels of like signal and count their residuals.

    Rounded readings are dithered by one step, so that their lattice does not beat with the bins; the likelihood knows.

    Args:
        readings: of one detector setting; each is sorted into levels of its own.
        num_levels: at most, per exposure; fewer where a level would hold under 200 readings.
    """
    rows = []
    generator = np.random.default_rng(0)
    for one in readings:
        one = replace(one, observation=one.observation + one.step * (generator.random(one.observation.shape) - 0.5))
        number = 1 if one.dark else max(1, min(num_levels, len(one.level) // 200))
        rows += [_level(one, group) for group in np.array_split(np.argsort(one.level), number)]
    return Levels(*(np.array(column) for column in zip(*rows, strict=True)))


def fit_photon_transfer(levels: Levels) -> PhotonTransfer:
    """Fit the line of variance against signal.

    Raises:
        NotMeasurable: the variance does not grow with the signal, so that no gain shows.
    """
    variance = (levels.variance - levels.step**2 / 6) / (1 + levels.shot_share)
    error = variance * np.sqrt(2 / np.maximum(levels.count * levels.weight, 1))
    line = fit_line(levels.signal, variance)
    if not line.rate > 0:
        raise NotMeasurable(
            "the noise does not grow with the signal, so the gain cannot be measured; give exposures with more "
            "contrast, or flat frames at several levels"
        )
    return PhotonTransfer(levels.signal, variance, error, line.rate, line.floor)


def _level(one: Readings, group: NDArray[np.int64]) -> tuple[Image | float, ...]:
    observation, signal = one.observation[group], one.signal[group]
    residual = observation - signal
    inner = np.percentile(residual, (15.87, 84.13))
    robust = max((inner[1] - inner[0]) / 2, one.step / np.sqrt(12), np.finfo(float).tiny)
    kept = np.abs(residual - np.median(residual)) < REACH * robust
    width = 2 * REACH * robust / NUM_BINS
    residual = residual[kept] - residual[kept].mean()
    variance = float(np.mean(residual**2))
    index = np.floor(residual / width + NUM_BINS / 2)
    histogram = np.bincount(index.clip(0, NUM_BINS - 1).astype(int), minlength=NUM_BINS).astype(float)
    share = one.shot_share / (1 + one.shot_share)
    spread = 0.0 if one.dark else max(float(np.var(signal)) - share * variance, 0.0)
    constants = (one.shot_share, one.read_share, one.weight, float(one.dark), one.step)
    return float(signal.mean()), spread, variance, float(kept.sum()), width, histogram, *constants
