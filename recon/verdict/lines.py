"""Lines of the images that are displaced relative to the lines beside them in single images.

Each displacement is measured twice, from different pixels. Noise and misfit of the two are independent, so that the
mean of their products is the variance of the displacements alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Effect
from recon.verdict.residuals import Residuals

Array = NDArray[Any]
# pixels: widths of the parts of a line that are measured apart, because detectors correlate neighbours; larger displacements
# are not measured by the slope of a line
_PART = 4


def displaced_lines(residuals: Residuals) -> Effect:
    """Displacement of single rows or columns along themselves, pixels rms."""

    def scatter(axis: int) -> Effect:
        return _scatter(*_shifts(np.moveaxis(residuals.projections, axis, 2), np.moveaxis(residuals.residual, axis, 2)))

    return max(scatter(1), scatter(2))


def _shifts(images: Array, residual: Array) -> tuple[Array, Array]:
    """(part, tilt, line) shifts of the lines (tilt, line, pixel) and their variances."""
    slope, part = np.gradient(images, axis=2), np.arange(images.shape[2]) // _PART % 2
    shifts, variances = [], []
    for number in (0, 1):
        shape, slopes, left = (each[:, :, part == number] for each in (images, slope, residual))
        shape, slopes, left = (each - each.mean(2, keepdims=True) for each in (shape, slopes, left))
        power = (shape**2).sum(2, keepdims=True) + 1e-30
        slopes, left = (each - shape * (each * shape).sum(2, keepdims=True) / power for each in (slopes, left))
        known = np.maximum((slopes**2).sum(2), 1e-30)
        shifts.append((slopes * left).sum(2) / known)
        variances.append((left**2).mean(2) / known)
    return np.array(shifts), np.array(variances)


def _scatter(shifts: Array, variances: Array) -> Effect:
    """The deviation of lines from the mean of both neighbours, and the standard error of its mean over tilts."""
    one, other = np.clip(_beside(shifts, -0.5), -_PART, _PART)
    weights = np.prod(1 / (1 + _beside(variances, 0.25)), axis=0)
    parts = (weights * one * other).mean(1) * weights.size / weights.sum() / 1.5  # of three lines
    variance = max(float(parts.mean()), 0.0)
    error = float(parts.std(ddof=1) / np.sqrt(len(parts)))
    return Effect(float(np.sqrt(variance)), error / max(float(np.sqrt(variance)), 1e-30))


def _beside(lines: Array, factor: float) -> Array:
    """(..., line) each inner line plus a factor times both neighbours."""
    return np.asarray(lines[..., 1:-1] + factor * (lines[..., :-2] + lines[..., 2:]))
