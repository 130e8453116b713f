"""From aligned exposures to the detector's parameters: readings collected, offset measured where it can be, posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.aligned import MINIMUM_PIXELS, AlignedPair
from calibration.exposures import Burst, Image, rounding_step
from calibration.likelihood import DetectorLikelihood
from calibration.masks import clear_of_rails
from calibration.photon_transfer import (
    Levels,
    NotMeasurable,
    PhotonTransfer,
    Readings,
    collect_levels,
    fit_photon_transfer,
)
from calibration.posterior import DetectorPosterior, sample_posterior
from calibration.scaling import ring_mean

if TYPE_CHECKING:
    from noiseflow.console import Progress

EXCESS_NOISE = (
    "On a detector with excess noise (electron multiplication, scintillator, hybrid pixels) the noise shows only gain times "
    "the excess-noise factor: read 'gain' as that product."
)


@dataclass(frozen=True)
class Detector:
    """A detector's parameters and what they rest on.

    Attributes:
        posterior: gain, offset and read noise.
        line: the photon-transfer points and line.
        levels: the residual histograms.
        offset: measured offset and its standard error, counts; None where only the noise tells it.
        misfit: χ² per degree of freedom of the residual histograms: about 1 for a Poisson-Gaussian detector.
    """

    posterior: DetectorPosterior
    line: PhotonTransfer
    levels: Levels
    offset: tuple[float, float] | None
    misfit: float


def measure_detector(
    pairs: Sequence[AlignedPair],
    *,
    dark: Burst | None = None,
    flat: Burst | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Detector:
    """Gain, offset and read noise from aligned pairs or a burst.

    Args:
        pairs: from `align_pair` or `align_burst`.
        dark: frames without light: they measure the offset, and the read noise directly.
        flat: equal frames of even illumination: one more level.
        seed: of the sampler.
        progress: called with the sampler's steps.

    Raises:
        NotMeasurable: the noise does not grow with the signal, or nearly all readings are clipped.
        ValueError: the posterior does not converge.
    """
    readings = [readings_of(pair) for pair in pairs]
    readings += [
        one for burst, is_dark in ((dark, True), (flat, False)) if burst for one in _burst_readings(burst, is_dark)
    ]
    levels = collect_levels(readings)
    offset = dark_offset(dark) if dark else exposure_offset(pairs)
    posterior = sample_posterior(levels, offset=offset, seed=seed, progress=progress)
    return Detector(posterior, fit_photon_transfer(levels), levels, offset, misfit(levels, posterior.most_likely))


def misfit(levels: Levels, parameters: Image, *, least: float = 10.0) -> float:
    """χ² per degree of freedom of the residual histograms, over bins where at least `least` readings are expected.

    Args:
        levels: from `collect_levels`.
        parameters: (3,) gain, offset, read noise.
        least: readings expected.
    """
    gain, offset, read_noise = (np.array([value]) for value in parameters)
    number = levels.histogram.sum(axis=1, keepdims=True)
    expected = number * DetectorLikelihood(levels).masses(gain, offset, read_noise)[0]
    used = expected > least
    squares = (levels.weight[:, None] * (levels.histogram - expected) ** 2)[used] / expected[used]
    return float(squares.sum() / max(used.sum() - 2 * len(number) - 3, 1))


def readings_of(pair: AlignedPair) -> Readings:
    """The trusted pixels of a pair whose neighbours lie clear of the rails, sorted by what these tell of the signal.

    Raises:
        NotMeasurable: nearly all readings are clipped.
    """
    level = ring_mean(pair.signal, pair.mask, inner=1, blur=2.0)
    used = pair.mask & clear_of_rails(pair.short, level, pair.mask)
    if used.sum() < MINIMUM_PIXELS:
        raise NotMeasurable(
            f"all but {int(used.sum())} pixels lie within their noise of the converter's rails, so that their noise is cut "
            "off; raise the detector's offset, or expose for longer"
        )
    weight = 1.0 if pair.frames == 1 else 1 - 1 / pair.frames
    parts = (pair.short[used], pair.signal[used], level[used], *_shares(pair))
    return Readings(*parts, weight, False, rounding_step(pair.short))


def _shares(pair: AlignedPair) -> tuple[float, float]:
    """Variance of the signal estimate over that of the reading, for shot noise and for read noise.

    One detector setting at a known exposure ratio makes them 1/ratio and 1/ratio², less what the interpolation smooths
    away; otherwise the measured share stands for both.
    """
    if pair.exposure_ratio is not None:
        noise = np.random.default_rng(0).standard_normal(pair.long.shape)
        kept = float(np.var(pair.registration.warp(noise)[0][pair.mask]))
        return kept / pair.exposure_ratio, kept / pair.exposure_ratio**2
    signal = pair.signal[pair.mask]
    share = float(np.mean(pair.signal_variance(signal)) / np.mean(pair.total_variance(signal)))
    share = min(max(share, 0.0), 0.9)
    return share / (1 - share), share / (1 - share)


def exposure_offset(pairs: Sequence[AlignedPair]) -> tuple[float, float] | None:
    """Offset common to short and long exposures, and its standard error, where exposure ratios were given.

    With one detector setting, signal − offset = (long − offset)/ratio, so the intercept is offset·(1 − slope).
    """
    known = [pair for pair in pairs if pair.exposure_ratio is not None]
    if not known:
        return None
    values, errors = zip(*(pair.scaling.common_offset() for pair in known), strict=True)
    weight = 1 / np.square(errors)
    return float(np.average(values, weights=weight)), float(1 / np.sqrt(weight.sum()))


def dark_offset(dark: Burst) -> tuple[float, float]:
    """Mean of the dark frames and its standard error, from the scatter between frames."""
    means = dark.frames.mean(axis=(1, 2))
    scatter = float(np.std(dark.frames - dark.frames.mean(0), ddof=0)) / np.sqrt(dark.frames.size)
    return float(means.mean()), float(np.hypot(scatter, means.std(ddof=1) / np.sqrt(len(means))))


def _burst_readings(burst: Burst, dark: bool) -> list[Readings]:
    """Every frame beside the mean of the others, with no scene to align."""
    number = len(burst.frames)
    total, share = burst.frames.sum(0), 1 / (number - 1)
    found = []
    for frame in burst.frames:
        others = (total - frame) / (number - 1)
        signal = others + (frame - others).mean()
        parts = (frame.ravel(), signal.ravel(), np.full(frame.size, frame.mean()))
        found.append(Readings(*parts, share, share, 1 - 1 / number, dark, rounding_step(frame)))
    return found
