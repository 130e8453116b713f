"""Whether some tilts are blurred against others: by the masses of the rows, which no tilt changes, and by steps in sharpness."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.series.tilt_series import TiltSeries
from recon.verdict.coarse import line_integrals
from recon.verdict.residuals import Residuals
from recon.verdict.verdict import Finding

Array = NDArray[Any]
_SMALLEST = 40  # pixels along y: of 512 good series the only ones that seemed blurred by chance had 24 or 32
_GROWTH, _GROWTH_SCORE = (
    2.5,
    2.8,
)  # pixels² of variance from 0° to 90°; standard errors: chance gives one in four hundred
_SCALES, _ALIKE, _BETTER = (0.5, 0.7, 1.4, 2.0), 0.9, 0.1  # correlation of rows; beyond that at one magnification
_RUN, _SPAN = 8, 30.0  # tilts before and after a step, and degrees at most: over more, good slabs change by 0.77
_STEP, _STEP_SCORE = 0.75, 4.0  # share of the fine structure that is lost, good series 0.68; standard errors
_LAGS = (1, 4)  # pixels: what is shared so far is free of white noise, and what is lost in between is fine structure
_ADVICE = "leave out the blurred tilts, or blur all tilts equally"


def sharpness_findings(tilt_series: TiltSeries, residuals: Residuals) -> tuple[dict[str, Any], list[Finding]]:
    """Evidence and findings about blur that differs from tilt to tilt.

    A volume follows most of such a blur: each tilt alone says how sharp it is in its own direction. Only the sum of each row of
    line integrals is common to all tilts, and neighbouring tilts, which show nearly the same.
    """
    if residuals.images.shape[1] < _SMALLEST:
        return {}, []
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
            f"between {angles[where - 1]:g}° and {angles[where]:g}° the fine structure changes by {min(step, 1):.0%}: tilts to "
            "one side are out of focus"
        )
        findings.append(Finding("resolution", min(2.9, 1 + (step - _STEP) / (1 - _STEP)), words, _ADVICE))
    return evidence, findings


def _magnified(masses: Array) -> list[Finding]:
    """Whether the rows of both halves of the series agree at another magnification alone, by their sums (tilt, y)."""
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
    return [Finding("magnification", 6.0, words, "bring all images to one pixel size", "seen")]


def _integrals(tilt_series: TiltSeries, residuals: Residuals) -> Array:
    """(tilt, y, u) line integrals in order of the angle, with what is masked as the volume predicts it."""
    images = residuals.projections + residuals.residual
    order = np.argsort(tilt_series.tilt_angles, kind="stable")
    beam = None if tilt_series.beam is None else tilt_series.beam[order]
    ordered = replace(tilt_series, images=images, tilt_angles=residuals.tilt_angles, mask=None, beam=beam)
    return line_integrals(ordered, images, 1)


def blurs(images: Array) -> tuple[Array, Array]:
    """(tilt,) half the variance of a blur along y, pixels², against the mean of all tilts, and its standard errors.

    The sums of rows are regressed on the mean of all tilts, its slope and its curvature, with White's errors.
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
    """Variance of the blur that grows with sin² of the tilt, pixels², and the same in standard errors."""
    place, weights = np.sin(np.deg2rad(angles)) ** 2, 1 / errors**2
    place = place - (weights * place).sum() / weights.sum()
    known = float((weights * place**2).sum())
    slope = float((weights * place * values).sum()) / max(known, 1e-30)
    return 2 * slope, slope * float(np.sqrt(known))


def _step(images: Array, angles: Array) -> tuple[float, int]:
    """The largest share of fine structure that is lost from one run of tilts to the next, where it is beyond chance."""
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
    """(tilt,) mean product of pixels so far apart, along y and along u."""
    along_y = (images[:, lag:] * images[:, :-lag]).mean((1, 2))
    along_u = (images[:, :, lag:] * images[:, :, :-lag]).mean((1, 2))
    return np.asarray((along_y + along_u) / 2)
