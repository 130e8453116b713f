"""The tilt axis, the scale of the angles and the response of the detector, from the moments of each row of the images.

Moment k of a row of line integrals is a trigonometric polynomial of degree k of the tilt, of the parity of k, if the object lies
within the field (Helgason–Ludwig conditions, doi:10.1002/cpa.3160190207). No volume absorbs a violation, unlike left-out tilts,
which a volume of blurred arcs predicts well.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from scipy import ndimage

from noiseflow.checks import Effect, NotTested
from noiseflow.statistics import Array, weighted_line, white_regression
from recon.series.tilt_series import TiltSeries
from recon.verdict.compared import Coarse, Fitted, Residuals, above_vacuum, inverted, neighbours

# groups of rows, whose errors are independent; the smallest number with a standard error that four of them exceed by chance in
# one of a thousand tests
_GROUPS = 12
# variation of the brightness of the images that no other check minds; the squares of a round needle vary by 1 % over its tilts,
# so that half a percent of brightness seems a loss of 80 % by the response
_STEADY = 0.01


class Violations(NamedTuple):
    """Violations of the moment conditions, as the faults that explain them.

    Attributes:
        direction: rotation of the axis in the images, degrees.
        turn: its change from the first to the last tilt, degrees.
        offset: distance of the axis from the middle of the images, detector pixels.
        response: share of the signal that a response t − c·t² loses at the strongest contrast.
        scale: error of the tilt angles, as a share.
        power: all violations common to neighbouring rows, relative to the moments.
    """

    direction: Effect
    turn: Effect
    offset: Effect
    response: Effect
    scale: Effect
    power: Effect


_BIASED = _RESPONSE, _SCALE, _ = [Violations._fields.index(name) for name in ("response", "scale", "power")]


def violations(
    coarse: Coarse, images: Array, fitted: Callable[[Array], Array], replicates: Iterable[tuple[Array, Array]]
) -> Violations:
    """The faults that the moments of all rows require.

    The moments are regressed on those of derivatives of fitted images, which have less noise. Errors are those of clusters of
    rows, or the spread of replicates where larger. The direction is found again in images turned by it, where rows agree better.

    Args:
        coarse: geometry of the images.
        images: (tilt, y, u) line integrals, whose masked pixels must be filled.
        fitted: from images to the projections of a volume of them.
        replicates: series of the given geometry, and these projections.

    Raises:
        NotTested: there are fewer rows than groups.
    """
    if images.shape[1] < _GROUPS:
        raise NotTested(f"needs {_GROUPS * coarse.binning} rows")
    value, errors, shares = _regressed(coarse, images, fitted(images))
    aligned = turned(images, float(np.rad2deg(value[0])))
    more, errors[0] = (each[0] for each in _regressed(coarse, aligned, fitted(aligned))[:2])
    value[0] += more
    values = np.array([_regressed(coarse, *each)[0] for each in replicates])
    # noise makes squares and products larger, and fitted images lack the directions of a missing wedge; the others have no such
    # bias, and a fit follows a part of them
    bias = values.mean(0)
    value[_BIASED] -= bias[_BIASED]
    errors = np.maximum(errors, values.std(0, ddof=1) * np.sqrt(1 + 1 / len(values)))
    # replicates are smoother, and overstate the bias of the scale
    errors[_SCALE] = np.hypot(errors[_SCALE], bias[_SCALE] / 2)
    units = np.array([np.rad2deg(1), np.rad2deg(1), -coarse.binning, -1.0, 1.0, 1.0])
    parts = value * units, errors * np.abs(units), shares / max(float(shares.max()), 1e-30)
    effects = (Effect(value, error, f"{abs(value):.1f}", share) for value, error, share in np.stack(parts, 1).tolist())
    return Violations(*effects)


def as_of_dark_field(series: TiltSeries, seen: Residuals, fitted: Fitted) -> Effect:
    """Change of the mass of bright-field images over the tilts, relative to that of inverted dark field.

    Mass is steady in −log(I / I0) of bright field, and in I0 − I of inverted dark field: their difference follows the most
    absorbing parts. Projections tell how much matter is within the images, and logarithms of noise are biased.
    """
    if series.mode == "linear":
        raise NotTested("the images are not bright field")
    if series.beam is not None:
        raise NotTested("the mass of each image depends on its beam, which was estimated")
    left, level, _ = above_vacuum(series, seen)
    lines, straight = (inverted(series.select(series.rising), seen.projections, each) for each in (None, fitted))
    mass, inside, more = (each.sum((1, 2)) for each in (lines + left, straight, lines - 1 + np.exp(-lines)))
    mass -= level * lines[0].size + inside * (mass.mean() / inside.mean())
    line = weighted_line(more, mass, np.ones(len(mass)))
    return Effect(max(0.0, line.slope), line.slope_error * line.chi_squared**0.5)


def _regressed(coarse: Coarse, images: Array, fitted: Array) -> tuple[Array, Array, Array]:
    """Coefficients of the columns of `Violations`, their errors, and what each explains alone."""
    height, width = fitted.shape[1:]
    theta = np.deg2rad(coarse.tilt_angles)
    moments, violated = _moments(theta, (np.arange(width) - (width - 1) / 2 - coarse.detector_offset) / (width / 2))
    along = (np.arange(height) - (height - 1) / 2)[:, None]
    across = np.arange(width) - (width - 1) / 2
    raised = fitted - fitted.mean((0, 1)).min()
    framed = np.pad(raised, ((0, 0), (0, 0), (1, 1)))  # vacuum on both sides
    shifted = (framed[:, :, 2:] - framed[:, :, :-2]) / 2
    turned = along * shifted - across * np.gradient(fitted, axis=1)
    place = ((theta - theta.mean()) / max(float(np.ptp(theta)), 1e-30))[:, None, None]
    squared = raised**2 / max(float(np.quantile(raised, 0.99)), 1e-30)
    later = theta[:, None, None] * slope_over_tilts(fitted, coarse.tilt_angles)
    values = violated(images)
    groups = np.broadcast_to(np.arange(height) * _GROUPS // height, values.shape).ravel()
    parts = (turned, place * turned, shifted, squared, later)
    columns = np.stack([violated(each).ravel() for each in parts], 1)
    found, errors = white_regression(columns[:, :4], values.ravel(), clusters=groups)
    # the scale apart, because over a small range of angles it resembles an offset
    apart = (each[-1] for each in white_regression(columns[:, [0, 2, 4]], values.ravel(), clusters=groups))
    power = neighbours(values, 2) / max(neighbours(moments(images - images.mean()), 2), 1e-30)
    errors[_RESPONSE] = np.hypot(errors[_RESPONSE], _brightness_as_response(raised, squared, columns[:, :4], violated))
    found, errors = (np.append(*each) for each in zip((found, errors), apart, strict=True))
    alone = explained_alone(columns, values.ravel())
    return np.append(found, power), np.append(errors, 0.0), np.append(alone, alone.max())


def _brightness_as_response(raised: Array, squared: Array, columns: Array, violated: Callable[[Array], Array]) -> float:
    """The response found where the brightness of the images varies by `_STEADY` as the sums of their squares do."""
    sums = squared.sum((1, 2)) / np.maximum(raised.sum((1, 2)), 1e-30)
    deviation = (sums - sums.mean()) / max(float(sums.std()), 1e-30)
    unlike = violated(_STEADY * deviation[:, None, None] * raised)
    return abs(float(white_regression(columns, unlike.ravel())[0][_RESPONSE]))


def explained_alone(columns: Array, values: Array) -> Array:
    """(K,) sum of squares of values (N,) that each of the columns (N, K) explains without the others."""
    return np.asarray((values @ columns) ** 2 / np.maximum((columns**2).sum(0), 1e-30))


def turned(images: Array, degrees: float) -> Array:
    """Images (tilt, y, u), each turned in its plane by the direction of the axis, from y towards u."""
    return np.asarray(ndimage.rotate(images, degrees, axes=(1, 2), reshape=False, order=1, mode="nearest"))


def slope_over_tilts(images: Array, tilt_angles: Array) -> Array:
    """Derivative of images (tilt, y, u) with respect to the tilt angle, per radian; duplicates count as one angle."""
    angles, first, back = np.unique(np.round(tilt_angles, 3), return_index=True, return_inverse=True)
    if len(angles) < 2:
        return np.zeros_like(images)
    return np.asarray(np.gradient(images[first], np.deg2rad(angles), axis=0)[back])


def _moments(
    theta: Array, place: Array, *, highest: int = 4
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """The maps from images (tilt, y, u) to their moments (moment, tilt, y), and to the part of these that no object has: with two
    moments, a slab of few counts has an axis wrong by 1.7°, and six give no smaller errors."""
    polynomials = np.linalg.qr(legendre.legvander(place, highest))[0]
    beside = []
    for degree in range(highest + 1):
        harmonics = np.arange(degree % 2, degree + 1, 2) * theta[:, None]
        basis = np.hstack([np.cos(harmonics), np.sin(harmonics)])
        beside.append(np.eye(len(theta)) - basis @ np.linalg.pinv(basis, rcond=1e-6))

    def moments(images: Array) -> Array:
        return np.asarray(np.einsum("tyu,uk->kty", images, polynomials, optimize=True))

    return moments, lambda each: np.asarray(np.einsum("kst,kty->ksy", np.stack(beside), moments(each), optimize=True))
