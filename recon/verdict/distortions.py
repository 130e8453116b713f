"""Distortions of each image relative to the projection of the volume: shift, rotation, magnification, brightness, angle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from noiseflow.statistics import robust_deviation
from recon.verdict.residuals import Residuals

Array = NDArray[Any]
NAMES = ("shift along y", "shift across", "magnification", "rotation", "tilt angle", "brightness", "background")
_TWIN, _FEWEST = 0.02, 3  # degrees within which angles are equal; smallest number of tilts for a standard deviation
_DEGREE = 5  # of polynomials over the tilts: drifts and wrong angles are smooth, noise is not


@dataclass(frozen=True)
class Distortion:
    """One type of distortion over all tilts.

    Attributes:
        size: rms over the inner tilts, without the mean and the expected random part; pixels at the image edge, or a share of
            the contrast.
        smooth: rms of its smooth part over the tilts, same unit.
        rough: standard deviation around its smooth part without the expected random part, same unit; robust to outliers.
        mean: mean over all tilts, same unit.
        scatter: rms of the deviations from the mean in standard errors; 1 for random errors.
        trend: rms of the coefficients of the smooth part in standard errors; 1 for random errors.
        offset: the mean in standard errors.
        values: (tilt,) measured values.
    """

    size: float
    smooth: float
    rough: float
    mean: float
    scatter: float
    trend: float
    offset: float
    values: Array


def distortions(residuals: Residuals) -> dict[str, Distortion]:
    """Regress each residual on the effects of small distortions of its image, with robust standard errors.

    The standard errors are White's (doi:10.2307/1912934), which do not require Gaussian or homoscedastic noise. Fitted volumes
    absorb a part of each distortion, so the result is a lower bound. Tilts at the ends of the range are measured but not
    included, because there a regularised volume has neighbours on one side only, and its projection lags behind the image.
    """
    found = [_of_tilt(*pair) for pair in _fields(residuals)]
    estimates, errors = zip(*found, strict=True)
    units = _units(residuals)
    return {
        name: _over_tilts(np.array(estimates)[:, number] * unit, np.array(errors)[:, number] * unit, residuals)
        for number, (name, unit) in enumerate(zip(NAMES, units, strict=True))
    }


def _units(residuals: Residuals) -> tuple[float, ...]:
    """Factors from coefficients to pixels at the image edge, or to shares of the contrast."""
    edge = residuals.images.shape[2] / 2
    return 1.0, 1.0, edge, edge, edge, 1.0, 1 / max(residuals.contrast, 1e-30)


def _fields(residuals: Residuals) -> Iterator[tuple[Array, Array]]:
    """Yield the columns and the target of the regression for each tilt."""
    width = residuals.images.shape[2]
    across = np.arange(width, dtype=np.float64) - (width - 1) / 2
    along = (residuals.height - residuals.height.mean())[:, None].astype(
        np.float64
    )  # relative to the middle of these slices
    by_angle = _slope_over_tilts(residuals)
    for tilt, (image, residual) in enumerate(zip(residuals.projections, residuals.residual, strict=True)):
        down = np.gradient(image, axis=0) if image.shape[0] > 1 else np.zeros_like(image)
        right = np.gradient(image, axis=1)
        columns = (down, right, along * down + across * right, along * right - across * down)
        use = residuals.used[tilt].ravel()
        brightness = image - image.mean()
        parts = [*columns, by_angle[tilt], brightness, np.ones_like(image)]
        yield np.stack([part.ravel()[use] for part in parts], 1), residual.ravel()[use].astype(np.float64)


def _slope_over_tilts(residuals: Residuals) -> Array:
    """Derivative of the projections with respect to the tilt angle, per radian; duplicates count as one angle."""
    angles, first, back = np.unique(np.round(residuals.tilt_angles, 3), return_index=True, return_inverse=True)
    if len(angles) < 2:
        return np.zeros_like(residuals.projections)
    return np.asarray(np.gradient(residuals.projections[first], np.deg2rad(angles), axis=0)[back])


def _of_tilt(columns: Array, residual: Array) -> tuple[Array, Array]:
    """Coefficients and their standard errors; undetermined coefficients have infinite errors."""
    scale = np.sqrt((columns**2).sum(0)) + 1e-30
    scaled = columns / scale
    inverse = np.linalg.inv(scaled.T @ scaled + 1e-6 * np.eye(columns.shape[1]))
    found = inverse @ (scaled.T @ residual)
    left = scaled * (residual - scaled @ found)[:, None]
    variance: Array = np.diag(inverse @ (left.T @ left) @ inverse)
    return found / scale, np.sqrt(np.maximum(variance, 1e-30)) / scale


def _over_tilts(measured: Array, errors: Array, residuals: Residuals) -> Distortion:
    angles = residuals.tilt_angles
    inner = (angles > angles.min() + _TWIN) & (angles < angles.max() - _TWIN)
    if inner.sum() < _FEWEST:
        inner[:] = True
    angles, values, errors = angles[inner], measured[inner], errors[inner]
    weights = 1 / errors**2
    mean = float((weights * values).sum() / weights.sum())
    away = values - mean
    count = len(values)
    scatter = float(np.sqrt((away**2 * weights).sum() / max(1, count - 1)))
    place = 2 * (angles - angles[0]) / max(float(np.ptp(angles)), 1e-9) - 1
    basis = legendre.legvander(place, min(_DEGREE, max(1, count - 2)))
    covariance = np.linalg.pinv((basis * weights[:, None]).T @ basis)
    curve = covariance @ (basis.T @ (weights * values))
    inside = np.linalg.pinv(covariance[1:, 1:])
    trend = float(np.sqrt(max(0.0, float(curve[1:] @ inside @ curve[1:])) / (len(curve) - 1)))
    smooth = float(np.sqrt(np.mean((basis[:, 1:] @ curve[1:]) ** 2)))
    left = robust_deviation(away - basis @ curve + mean, 0.0)
    rough = float(np.sqrt(max(0.0, left**2 - float(np.median(errors**2)))))
    size = float(np.sqrt(max(0.0, np.mean(away**2 - errors**2))))
    return Distortion(size, smooth, rough, mean, scatter, trend, mean * float(np.sqrt(weights.sum())), measured)
