"""Measurement of the detector's parameters from aligned exposures: histograms, measured offset, posterior."""

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.detector.levels import (
    Levels,
    NotMeasurable,
    Readings,
    Scale,
    collect_cells,
    collect_levels,
    electrons_show,
)
from calibration.detector.likelihood import misfit
from calibration.detector.log_posterior import READ_NOISE_RANGE, LogPosterior, maximum_likelihood
from calibration.detector.photon_transfer import Level, PhotonTransfer, fit_photon_transfer, level_of
from calibration.detector.posterior import DetectorPosterior, Interval, sample_posterior
from calibration.detector.response import LINEAR, Long, Response, response_of
from calibration.detector.shape import excess_factor, excess_skew, third_moments, uneven_codes, unevenness
from calibration.exposures.frames import Burst, Image, blurred_step, rails, rounding_step
from calibration.exposures.masks import Mask, clear_of_rails, counted
from calibration.exposures.scaling import MOST_PIXELS
from calibration.registration.aligned import LARGEST_SLOPE, MINIMUM_PIXELS, AlignedPair
from calibration.tolerances import GAIN, LEVEL, LIKELY, MODELLED
from noiseflow.checks import Effect
from noiseflow.described import described
from noiseflow.progress import Progress

EXCESS_NOISE = (
    "On a detector with excess noise (electron multiplication, scintillator, hybrid pixels) the noise determines only the "
    "product of gain and excess-noise factor; the reported gain is then this product."
)

LEAST_GAIN = 1e-4
"""Smallest measurable gain, in standard deviations of the noise; below it the noise would be that of over 10⁸ electrons."""


@described(offset="counts")
@dataclass(frozen=True)
class Detector:
    """Parameters of a detector and the data behind them.

    Attributes:
        posterior: gain, offset and read noise.
        line: the photon-transfer points and line.
        levels: the histograms; none of a `photon_counter`, of which `misfit` is 1.
        offset: offset measured from dark frames or given, and its standard error, counts; None without either. Of dark frames
            also the variance of the read noise and its standard error, counts².
        misfit: χ² per degree of freedom of the histograms, about 1 for a Poisson-Gaussian detector. If the converter's codes are
            uneven, groups of codes are used.
        uneven: relative deviation (rms) of the pixels' variances at equal signal, in a burst of at least four frames; 0 if none.
        codes: relative deviation (rms) of the converter's code widths; 0 if none.
        electrons: whether the pixel values have single-electron peaks, one gain apart.
        response: exponent of the response to light.
        dark: moments of the dark frames; None without.
        excess: excess-noise factor F²; None if the third moment of the noise does not determine it.
        skew: third cumulant of the noise beyond that of a Poisson-Gaussian detector, relative to that of Poisson noise.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> round(calibration.measure_detector(calibration.align_burst(calibration.Burst(frames))[0]).line.gain, 1)
        1.0
    """

    posterior: DetectorPosterior
    line: PhotonTransfer
    levels: Sequence[Levels]
    offset: tuple[float, ...] | None
    misfit: float
    uneven: float
    dark: Level | None
    response: Response
    codes: float
    electrons: bool
    excess: Interval | None
    skew: Effect


