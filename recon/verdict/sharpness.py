"""Detection of blur that differs between tilts, from the row sums, which tilting preserves, and from steps in sharpness."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import NotTested
from recon.series.first_guess import estimate_response
from recon.series.tilt_series import TiltSeries
from recon.verdict.coarse import inverted
from recon.verdict.residuals import Residuals
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_SMALLEST = 40  # pixels along y: among 512 good series, the only false positives had 24 or 32
_GROWTH, _GROWTH_SCORE = (
    2.5,
    2.8,
)  # pixels² of variance from 0° to 90°; standard errors, with a probability of 1 in 400 by chance
_SCALES, _ALIKE, _BETTER = (
    (0.5, 0.7, 1.4, 2.0),
    0.9,
    0.1,
)  # magnifications; correlation of rows; improvement over equal magnification
_RUN, _SPAN = (
    8,
    30.0,
)  # tilts before and after a step, within this range in degrees; over larger ranges, good slabs change by 0.77
_STEP, _STEP_SCORE = 0.75, 4.0  # lost share of the fine structure, up to 0.68 in good series; standard errors
_LAGS = (1, 4)  # pixels: correlations at these lags exclude white noise, and their difference is fine structure
_ADVICE = "exclude the blurred tilts, or blur all tilts equally"


def sharpness_findings(tilt_series: TiltSeries, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Evidence and findings about blur that differs from tilt to tilt.

    A volume absorbs most of such a blur, because each tilt determines the sharpness in its own direction. The test therefore uses
    the sums of rows of line integrals, which are common to all tilts, and neighbouring tilts, which are nearly equal.
    """
    if residuals.images.shape[1] < _SMALLEST:
        raise NotTested(f"needs {_SMALLEST} rows")
    images, angles = _integrals(tilt_series, residuals), residuals.tilt_angles
    growth, score = _growth(*blurs(images), angles)
    step, where = _step(images, angles)
    evidence = {"blur": {"growth": growth, "score": score, "step": step}}
    findings = _magnified(images.sum(2))
    if growth > _GROWTH and score > _GROWTH_SCORE:
        words = f"the blur of the images grows with their tilt, to {np.sqrt(growth):.1f} pixels towards 90°"
        findings.append(Finding("resolution", min(2.9, growth / _GROWTH), words, _ADVICE))
    if step > _STEP:
        words = (
            f"between {angles[where - 1]:g}° and {angles[where]:g}° the fine structure changes by {min(step, 1):.0%}: tilts on "
            "one side are out of focus"
        )
        findings.append(Finding("resolution", min(2.9, 1 + (step - _STEP) / (1 - _STEP)), words, _ADVICE))
    return evidence, findings


def _magnified(masses: Array) -> list[Finding]:
    """Whether the row sums (tilt, y) of both halves of the series agree only at different magnifications."""
    half = len(masses) // 2
    first, second = masses[:half].mean(0), masses[half:].mean(0)
    y = np.arange(len(first)) - (len(first) - 1) / 2

    def alike(scale: float) -> float:
        stretched = np.interp(y / max(scale, 1.0), y, first), np.interp(y * min(scale, 1.0), y, second)
        return float(np.corrcoef(*stretched)[0, 1])

    best = max(_SCALES, key=alike)
    if alike(best) < max(_ALIKE, alike(1.0) + _BETTER):
        return []
    words = f"the second half of the tilts shows the specimen {best:g} times as large as the first"
    return [Finding("magnification", 6.0, words, "rescale all images to one pixel size", "seen")]


def _integrals(tilt_series: TiltSeries, residuals: Residuals) -> Array:
    """(tilt, y, u) line integrals sorted by angle; masked pixels are replaced by the prediction of the volume."""
    order = np.argsort(tilt_series.tilt_angles, kind="stable")
    beam = None if tilt_series.beam is None else tilt_series.beam[order]
    mask = None if residuals.used.all() else residuals.used
    ordered = replace(tilt_series, images=residuals.images, tilt_angles=residuals.tilt_angles, mask=mask, beam=beam)
    return inverted(estimate_response(ordered), residuals.images)


def blurs(images: Array) -> tuple[Array, Array]:
    """(tilt,) half the variance of a blur along y, pixels², relative to the mean of all tilts, and its standard errors.

    Row sums are regressed on the mean of all tilts, its slope and its curvature, with White's standard errors.
    """
    masses = images.sum(2)
    mean = masses.mean(0)
    slope = np.gradient(mean)
    columns = np.stack([np.ones_like(mean), mean, slope, np.gradient(slope)], 1)[1:-1]
    rows, fitted = columns.shape
    scale = np.sqrt((columns**2).sum(0)) + 1e-30
    scaled = columns / scale
    inverse = np.linalg.pinv(scaled.T @ scaled)
    away = (masses - mean)[:, 1:-1]
    found = away @ scaled @ inverse
    left = away - found @ scaled.T
    spread = (scaled @ inverse)[:, 3]
    errors = np.sqrt((left**2) @ spread**2 * rows / max(1, rows - fitted))
    return found[:, 3] / scale[3], np.maximum(errors, 1e-30) / scale[3]


def _growth(values: Array, errors: Array, angles: Array) -> tuple[float, float]:
    """Variance of a blur proportional to sin² of the tilt, pixels², and the same in standard errors."""
    place, weights = np.sin(np.deg2rad(angles)) ** 2, 1 / errors**2
    place = place - (weights * place).sum() / weights.sum()
    known = float((weights * place**2).sum())
    slope = float((weights * place * values).sum()) / max(known, 1e-30)
    return 2 * slope, slope * float(np.sqrt(known))


def _step(images: Array, angles: Array) -> tuple[float, int]:
    """The largest significant loss of fine structure from one range of tilts to the next, as a share, and its position."""
    flat = images - images.mean((1, 2), keepdims=True)
    near, far = (_shared(flat, lag) for lag in _LAGS)
    fine = near - far
    largest, where = 0.0, 0
    for start in range(_RUN, len(fine) - _RUN + 1):
        before, after = fine[start - _RUN : start], fine[start : start + _RUN]
        lost = abs(float(before.mean() - after.mean()))
        error = float(np.sqrt((before.var(ddof=1) + after.var(ddof=1)) / _RUN))
        narrow = max(np.ptp(angles[start - _RUN : start]), np.ptp(angles[start : start + _RUN])) <= _SPAN
        share = lost / max(float(before.mean()), float(after.mean()), 1e-30)
        if lost > _STEP_SCORE * error and share > largest and narrow:
            largest, where = share, start
    return largest, where


def _shared(images: Array, lag: int) -> Array:
    """(tilt,) mean product of pixels at a distance of `lag`, along y and along u."""
    along_y = (images[:, lag:] * images[:, :-lag]).mean((1, 2))
    along_u = (images[:, :, lag:] * images[:, :, :-lag]).mean((1, 2))
    return np.asarray((along_y + along_u) / 2)
