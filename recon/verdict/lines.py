"""Lines of the images that are displaced relative to the lines beside them, in single images or in all of them.

Each displacement is measured twice, from different pixels or tilts. Noise and misfit of the two are independent, so that the
mean of their products is the variance of the displacements alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Effect
from noiseflow.statistics import white_regression
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


def uneven_axis(images: Array, tilt_angles: Array) -> Effect:
    """Distance of the axis of single rows from that of the rows beside them, pixels rms.

    The first moment of a row of line integrals (tilt, y, u), divided by its sum, is a sinusoid of the tilt around the axis.
    """
    place = np.arange(images.shape[2]) - (images.shape[2] - 1) / 2
    raised = images - np.quantile(images, 0.02)
    mass, first = raised.sum(2).mean(0), (raised * place).sum(2)
    mass = np.maximum(mass, 0.05 * mass.max())  # rows without an object have no axis
    theta, found = np.deg2rad(tilt_angles), []
    for half in (slice(0, None, 2), slice(1, None, 2)):
        basis = np.stack([np.ones_like(theta[half]), np.cos(theta[half]), np.sin(theta[half])], 1)
        found.append([each[:, 0] / mass for each in white_regression(basis, first[half].T)])
    offsets, errors = (np.array(each)[:, None] for each in zip(*found, strict=True))
    return _scatter(offsets, errors**2)


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
    """The deviation of lines from the mean of both neighbours, and the standard error of its mean over lines or tilts."""
    one, other = np.clip(_beside(shifts, -0.5), -_PART, _PART)
    weights = np.prod(1 / (1 + _beside(variances, 0.25)), axis=0)
    products = weights * one * other * weights.size / weights.sum() / 1.5  # of three lines
    parts = products.mean(1) if len(products) > 1 else products[0]
    variance = max(float(parts.mean()), 0.0)
    error = float(parts.std(ddof=1) / np.sqrt(len(parts)))
    return Effect(float(np.sqrt(variance)), error / max(float(np.sqrt(variance)), 1e-30))


def _beside(lines: Array, factor: float) -> Array:
    """(..., line) each inner line plus a factor times both neighbours."""
    return np.asarray(lines[..., 1:-1] + factor * (lines[..., :-2] + lines[..., 2:]))
