"""Photon transfer: variance as a function of the signal, from levels of a scene's pixels or the moments of equal frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.detector.levels import Levels, NotMeasurable
from calibration.detector.likelihood import LevelMasses
from calibration.exposures.frames import Burst, Image, rails, rounding_step
from calibration.exposures.scaling import VarianceLine
from calibration.tolerances import CLEAR, CLIPPED, LEVEL, LIKELY, MODELLED
from noiseflow.checks import Effect
from noiseflow.described import described
from noiseflow.statistics import uniform_variance, weighted_line


@described(
    **dict.fromkeys(("variance", "variance_error", "intercept"), "counts²"),
    **dict.fromkeys(("gain", "gain_error"), "counts per electron"),
    signal="counts",
)
@dataclass(frozen=True)
class PhotonTransfer:
    """The straight line of variance against signal: ``variance = gain·signal + intercept``
    (doi:10.1109/TIP.2008.2001399).

    Attributes:
        signal: (L,) counts.
        variance, variance_error: (L,) variance of the exposure alone, and its standard error, counts².
        gain: counts per electron.
        intercept: counts²; (gain·read noise)² − gain·offset.
        gain_error: standard error of the gain, scaled by the square root of `chi_squared` if that is above 1.
        chi_squared: χ² per degree of freedom of the points about the line, with `LEVEL` included.
    """

    signal: Image
    variance: Image
    variance_error: Image
    gain: float
    intercept: float
    gain_error: float
    chi_squared: float


def departure(line: PhotonTransfer) -> Effect:
    """Departure of the points from their line, of the largest variance: the second largest, as one alone may be an accident."""
    if len(line.signal) < 5:
        return Effect(0.0)
    largest = float(line.variance.max())
    departures = np.abs(line.variance - (line.gain * line.signal + line.intercept)) / largest
    second = int(np.argsort(departures)[-2])
    # χ² counts a bend as scatter; its fourth root is between the errors with and without that
    error = line.variance_error[second] / largest * max(1.0, line.chi_squared**0.25)
    return Effect(float(departures[second]), float(error))


def fit_photon_transfer(
    levels: Sequence[Levels], likely: Image | None = None, known: tuple[float, ...] | None = None
) -> PhotonTransfer:
    """Fit the line of variance against signal, with what `LogPosterior` knows of darkness. Raises NotMeasurable if it falls.

    Clipped levels are used with what clipping takes from a detector of `likely` gain, offset and read noise, (3,), if given.
    """
    offset, _, read, unsure = known if known and known[2:] else (0.0, 0.0, 0.0, 0.0)
    noise = read if unsure or likely is None else float(likely[0] * likely[2]) ** 2
    points = [_points(one, likely, max(noise, 0.0)) for one in levels]
    darkness = np.array([offset, read, unsure, 0.0, 0.0])[:, None][:, : bool(unsure)]
    signal, variance, error, clipped, shared = np.hstack([*points, darkness])
    free = clipped < (CLIPPED if likely is None else np.inf)
    free |= free.sum() < 3
    line, gain_error, chi_squared = _weighted_line(signal[free], variance[free], error[free])
    if shared.any():  # an error of all points
        other = _weighted_line(signal[free], (variance + shared)[free], error[free])[0]
        gain_error = float(np.hypot(gain_error, other.rate - line.rate))
    if not line.rate > 0:
        raise NotMeasurable(
            "the noise does not grow with the signal, as in encoded images (gamma, logarithm), so the gain cannot be measured; "
            "use linear images, exposures with more contrast, or flats"
        )
    return PhotonTransfer(signal, variance, error, line.rate, line.floor, gain_error, chi_squared)


def _weighted_line(signal: Image, variance: Image, error: Image) -> tuple[VarianceLine, float, float]:
    """Return the line, the standard error of its slope, and χ² per degree of freedom.

    Errors are proportional to the fitted variance; errors proportional to the measured one would favour points that are low by
    chance.
    """
    known, line = np.maximum(variance, 0), VarianceLine.fitted(signal, variance)
    for _ in range(3):
        level = np.maximum(line(signal), 0.1 * abs(float(variance.mean())))
        weight = known**2 / np.maximum(level**2 * (error**2 + (LEVEL * known) ** 2), np.finfo(float).tiny)
        found = weighted_line(signal, variance, weight)
        line = VarianceLine(found.intercept, found.slope)
    return line, found.slope_error * max(found.chi_squared, 1.0) ** 0.5, found.chi_squared


def _points(levels: Levels, likely: Image | None, read: float) -> tuple[Image, Image, Image, Image, Image]:
    step, (gains, shared) = np.maximum(levels.step, 1e-30), levels.by_gains()
    rounding = uniform_variance(step) * (1 if levels.absolute else 2)  # residuals are dithered too
    signal, variance, clipped, doubt = levels.signal, levels.variance, levels.clipped(), 0 * step
    if likely is not None:
        gain, _, read_noise = likely
        place, no_limit = np.arange(levels.histogram.shape[1]), np.full_like(step, np.inf)
        laws = [LevelMasses(one) for one in (replace(levels, low=-no_limit, high=no_limit), levels)]
        masses = [law.masses(*likely[:, None])[0] for law in laws]
        more = np.divide(*(one @ place**2 - (one @ place) ** 2 for one in masses))
        # noise that electrons and codes share, or less than a code, has between none and three times this noise of rounding
        turn = 2 * np.pi * gain / step
        rough = np.exp((np.cos(turn) - 1) * variance / gain**2 - 0.5 * (turn * read_noise) ** 2)
        variance, doubt = more * variance, np.hypot(2 * rounding * rough, MODELLED * (more - 1) * more * variance)
    variance = variance - rounding
    if levels.absolute and len(signal) > 2:
        # pixels of a level were selected by their own estimates, which scatter about the true signals less than all do
        true = signal + levels.shift
        slope = np.gradient(true, signal)
        kept = levels.excess * levels.own + 2 * (1 - slope) * levels.spread
        signal, variance = true, np.maximum(variance - np.maximum(kept, 0.0), 0.1 * variance)
    else:
        variance = (variance + (levels.shot_share - levels.read_share) * read) / (1 + levels.shot_share)
    error = variance * np.sqrt(np.maximum(levels.fourth - 1, 2) / np.maximum(levels.count * levels.weight, 1))
    gains, shared = (one / (1 + levels.shot_share) for one in (gains * (not levels.absolute), shared))
    return signal, variance - gains, np.linalg.norm((error, shared, doubt), axis=0), clipped, shared


@described(mean="counts", variance="counts²", spatial="counts²", variance_error="counts²")
@dataclass(frozen=True)
class Level:
    """Temporal and spatial moments of equal frames.

    Attributes:
        mean: counts.
        variance, variance_error: mean temporal variance of the pixels, without rounding noise, and its standard error, counts².
        third, third_error: third central temporal moment and its standard error, counts³; None for two frames.
        spatial: spatial variance of the mean frame, without the contribution of temporal noise, counts².
        image: (y, x) mean frame, counts.
        noise: (y, x) temporal variance of each pixel, counts².
        frames: number of frames.
        flicker: relative standard deviation of the frame means, without the contribution of pixel noise.
        clipped: share of pixel values at either clipping limit.
        coarse: whether the noise is too small, relative to the rounding step, to measure its variance.
        end: upper clipping limit, counts; infinite if no pixel value reaches it.
        known: `mean` and its standard error, counts, with the scatter between frames and rounding; None if values are clipped.
    """

    mean: float
    variance: float
    variance_error: float
    third: float | None
    third_error: float
    spatial: float
    image: Image
    noise: Image
    frames: int
    flicker: float
    clipped: float
    coarse: bool
    end: float
    known: tuple[float, float] | None


def level_of(burst: Burst, *, step: float | None = None, coarse: float = 0.24) -> Level:
    """Compute the moments of the equal frames of a burst.

    Args:
        step: rounding step of the frames before anything was subtracted, counts; None if nothing was.
        coarse: variance, in squared rounding steps and including rounding noise, below which it depends on the position of the
            mean between two codes (EMVA 1288, release 3.1, section 6.5).
    """
    frames, number = burst.frames, len(burst.frames)
    image, noise = frames.mean(0), frames.var(axis=0, ddof=1)
    step = rounding_step(frames[0]) if step is None else step
    square, rounding = step**2, uniform_variance(step)
    means = frames.mean(axis=(1, 2))
    drift = float(means.var(ddof=1)) - float(noise.mean()) / image.size  # light that changed between frames
    if drift < CLEAR * float(noise.mean()) / image.size * np.sqrt(2 / (number - 1)):
        drift = 0.0
    variance = float(noise.mean()) - drift
    residual = frames - image
    shrunk = 1.0
    if image.size > 2:  # a frame's mean over N pixels takes part of the third moment with it
        residual = residual - (means - means.mean())[:, None, None]
        shrunk = (1 - 1 / image.size) * (1 - 2 / image.size)
    fourth = float(np.mean(residual**4)) * (number / (number - 1)) ** 2 if number > 2 else 3 * variance**2
    error = np.sqrt(max(fourth - variance**2, 0.5 * variance**2) / (image.size * (number - 1)))
    third, third_error = None, 0.0
    if number > 2:
        scale = number**2 / ((number - 1) * (number - 2)) / shrunk  # unbiased third central moment
        cubes = residual**3 * scale
        third, third_error = float(cubes.mean()), float(cubes.std() / np.sqrt(cubes.size))
    spatial = float(image.var(ddof=1)) - float(noise.mean()) / number
    low, end = rails(frames) if np.ptp(frames) > 0 else (-np.inf, float(frames.flat[0]))
    mean = float(image.mean())
    if low == 0 and abs(variance - mean) < LIKELY * np.sqrt(mean * (2 * mean + 1) / (image.size * (number - 1))):
        low, rounding, square = -np.inf, 0.0, 0.0  # photons, which are counted without rounding and clipping
    clipped = float(np.mean((frames <= low) | (frames >= end)))
    # rounding shifts the mean by up to half a step, which noise damps as the first term of the shift's Fourier series
    enough = variance > square / 4 + LIKELY * error  # values of two codes have a quarter without any noise
    damped = 2 * np.pi**2 * enough * (variance - rounding) / (square or 1.0)
    hidden = np.exp(-damped) * bool(square)
    error = np.hypot(error, hidden * square / np.pi**2 * (1 + 2 * damped))  # the variance depends on the shift, too
    errors = np.sqrt(noise.mean() / frames.size), means.std(ddof=1) / np.sqrt(number), hidden * np.sqrt(rounding)
    flicker = float(np.sqrt(drift) / max(abs(mean), np.finfo(float).tiny))
    found = mean, variance - rounding, float(error), third, third_error, spatial, image, noise, number, flicker
    if clipped > CLIPPED:
        return Level(*found, clipped, bool(variance < coarse * square), end, None)
    return Level(*found, 0.0, bool(variance < coarse * square), end, (mean, float(np.linalg.norm(errors))))
