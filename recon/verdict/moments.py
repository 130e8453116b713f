"""The tilt axis and the scale of the angles, from the moments of each row of the images.

Moment k of a row of line integrals is a trigonometric polynomial of degree k of the tilt, of the parity of k, if the object lies
within the field (Helgason–Ludwig conditions, doi:10.1002/cpa.3160190207). No volume absorbs a violation, unlike left-out tilts,
which a volume of blurred arcs predicts well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from noiseflow.checks import Effect, NotTested
from noiseflow.statistics import white_regression
from recon.verdict.coarse import Coarse

Array = NDArray[Any]
# highest moment: with two, a slab of few counts has an axis wrong by 1.7°, and six give no smaller errors
_MOMENTS = 4
# groups of rows, whose errors are independent; the smallest number with a standard error that four of them exceed by chance in
# one of a thousand tests
_GROUPS = 12


class Axis(NamedTuple):
    """Violations of the moment conditions, as the errors of the geometry that explain them.

    Attributes:
        direction: rotation of the axis in the images, degrees.
        turn: its change from the first to the last tilt, degrees.
        offset: distance of the axis from the middle of the images, detector pixels.
        scale: error of the tilt angles, as a share.
    """

    direction: Effect
    turn: Effect
    offset: Effect
    scale: Effect


def axis(coarse: Coarse, fitted: Array) -> Axis:
    """The axis that the moments of all rows require.

    The moments are regressed on those of the derivatives of the fitted images; standard errors are those of clusters of rows.

    Args:
        coarse: line integrals; masked pixels must be filled.
        fitted: (tilt, y, u) images of a volume, whose derivatives have less noise than those of the images.

    Raises:
        NotTested: there are fewer rows than groups.
    """
    height, width = fitted.shape[1:]
    if height < _GROUPS:
        raise NotTested(f"needs {_GROUPS} rows")
    theta = np.deg2rad(coarse.tilt_angles)
    violated = _violation(theta, (np.arange(width) - (width - 1) / 2 - coarse.detector_offset) / (width / 2))
    along = (np.arange(height) - (height - 1) / 2)[:, None]
    across = np.arange(width) - (width - 1) / 2
    raised = np.pad(fitted - fitted.mean((0, 1)).min(), ((0, 0), (0, 0), (1, 1)))  # vacuum on both sides
    shifted = (raised[:, :, 2:] - raised[:, :, :-2]) / 2
    turned = along * shifted - across * np.gradient(fitted, axis=1)
    place = ((theta - theta.mean()) / max(float(np.ptp(theta)), 1e-9))[:, None, None]
    later = theta[:, None, None] * slope_over_tilts(fitted, coarse.tilt_angles)
    values = violated(coarse.images)
    groups = np.broadcast_to(np.arange(height) * _GROUPS // height, values.shape).ravel()
    columns = np.stack([violated(each).ravel() for each in (turned, place * turned, shifted, later)], 1)
    shares = explained_alone(columns, values.ravel())
    units = np.array([np.rad2deg(1), np.rad2deg(1), -coarse.binning, 1.0])

    def estimated(some: list[int]) -> list[Effect]:
        found, errors = white_regression(columns[:, some], values.ravel(), clusters=groups)
        parts = found * units[some], errors * np.abs(units[some]), shares[some] / max(float(shares.max()), 1e-30)
        return [Effect(value, error, f"{abs(value):.1f}", share) for value, error, share in np.stack(parts, 1).tolist()]

    # the scale apart, because over a small range of angles it resembles an offset
    direction, turn, offset = estimated([0, 1, 2])
    return Axis(direction, turn, offset, scale=estimated([0, 2, 3])[-1])


def explained_alone(columns: Array, values: Array) -> Array:
    """(K,) sum of squares of values (N,) that each of the columns (N, K) explains without the others."""
    return np.asarray((values @ columns) ** 2 / np.maximum((columns**2).sum(0), 1e-30))


def slope_over_tilts(images: Array, tilt_angles: Array) -> Array:
    """Derivative of images (tilt, y, u) with respect to the tilt angle, per radian; duplicates count as one angle."""
    angles, first, back = np.unique(np.round(tilt_angles, 3), return_index=True, return_inverse=True)
    if len(angles) < 2:
        return np.zeros_like(images)
    return np.asarray(np.gradient(images[first], np.deg2rad(angles), axis=0)[back])


def _violation(theta: Array, place: Array) -> Callable[[Array], Array]:
    """The map from images (tilt, y, u) to the part of their moments (moment, tilt, y) that no object within the field has."""
    polynomials = np.linalg.qr(legendre.legvander(place, _MOMENTS))[0]
    beside = []
    for degree in range(_MOMENTS + 1):
        harmonics = np.arange(degree % 2, degree + 1, 2) * theta[:, None]
        basis = np.hstack([np.cos(harmonics), np.sin(harmonics)])
        beside.append(np.eye(len(theta)) - basis @ np.linalg.pinv(basis, rcond=1e-6))
    return lambda images: np.einsum("kst,tyu,uk->ksy", np.stack(beside), images, polynomials, optimize=True)
