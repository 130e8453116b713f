"""EMVA 1288 figures and per-pixel maps of a camera, from flat frames at several levels and dark frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.detector.correlation import LAGS, Correlation, correlation_of_flats, correlation_of_residuals
from calibration.detector.levels import NotMeasurable
from calibration.detector.patterns import Pattern, pattern_of
from calibration.detector.photon_transfer import Level, level_of
from calibration.detector.posterior import Interval
from calibration.detector.repair import without_bands
from calibration.detector.response import Response, response_of
from calibration.detector.shape import excess_factor
from calibration.exposures.frames import Burst, Image, rails, rounding_step
from calibration.exposures.masks import without_outliers
from calibration.registration.aligned import Residual
from calibration.tolerances import CLEAR, LIKELY, SCENE
from noiseflow.described import described
from noiseflow.statistics import weighted_line


@described(
    **dict.fromkeys(("dark_noise", "saturation", "dsnu"), "electrons"),
    **dict.fromkeys(("prnu", "linearity_error"), "of the signal"),
    gain="counts per electron",
    offset="counts",
    dynamic_range="ratio",
    dark_current="electrons per second",
)
@dataclass(frozen=True)
class CameraFigures:
    """Figures of a camera according to EMVA 1288 (release 3.1, https://www.emva.org/standards-technology/emva-1288).

    Attributes:
        gain: overall system gain K, counts per electron (its inverse is in electrons per count), times the excess-noise factor
            if the detector has one.
        dark_noise: temporal noise in darkness, electrons rms; None without dark frames, or if it is below the rounding step.
        offset: mean of the dark frames, counts; None without dark frames.
        saturation: electrons at the level with the largest temporal variance, or at the brightest level if the variance still
            grows there.
        saturated: whether a level beyond saturation was measured; otherwise `saturation` is a lower bound of the capacity.
        dynamic_range: saturation over the signal, in electrons, that equals its noise; None without dark frames.
        snr_maximum: maximum signal-to-noise ratio.
        linearity_error: mean relative deviation from the line of signal against exposure time; None without times.
        dsnu: dark signal nonuniformity, electrons rms; None without dark frames.
        prnu: photo response nonuniformity at half saturation, relative to the signal; None without dark frames.
        dark_current: electrons per second and pixel; None without dark frames at two exposure times.
        excess_factor: F² from the third moment of levels with at least three frames, with its 90 % interval; None if unknown.
        levels: moments of the flats, in order of increasing mean.
        dark: moments of the dark frames; None without dark frames.
        correlation: correlation of the temporal noise of neighbouring pixels.
        chi_squared: χ² per degree of freedom of the photon-transfer line.
        if_linear: the gain if the response is linear.
        bend: exponent of the response to light; the gain is the local one at the mean signal.
        pattern: places whose noise differs at equal signal.
        outliers: number of values that stood out in one frame only and were replaced.
        lag: correlation of the noise of successive frames, and its standard error.
        rows, columns: standard deviation of the offsets subtracted from rows or columns of single frames, counts; 0 if none were.
    """

    gain: Interval
    dark_noise: Interval | None
    offset: float | None
    saturation: float
    saturated: bool
    dynamic_range: float | None
    snr_maximum: float
    linearity_error: float | None
    dsnu: float | None
    prnu: float | None
    dark_current: float | None
    excess_factor: Interval | None
    levels: tuple[Level, ...]
    dark: Level | None
    correlation: Correlation
    chi_squared: float
    if_linear: Interval
    bend: Response
    pattern: Pattern
    outliers: int
    lag: tuple[float, float]
    rows: float
    columns: float

    @property
    def linear(self) -> list[Level]:
        """Levels below saturation, which determine gain and response."""
        return _linear(self.levels, self.offset or 0.0)

    @property
    def response(self) -> Image:
        """(y, x) relative response of each pixel, with mean 1, from all linear levels."""
        dark = self.dark.image if self.dark else np.full(self.levels[0].image.shape, self.offset or 0.0)
        signal = np.sum([level.image - dark for level in self.linear], axis=0)
        return np.asarray(signal / signal.mean())


def measure_camera(
    flats: Sequence[Burst],
    darks: Sequence[Burst] = (),
    *,
    flat_times: Sequence[float] | None = None,
    dark_times: Sequence[float] | None = None,
) -> CameraFigures:
    """Measure a camera by photon transfer on uniform illumination.

    Args:
        flats: one burst of at least two frames per light level, in any order; saturated levels are allowed.
        darks: bursts without light; the first must have the exposure time of the flats.
        flat_times, dark_times: exposure time of each burst, seconds.

    Raises:
        ValueError: there are no levels, or sizes or numbers of exposure times differ.
        NotMeasurable: there are too few levels, all are saturated, or the noise does not grow with the signal.
    """
    _require_equal(flats, darks, flat_times, dark_times)
    steps = [rounding_step(one.frames[0]) for one in (*flats, *darks)]
    flats, darks, outliers, rows, columns = _cleaned(flats, darks)
    order = np.argsort([float(flat.frames.mean()) for flat in flats])
    levels = tuple(level_of(flats[index], step=steps[index]) for index in order)
    dark_levels = [level_of(dark, step=step) for dark, step in zip(darks, steps[len(flats) :], strict=True)]
    dark = dark_levels[0] if dark_levels else None
    offset, zero = (dark.mean, dark.mean) if dark else (None, 0.0)
    used = _linear(levels, zero)
    if not used:
        raise NotMeasurable("the noise of all flat frames is clipped; use less light, or more if they contain zeros")
    _require_saturation(levels if dark is None else (dark, *levels), zero)
    points = [one for one in ([dark, *used] if dark else used) if one.variance > 0 and not (one.clipped or one.coarse)]
    if len(points) < 2:
        raise NotMeasurable(
            "flats at one level show no gain; add darks or levels (not any whose noise is clipped or smaller than a code)"
        )
    mean, variance, spread = np.array([(one.mean, one.variance, one.variance_error) for one in points]).T
    spread = np.hypot(spread, SCENE * np.abs(variance))
    slope, intercept, error, chi_squared = weighted_line(mean, variance, 1 / spread**2)
    error *= max(chi_squared, 1.0) ** 0.5
    if not slope > LIKELY * error:
        raise NotMeasurable(
            "the noise of the flats does not grow with their signal; use light levels that differ more, and raw frames: encoded "
            "images (JPEG, sRGB) are not linear in the light"
        )
    chosen = [index for index, level in zip(order, levels, strict=True) if any(level is one for one in used)]
    unsaturated = [flats[index] for index in chosen]
    fixed = 0.0 if dark is None else dark.image - dark.mean
    expected = [np.maximum(intercept + slope * (one.image - fixed), 0.1 * one.variance) for one in used]
    residuals = [_residual(*both) for both in zip(unsaturated, expected, strict=True)]
    # a difference less its mean over N pixels, of the frame, row or column, has a correlation of −1/(N − 1) between any two
    height, width = flats[0].frames[0].shape
    known = np.full((len(chosen), len(LAGS)), -1 / max(height * width - 1, 1))
    for lag, size, deviation in zip(np.transpose(LAGS), (width, height), (rows, columns), strict=True):
        known -= (deviation[chosen, None] > 0) * (lag == 0) / max(size - 1, 1)
    correlation = correlation_of_residuals(residuals, list(known))
    bend = response_of(mean, variance, spread, offset=None if dark is None else dark.known)
    dark_noise = None
    if dark is not None and dark.variance > 0 and not dark.coarse:
        read = float(np.sqrt(max(dark.variance, np.finfo(float).tiny)) / slope)
        own = 0.5 * dark.variance_error / (read * slope**2)
        dark_noise = Interval.normal(read, np.hypot(own, read * error / slope))
    top = levels[int(np.argmax([level.variance for level in levels]))]
    saturation = (top.mean - zero) / slope
    least = None if dark_noise is None else float(np.sqrt(dark_noise.median**2 + 0.25) + 0.5)
    half = min(levels, key=lambda level: abs(level.mean - zero - 0.5 * (top.mean - zero)))
    times = None if flat_times is None else [flat_times[index] for index in order]
    found: dict[str, Any] = {"dark_noise": dark_noise, "offset": offset, "levels": levels, "dark": dark, "bend": bend}
    found |= {"correlation": correlation, "chi_squared": chi_squared, "outliers": outliers}
    found |= {"rows": float(rows.max()), "columns": float(columns.max()), "lag": correlation_of_flats(unsaturated)}
    thirds = [(one.mean, one.third, one.third_error) for one in points if one.third is not None]
    return CameraFigures(
        gain=bend.local(Interval.normal(slope, error)),
        saturation=float(saturation),
        saturated=bool(top.mean < levels[-1].mean or top.clipped > 0),
        dynamic_range=None if least is None else float(saturation / least),
        snr_maximum=max((level.mean - zero) / np.sqrt(level.variance) for level in levels if level.mean <= top.mean),
        linearity_error=None if times is None else linearity_error(levels, times, zero, top.mean),
        dsnu=None if dark is None else float(np.sqrt(max(dark.spatial, 0.0)) / slope),
        prnu=None if dark is None else float(np.sqrt(max(half.spatial - dark.spatial, 0.0)) / (half.mean - dark.mean)),
        dark_current=None
        if dark_times is None or len(set(dark_times)) < 2
        else float(np.polyfit(np.asarray(dark_times, float), [one.mean for one in dark_levels], 1)[0] / slope),
        excess_factor=excess_factor(thirds, slope, error),
        if_linear=Interval.normal(slope, error),
        pattern=pattern_of(residuals, inflation=correlation.inflation),
        **found,
    )


def _cleaned(flats: Sequence[Burst], darks: Sequence[Burst]) -> tuple[list[Burst], list[Burst], int, Image, Image]:
    """Return flats and darks without outliers and offsets of rows and columns; the number of those, and these of each burst."""
    found, dark = [], darks[0].frames.mean(0) if darks else None
    for place, one in enumerate((*flats, *darks)):
        frames, number = without_outliers(one.frames)
        light = None if dark is None or place >= len(flats) else frames.mean(0) - dark
        frames, *deviations = _without_offsets(frames, light)
        found.append((replace(one, frames=frames), number, *deviations))
    bursts, numbers, rows_of, columns_of = zip(*found, strict=True)
    return list(bursts[: len(flats)]), list(bursts[len(flats) :]), sum(numbers), np.array(rows_of), np.array(columns_of)


def _without_offsets(frames: Image, light: Image | None) -> tuple[Image, float, float]:
    """Return frames without offsets of rows and columns, and the standard deviations of these, counts; clipped frames stay.

    The offsets are those of amplifiers, or in proportion to the (y, x) `light`, which may flicker: whichever is more likely by
    the Bayesian information criterion, because rows and columns together also describe the flicker of a vignette.
    """
    low, high = rails(frames)
    if np.any((frames <= low) | (frames >= high)):
        return frames, 0.0, 0.0
    image, every, found = frames.mean(0), np.ones(frames.shape[1:], bool), []
    for shape in (np.ones_like(image), *(() if light is None else (light / light.mean(),))):
        residual, deviations = frames - image, []
        level = (residual * shape).sum(axis=(1, 2), keepdims=True) / (shape**2).sum()
        residual -= level * shape
        for axis in (2, 1):
            spread = max(float(residual.std()), np.finfo(float).tiny)
            residual, deviation = without_bands(residual, residual / spread, every, axis=axis, shape=shape)
            deviations.append(deviation * spread)
        number = sum(size for size, one in zip(image.shape, deviations, strict=True) if one)
        likely = image.size * np.log(max(float(residual.var()), np.finfo(float).tiny)) + number * np.log(image.size)
        found.append((likely, image + level + residual, *deviations))
    _, cleaned, rows, columns = min(found, key=lambda one: one[0])
    return cleaned, rows, columns


def linearity_error(levels: Sequence[Level], times: Sequence[float], offset: float, top: float) -> float:
    """Mean relative deviation from the line of signal against exposure time, between 5 % and 95 % of saturation.

    Raises:
        NotMeasurable: there are fewer than three levels in that range.
    """
    signal, time = np.array([level.mean - offset for level in levels]), np.asarray(times, float)
    used = (signal > 0.05 * (top - offset)) & (signal < 0.95 * (top - offset))
    if used.sum() < 3:
        raise NotMeasurable(
            f"{int(used.sum())} of {len(signal)} levels are at 5 to 95 % of saturation; linearity needs 3, or omit --flat-time"
        )
    signal, time = signal[used], time[used]
    found = weighted_line(time, signal, 1 / signal**2)  # relative deviations (EMVA 1288, release 3.1, section 6.7)
    line = found.intercept + found.slope * time
    return float(np.mean(np.abs(signal - line) / line))


def _require_saturation(levels: Sequence[Level], offset: float, *, share: float = 0.7) -> None:
    """Refuse levels whose signal grows beyond that of the largest variance, which saturation, lowering variances, forbids."""
    top = max(levels, key=lambda level: level.variance)
    beyond = [level for level in levels if level.mean > top.mean and not level.clipped]
    if len(beyond) > 1 and share * (beyond[-1].mean - offset) > beyond[0].mean - offset:
        noise, least = (float(np.sqrt(max(one.variance, 0.0))) for one in (top, beyond[-1]))
        raise NotMeasurable(
            f"the noise falls from {noise:.3g} to {least:.3g} counts while the signal grows from {top.mean:.5g} to "
            f"{beyond[-1].mean:.5g}, so the response is not linear, as that of encoded images (gamma, JPEG, sRGB, logarithm), "
            "which have no single gain; use raw frames, or decode the values, and dark frames of the same setting"
        )


def _linear(levels: Sequence[Level], offset: float, *, share: float = 0.7) -> list[Level]:
    """Levels up to a share of saturation (EMVA 1288, release 3.1, section 6.6)."""
    top = levels[int(np.argmax([level.variance for level in levels]))]
    limit = offset + share * (top.mean - offset)
    seen = top.mean < levels[-1].mean or any(level.clipped for level in levels)
    free = [level for level in levels if not level.clipped]
    return [level for level in free if not seen or level.mean <= limit] or free[:1]


def _residual(burst: Burst, variance: Image) -> Residual:
    """Return differences of successive frames over the noise expected at each pixel's signal; each frame is used once."""
    number = len(burst.frames) // 2 * 2
    difference = burst.frames[0:number:2] - burst.frames[1:number:2]
    # frames may differ by a level, which becomes a pattern where it is divided by uneven noise
    z = (difference - difference.mean(axis=(1, 2), keepdims=True)) / np.sqrt(2 * variance)
    z = z / max(float(z.std()), np.finfo(float).tiny)
    return Residual(np.clip(z, -CLEAR, CLEAR), np.ones(variance.shape, bool), 0.0, np.sqrt(variance))


def _require_equal(flats: Sequence[Burst], darks: Sequence[Burst], *given: Sequence[float] | None) -> None:
    if not flats:
        raise ValueError("no flat frames were given; give two or more frames per light level")
    shapes = {burst.frames.shape[1:] for burst in (*flats, *darks)}
    if len(shapes) > 1:
        raise ValueError(f"flat and dark frames have different sizes {sorted(shapes)}; use the same binning and region")
    for dark in darks:
        dark.require_unsaturated(dark=True)
    for name, times, bursts in zip(("flat", "dark"), given, (flats, darks), strict=True):
        if times is not None and len(times) != len(bursts):
            raise ValueError(f"{len(times)} exposure times for {len(bursts)} {name} bursts; give one for each")
    if darks and min(float(flat.frames.mean()) for flat in flats) <= float(darks[0].frames.mean()):
        raise ValueError("the dark frames are as bright as a flat level; give dark frames taken without light")