def measure_detector(
    pairs: Sequence[AlignedPair],
    *,
    dark: Burst | None = None,
    flat: Burst | None = None,
    offset: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Detector:
    """Measure gain, offset and read noise from aligned pairs or a burst.

    Args:
        pairs: from `align_pair` or `align_burst`.
        dark, flat, offset, seed, progress: as `calibrate_exposures`; flat frames add one level.

    Raises:
        NotMeasurable: the noise does not grow with the signal, or nearly all pixel values are clipped.
        ValueError: the posterior does not converge.

    Example:
        >>> import calibration, numpy as np
        >>> frames = 100 + 2 * np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> round(calibration.measure_detector(pairs, offset=100.0).posterior.gain.median, 1)
        2.0
    """
    if not (offset or pairs[0].short.min()) and (counter := photon_counter(pairs, seed)):
        return counter
    plain, cells, blurred = [], [], blurred_step(pairs[0].short)
    for number, pair in enumerate(pairs):
        residual, fine = readings_of(pair, number, blurred=blurred)
        plain += residual
        cells += fine
    # dark frames of few codes do not show the step between them
    darkness = None if dark is None else level_of(dark, step=max(map(rounding_step, (pairs[0].short, dark.frames[0]))))
    # a given offset is as certain as the mean of 10⁴ dark pixels
    slack = float(np.std((pairs[0].short - pairs[0].signal)[pairs[0].mask])) / 1e2
    known: tuple[float, ...] | None = None if offset is None else (offset, slack)
    # moments: histograms of dark frames lie on codes, and show how pixels differ
    if darkness and (known := darkness.known):
        known = (*known, darkness.variance, float(np.hypot(darkness.variance_error, LEVEL * darkness.variance)))
    plain = pooled(plain) + [_burst_readings(one) for one in (flat,) if one is not None]
    levels = [collect_levels(plain)] if plain else []
    start = None
    if cells:
        with suppress(NotMeasurable) if plain else nullcontext():  # optional if enough other pixels exist
            levels, start = _with_cells(levels, cells, known, _guess(pairs))
    posterior = sample_posterior(levels, offset=known, start=start, seed=seed, progress=progress)
    levels = list(posterior.levels)
    noise = np.sqrt(np.mean(np.concatenate([one.variance for one in levels])))
    if posterior.gain.median < LEAST_GAIN * noise:
        raise NotMeasurable(
            "the noise grows too little with the signal to measure the gain; give the exposure ratio, dark frames, or more light"
        )
    codes = uneven_codes(levels, posterior.most_likely)
    chi_squared = misfit(levels, posterior.most_likely, merged=codes > 0)
    line = fit_photon_transfer(levels, posterior.most_likely, known)
    thirds = third_moments(levels)
    if known is not None and thirds:  # no noise of electrons at the offset
        thirds.append((known[0], 0.0, min(error for _, _, error in thirds) / len(thirds)))
    electrons = electrons_show(levels, float(posterior.most_likely[0]))
    found = posterior, line, levels, known, chi_squared, unevenness(pairs), darkness, _response(pairs, line, known)
    skew = excess_skew(levels, posterior.most_likely)
    return Detector(*found, codes, electrons, excess_factor(thirds, line.gain, line.gain_error), skew)


def photon_counter(pairs: Sequence[AlignedPair], seed: int, *, num_samples: int = 2000) -> Detector | None:
    """Return the detector with a gain of one step and an offset of 0 if the pixel values of all pairs are `counted`: the error of
    their variance is that of its gain. None otherwise."""
    shown = [[one[pair.mask] for one in (pair.short, pair.signal, pair.level)] for pair in pairs]
    repeated = len(pairs) / (len(pairs) - 1) if pairs[0].frames > 1 else 1.0
    step = rounding_step(pairs[0].short) or blurred_step(pairs[0].short)
    found = counted(*map(np.concatenate, zip(*shown, strict=True)), step=step, repeated=repeated)
    if found is None:
        return None
    (mean, variance, error), (means, variances, errors) = found[:, 0], found[:, 1:]
    scatter, generator = error / mean, np.random.default_rng(seed)
    gain = np.exp(scatter * generator.standard_normal(num_samples))
    read_noise = np.sqrt(errors[0] * np.abs(generator.standard_normal(num_samples)))
    samples = np.column_stack([step * gain, step * mean * (1 - 1 / gain), read_noise])
    posterior = DetectorPosterior(samples, np.array([step, 0.0, READ_NOISE_RANGE[0]]), num_samples, 1.0, num_samples)
    points = step * means, step**2 * variances, step**2 * errors
    line = PhotonTransfer(*points, step * variance / mean, 0.0, step * scatter, chi_squared=1.0)
    rest: dict[str, Any] = {"uneven": 0.0, "dark": None, "response": LINEAR, "codes": 0.0}
    rest |= {"electrons": False, "excess": None, "skew": Effect(0.0)}
    return Detector(posterior, line, (), offset=(0.0, step * error), misfit=1.0, **rest)


def _with_cells(
    plain: list[Levels], cells: list[Readings], offset: tuple[float, ...] | None, guess: tuple[float, float, float]
) -> tuple[list[Levels], tuple[float, float, float]]:
    """Return the levels of residuals and of pixel values, the latter defined by a first fit, and the parameters of that fit."""
    first, best, _ = maximum_likelihood(LogPosterior([*plain, collect_cells(cells, guess=guess)], offset), most=2)
    scales, found = first.levels[-1].scales, first.point(best)
    moved = [one.rescaled(scales[one.scale.pair]) for one in cells if one.scale]
    return [*first.levels[:-1], collect_cells(moved, guess=found)], found


def _guess(pairs: Sequence[AlignedPair]) -> tuple[float, float, float]:
    """Return rough estimates of gain, offset and read noise from the variance lines of the pairs."""
    found: list[tuple[float, float, float]] = []
    for pair in pairs:
        line, share = pair.total_variance, 1 + _shares(pair)[0]
        signal = float(pair.signal[pair.mask].mean())
        variance = float(line(np.array(signal))) / share
        gain = max(line.rate / share, 1e-2 * variance / max(abs(signal), 1.0))
        lowest = signal - variance / gain
        offset = max(pair.scaling.common_offset()[0], lowest) if pair.one_setting else lowest
        read = max(variance - gain * (signal - offset), 0.05 * gain**2)
        found.append((gain, offset, float(np.sqrt(read)) / gain))
    gain, offset, read_noise = (float(np.median(column)) for column in zip(*found, strict=True))
    return gain, offset, read_noise


def readings_of(pair: AlignedPair, number: int = 0, *, blurred: float = 0.0) -> tuple[list[Readings], list[Readings]]:
    """Split the valid pixels of a pair into those for residuals and those for histograms of pixel values.

    Histograms of pixel values are used for pixels with few electrons, with noise as small as the rounding step, or near the
    clipping limits; residuals would lose information there. A burst, whose signals are as noisy as its pixel values, has only
    residuals, away from the clipping limits. The `number` of the pair identifies its scaling; all share a `blurred_step`.
    """
    level = pair.level
    clear, step = clear_of_rails(pair.short, level, pair.mask), rounding_step(pair.short) or blurred
    centre = float(pair.signal[pair.mask].mean())
    scale = Scale(number, pair.scaling.slope, pair.scaling.intercept, centre, pair.one_setting, pair.by_gains)
    weight = 1.0 if pair.frames == 1 else 1 - 1 / pair.frames
    shares, raw = _shares(pair), pair.short
    # few codes would leave the signals on a comb, whose density has no slope
    signals = pair.signal + pair.step * (np.random.default_rng(0).random(pair.signal.shape) - 0.5)
    rounded = (1 + pair.kept) * pair.step**2 / 12
    if pair.by_gains:  # residuals without the variance that was removed, which is normal, have too small third moments
        square = pair.by_gains[1] * np.maximum(pair.signal - pair.by_gains[0], 0.0) ** 2
        raw = pair.signal + np.sqrt(1 + square / pair.total_variance.bounded(pair.signal)) * (raw - pair.signal)

    def part(mask: Mask, short: Image) -> list[Readings]:
        if mask.sum() < MINIMUM_PIXELS:
            return []
        values = (short[mask], signals[mask], level[mask])
        own = scale if pair.frames == 1 else None
        return [Readings(*values, *shares, weight, step, rounded, rails(pair.short), own)]

    # errors of a pattern and gain references blur pixel values, too, and offsets that the signals share shift them
    fine = ~clear if pair.pattern or blurred or _share_offsets(pair) else ~clear | _fine(pair, level, step)
    fine = np.zeros_like(clear) if pair.frames > 1 else fine
    found = part(pair.mask & clear & ~fine, raw), part(pair.mask & fine, pair.short)
    if not found[0] and not found[1]:
        raise NotMeasurable(
            f"the noise of nearly all of {int(pair.mask.sum())} pixels is clipped; increase the offset, or expose longer"
        )
    return found


def _share_offsets(pair: AlignedPair) -> bool:
    """Whether both exposures have offsets of single pixels: variance in darkness that the signals lack, clearly and by more than
    `GAIN` of the mean. The gain by pixel values was 3 % too low at a fifth of it, and 1 % at a fifteenth."""
    own, slope = pair.signal_variance, pair.scaling.slope
    if not pair.one_setting and pair.plain_ratio is None:
        return False
    dark, usual = pair.scaling.common_offset()[0], float(pair.total_variance(pair.signal[pair.mask]).mean())
    found = slope * float(pair.total_variance(np.array(dark))) - (own.floor + own.rate * dark) / slope
    error = float(np.hypot(own.level_error, (dark - own.centre) * own.rate_error)) / slope
    return found > max(LIKELY * error, GAIN * usual)


def _fine(pair: AlignedPair, level: Image, step: float, *, few: float = 25.0) -> Mask:
    """Return the mask of pixels with few electrons, or with noise as small as the rounding step.

    Below so many electrons² of variance, the shape of Poisson noise contains more information than its variance.
    """
    variance = pair.total_variance(level)
    gain = max(pair.total_variance.rate, 0.0)
    return np.asarray((variance < few * gain**2) | (variance < (LIKELY * step) ** 2))


def _shares(pair: AlignedPair) -> tuple[float, float]:
    """Return the variance of the signal estimate over that of the pixel value, for shot noise and for read noise.

    For one detector setting they equal the slope of the scaling and its square, times the noise that interpolation preserves.
    This is assumed if a ratio was given, or if the measured shot noise of the long exposure agrees; otherwise the measured
    share is used for both.
    """
    ratio = pair.exposure_ratio if pair.exposure_ratio is not None and pair.one_setting else pair.plain_ratio
    if ratio is not None:
        return pair.kept / ratio, pair.kept / ratio**2 + sum(pair.pattern[1:])
    if pair.frames > 1:
        return (pair.kept / (pair.frames - 1),) * 2
    whole, own = (line(pair.signal[pair.mask]).mean() for line in (pair.total_variance, pair.signal_variance))
    steps = np.array([pair.kept**0.5 * pair.step, rounding_step(pair.short) or blurred_step(pair.short)])
    own, rest = np.array([own, whole - own]) - steps**2 / 12  # without what rounding adds to both
    share = float(max(own, 0.0) / max(rest, 0.1 * whole))
    return share, share + sum(pair.pattern[1:])


def _response(pairs: Sequence[AlignedPair], line: PhotonTransfer, offset: tuple[float, ...] | None) -> Response:
    """Fit the exponent of the response; the offset is that of dark frames, or of two exposures of one setting.

    A given exposure ratio determines the exponent better than the noise of the long exposure does.
    """
    alike, ratio = [pair for pair in pairs if pair.one_setting], None
    if alike:
        powers = [-np.log(pair.scaling.slope) / np.log(pair.exposure_ratio or 1.0) for pair in alike]
        error = np.hypot(GAIN / 2, alike[0].scaling.slope_error / alike[0].scaling.slope)
        ratio = float(np.mean(powers)), float(error / np.log(alike[0].exposure_ratio or 1.0))
        offset = offset or alike[0].scaling.common_offset()
    long = None if alike else _long_exposures(pairs, offset, float(line.signal.min()))
    error = np.hypot(line.variance_error, LEVEL * line.variance)
    return response_of(line.signal, line.variance, error, offset=offset, ratio=ratio, long=long)


def _long_exposures(
    pairs: Sequence[AlignedPair], offset: tuple[float, ...] | None, darkest: float, *, nodes: int = 16
) -> Long | None:
    """Return the variances of the long exposures, which continue the line if they were recorded at the same setting.

    Their offset is then that of dark frames or follows from the scaling, which maps it onto itself. None for bursts, long
    exposures that are hardly brighter or go beyond the limit of the short ones, and offsets above the darkest signal.
    """
    found: list[Any] = []
    for pair in (one for one in pairs if one.frames == 1 and one.long.max() <= rails(one.short)[1]):  # one converter
        own, slope = pair.signal_variance, pair.scaling.slope
        zero = offset or (pair.scaling.common_offset() if slope < LARGEST_SLOPE else (np.inf, 0.0))
        signal = pair.signal[pair.mask]
        signal = np.sort(signal[:: -(-len(signal) // MOST_PIXELS)])
        signal = np.array([one.mean() for one in np.array_split(signal, nodes)])
        weight = 1 / pair.total_variance.bounded(signal) ** 2
        centre = float(np.average(signal, weights=weight))
        lever, level = signal - centre, own.floor + own.rate * centre
        if not (own.level_error > 0 < level and zero[0] < darkest and 0 < slope < LARGEST_SLOPE):
            continue
        modelled = MODELLED if pair.registration.interpolates(pair.long.shape) else 0.0
        level_error = np.hypot(own.level_error, modelled * level)
        # detail of the scene that was taken for noise grows with the square of the signal
        rate_error = np.hypot(own.rate_error, 2 * level_error / (centre - zero[0]))
        projection = np.stack([weight / weight.sum(), slope * weight * lever / (weight @ lever**2)])
        values = np.array([[level, own.rate], [level_error, rate_error]]) / (pair.kept * np.array([slope**2, slope]))
        found.append(((signal - pair.scaling.intercept) / slope, projection, *values, zero))
    if not found:
        return None
    *lines, zeros = map(np.array, zip(*found, strict=True))
    return Long((float(zeros[:, 0].mean()), float(np.hypot(zeros[:, 0].std(), zeros[:, 1].mean()))), *lines)


def _burst_readings(burst: Burst) -> Readings:
    """Compare every frame with the mean of the others, without alignment."""
    number = len(burst.frames)
    others, share = (burst.frames.sum(0) - burst.frames) / (number - 1), 1 / (number - 1)
    signal = others + (burst.frames - others).mean(axis=(1, 2), keepdims=True)
    level = np.broadcast_to(burst.frames.mean(axis=(1, 2), keepdims=True), signal.shape)
    step = rounding_step(burst.frames)
    return Readings(burst.frames.ravel(), signal.ravel(), level.ravel(), share, share, 1 - 1 / number, step, 0.0)


def pooled(readings: Sequence[Readings]) -> list[Readings]:
    """Merge the pixel values of all frames of a burst, so that each level needs only one histogram."""
    groups: dict[Any, list[Readings]] = {}
    for number, one in enumerate(readings):
        constants = (round(one.shot_share, 9), round(one.read_share, 9), one.weight, one.step)
        groups.setdefault(number if one.scale else constants, []).append(one)
    merged = []
    for group in groups.values():
        parts = zip(*((one.observation, one.signal, one.level) for one in group), strict=True)
        observation, signal, level = map(np.concatenate, parts)
        merged.append(replace(group[0], observation=observation, signal=signal, level=level))
    return merged
