"""Blur and magnification that differ between tilts, from the row sums, which tilting preserves, and from steps in sharpness."""

from dataclasses import replace

import numpy as np

from noiseflow.checks import SIGNIFICANT, Effect, NotTested
from noiseflow.statistics import Array, rarely_exceeded, white_regression
from recon.series.tilt_series import TiltSeries
from recon.verdict.compared import Fitted, Residuals, inverted

# pixels along y: among 512 good series, the only false positives had 24 or 32
_SMALLEST = 40
# tilts before and after a step
_RUN = 8
_RARE = rarely_exceeded(SIGNIFICANT, 2 * (_RUN - 1))


def growing_blur(images: Array, angles: Array) -> Effect:
    """Variance of a blur that grows with the tilt, pixels² towards 90°.

    A volume absorbs most of such a blur, because each tilt determines the sharpness in its own direction. The test therefore
    uses the sums of rows of line integrals, which are common to all tilts.
    """
    if images.shape[1] < _SMALLEST:
        raise NotTested(f"needs {_SMALLEST} rows")
    values, errors = blurs(images)
    place, weights = np.sin(np.deg2rad(angles)) ** 2, 1 / errors**2
    place = place - (weights * place).sum() / weights.sum()
    known = max(float((weights * place**2).sum()), 1e-30)
    growth = 2 * float((weights * place * values).sum()) / known
    return Effect(max(growth, 0.0), 2 / float(np.sqrt(known)))


def focus_step(images: Array, angles: Array, *, lags: tuple[int, int] = (1, 4), span: float = 30.0) -> Effect:
    """The largest significant loss of fine structure from one range of tilts to the next, as a share.

    Correlations at two `lags`, pixels, exclude white noise, and their difference is fine structure. Over a larger `span`,
    degrees, that of good slabs changes by 0.77.
    """
    if images.shape[1] < _SMALLEST:
        raise NotTested(f"needs {_SMALLEST} rows")
    flat = images - images.mean((1, 2), keepdims=True)
    fine, found = _shared(flat, lags[0]) - _shared(flat, lags[1]), Effect(0.0)
    for start in range(_RUN, len(fine) - _RUN + 1):
        parts = slice(start - _RUN, start), slice(start, start + _RUN)
        (one, first), (other, second) = ((float(fine[part].mean()), float(fine[part].var(ddof=1))) for part in parts)
        lost, error = abs(one - other), float(np.sqrt((first + second) / _RUN))
        share, narrow = lost / max(one, other, 1e-30), max(np.ptp(angles[part]) for part in parts) <= span
        if lost > _RARE * error and share > found.value and narrow:
            found = Effect(share, what=f"{angles[start - 1]:g}° and {angles[start]:g}°")
    return found


def magnified(images: Array) -> Effect:
    """Improvement of the correlation of row sums of both halves of the series at different magnifications."""
    masses = images.sum(2)
    half = len(masses) // 2
    first, second = masses[:half].mean(0), masses[half:].mean(0)
    y = np.arange(len(first)) - (len(first) - 1) / 2
    if not (np.ptp(first) and np.ptp(second)):
        raise NotTested("the object does not change along the axis")

    def alike(scale: float) -> float:
        stretched = np.interp(y / max(scale, 1.0), y, first), np.interp(y * min(scale, 1.0), y, second)
        return float(np.corrcoef(*stretched)[0, 1])

    best = max((2**-1, 2**-0.5, 2**0.5, 2), key=alike)
    return Effect(alike(best) - alike(1.0) if alike(best) > 0.9 else 0.0, what=f"{best:g}")


def sharp_integrals(tilt_series: TiltSeries, residuals: Residuals, fitted: Fitted = None) -> Array:
    """(tilt, y, u) line integrals sorted by angle; masked pixels are replaced by the prediction of the volume."""
    order = np.argsort(tilt_series.tilt_angles, kind="stable")
    beam = None if tilt_series.beam is None else tilt_series.beam[order]
    mask = None if residuals.used.all() else residuals.used
    ordered = replace(tilt_series, images=residuals.images, tilt_angles=residuals.tilt_angles, mask=mask, beam=beam)
    return inverted(ordered, residuals.images, fitted)


def blurs(images: Array) -> tuple[Array, Array]:
    """(tilt,) half the variance of a blur along y, pixels², relative to the mean of all tilts, and its standard errors.

    Row sums are regressed on the mean of all tilts, its slope and its curvature, with White's standard errors.
    """
    masses = images.sum(2)
    mean = masses.mean(0)
    slope = np.gradient(mean)
    columns = np.stack([np.ones_like(mean), mean, slope, np.gradient(slope)], 1)[1:-1]
    found, errors = white_regression(columns, (masses - mean)[:, 1:-1])
    return found[:, 3], errors[:, 3]


def _shared(images: Array, lag: int) -> Array:
    """(tilt,) mean product of pixels at a distance of `lag`, along y and along u."""
    along_y = (images[:, lag:] * images[:, :-lag]).mean((1, 2))
    along_u = (images[:, :, lag:] * images[:, :, :-lag]).mean((1, 2))
    return np.asarray((along_y + along_u) / 2)
