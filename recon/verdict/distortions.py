"""Distortions of each image relative to the projection of the volume: shift, rotation, magnification, brightness, background."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy import ndimage, optimize

from noiseflow.checks import SIGNIFICANT, Effect, NotTested
from noiseflow.statistics import Array, robust_deviation, weighted_line, white_regression
from recon.series.views import HARMLESS, TILE
from recon.verdict.compared import Coarse, Residuals
from recon.verdict.geometry import Geometry
from recon.verdict.moments import explained_alone, slope_over_tilts

# smallest number of tilts for a standard deviation
_FEWEST = 3


@dataclass(frozen=True)
class Distortion:
    """One type of distortion over all tilts, in pixels (at the image edge), or as a share of the contrast.

    Attributes:
        jitter: standard deviation around its smooth part over the tilts without the expected random part; robust to outliers.
        values, errors: (tilt,) measured values and their standard errors.
    """

    jitter: Effect
    values: Array
    errors: Array


def distortions(residuals: Residuals, *, pixel: float = 1.0) -> dict[str, Distortion]:
    """Regress each residual on the effects of small distortions of its image, with robust standard errors.

    The standard errors are those of a jackknife of tiles of the image; they require neither Gaussian nor homoscedastic nor
    uncorrelated noise. Fitted volumes absorb a part of each distortion, so the result is
    a lower bound; residuals of left-out tilts have none of it. Tilts at the ends of the range are measured
    but not included, because there a volume has neighbours on one side only, and its projection lags behind the image.

    Args:
        residuals: images and what is left of them.
        pixel: size of their pixels, detector pixels.
    """
    units, measured, power = _units(residuals, pixel), list[tuple[Array, Array, Array]](), list[float]()
    first = len(units)  # of the columns of an uneven background, beside which the others are not measured
    for columns, left, tiles in _fields(residuals):
        own, both = (white_regression(some, left, ridge=1e-6, clusters=tiles) for some in (columns[:, :first], columns))
        measured.append((*own, explained_alone(columns, left)))
        power.append(float((both[0][first:] ** 2 - both[1][first:] ** 2).sum()) * units["background"] ** 2)
    estimates, errors, alone = (np.array(each) for each in zip(*measured, strict=True))
    inner = _between(residuals.tilt_angles)
    alone = np.append(alone[inner, :first].sum(0), alone[inner, first:].sum())
    shares = alone / max(float(alone.max()), 1e-30)
    found = {
        name: _over_tilts(estimates[:, number] * unit, errors[:, number] * unit, residuals, float(shares[number]))
        for number, (name, unit) in enumerate(units.items())
    }
    # the rms of a smooth background, from its mean squares without those of noise
    uneven = np.array(power)
    typical = float(np.sqrt(max(np.median(uneven[inner]), 0.0)))
    error = float(uneven[inner].std() / np.sqrt(inner.sum())) / max(typical, 1e-30)
    effect = Effect(typical, error, share=float(shares[first]))
    return found | {"uneven background": Distortion(effect, np.sqrt(uneven.clip(0)), np.full_like(uneven, error))}


def _units(residuals: Residuals, pixel: float) -> dict[str, float]:
    """Factors from coefficients to pixels at the image edge, or to shares of the contrast, by name."""
    edge = pixel * residuals.images.shape[2] / 2
    moves = {"shift along y": pixel, "shift across": pixel, "magnification": edge, "rotation": edge, "tilt angle": edge}
    levels = {"brightness": 1.0, "background": 1 / max(residuals.contrast, 1e-30), "sharpness": 1.0, "curvature": 1.0}
    return moves | levels


def _fields(residuals: Residuals) -> Iterator[tuple[Array, Array, Array]]:
    """Yield the columns and the target of the regression, and the number of each pixel's tile, for each tilt."""
    height, width = residuals.images.shape[1:]
    tiles = np.add.outer(np.arange(height) // TILE * width, np.arange(width) // TILE).ravel()
    across = np.arange(width, dtype=np.float64) - (width - 1) / 2
    along = (residuals.height - residuals.height.mean())[:, None].astype(np.float64)  # from the middle of these slices
    by_angle = slope_over_tilts(residuals.projections, residuals.tilt_angles)
    smooth = _smooth(height, width)
    for tilt, (image, residual) in enumerate(zip(residuals.projections, residuals.residual, strict=True)):
        down = np.gradient(image, axis=0) if image.shape[0] > 1 else np.zeros_like(image)
        right = np.gradient(image, axis=1)
        moved = (down, right, along * down + across * right, along * right - across * down)
        use = residuals.used[tilt].ravel()
        brightness = image - image.mean()
        fine, bent = image - ndimage.gaussian_filter(image, 1), brightness**2 / max(residuals.contrast, 1e-30)
        parts = [*moved, by_angle[tilt], brightness, np.ones_like(image), fine, bent, *smooth]
        yield np.stack([part.ravel()[use] for part in parts], 1), residual.ravel()[use].astype(np.float64), tiles[use]


def _smooth(height: int, width: int) -> Array:
    """(5, y, u) curvatures and slopes of an image, with a mean square of one."""
    rows, columns = (legendre.legvander(np.linspace(-1, 1, size), 2) * np.sqrt([1, 3, 5]) for size in (height, width))
    return np.array([np.outer(rows[:, i], columns[:, j]) for i, j in ((2, 0), (0, 2), (1, 0), (0, 1), (1, 1))])


def uneven_vacuum(coarse: Coarse) -> Effect:
    """Rms of the slopes and upward curvatures of the vacuum of all images, relative to their contrast.

    Vacuum bounds the line integrals of a pixel from below, in a tenth and in half of the tilts; a quantile regression bends
    downward where objects hide it. A section that fills the images, or a part of them, grows with the path through it.
    """
    if min(coarse.images.shape[1:]) <= 2:
        raise NotTested("needs three rows")
    tilts, some, scale = coarse.used.any((1, 2)), coarse.used.any(0), float(coarse.centred_on_all.std()) or 1.0
    rows, tenth = np.stack([each[some] for each in (np.ones(some.shape), *_smooth(*some.shape))]), 0.1
    shown, found = np.where(coarse.used, coarse.images / scale, np.nan)[tilts][:, some], list[Array]()
    path, hidden = 1 / np.abs(np.cos(np.radians(coarse.tilt_angles[tilts]))).clip(tenth), list[float]()
    for level in np.nanquantile(shown, tenth, axis=0), np.nanmedian(shown, axis=0):
        # the dual program, whose multipliers are the curve (Koenker & Bassett 1978, doi:10.2307/1913643)
        dual = optimize.linprog(-level, A_eq=rows, b_eq=(1 - 2 * tenth) * rows.sum(1), bounds=(0, 1))
        curve = -dual.eqlin.marginals
        found.append(curve[1:] * _constant(path, np.nan_to_num(shown - np.nanmean(shown)) @ (curve[1:] @ rows[1:])))
        hidden += [np.polyfit(path, np.nanquantile(shown - curve @ rows, tenth, axis=1), 1)[0]]
    value = min(float(np.linalg.norm([*each[:2].clip(0), *each[2:]])) for each in found)
    return Effect(value, max(float(np.linalg.norm(found[0][:2].clip(None, 0))), *hidden) / SIGNIFICANT)


def uneven_across(geometry: Geometry) -> tuple[Effect, Array]:
    """Slopes across the axis of a background that all images share, relative to their contrast; and the errors of held-out gaps
    without it.

    No volume within the images has them, so held-out gaps show them where objects hide the vacuum; those along the axis are like
    matter.
    """
    coarse, (_, height, width) = geometry.coarse, geometry.errors.shape
    if height < 2 * _FEWEST:
        raise NotTested(f"needs {2 * _FEWEST * coarse.binning} rows")
    shared = (np.broadcast_to(each, geometry.errors.shape) for each in _smooth(height, width)[-2:])
    columns = np.stack([geometry.fit.errors(each, coarse.used).ravel() for each in shared], 1)
    pairs = np.broadcast_to(np.arange(height)[:, None] // 2, geometry.errors.shape).ravel()
    slopes, errors = white_regression(columns, geometry.errors.ravel().astype(float), clusters=pairs)
    value, scale = float(np.linalg.norm(slopes)), float(coarse.centred_on_all.std()) or 1.0
    left = geometry.errors - (columns @ slopes).reshape(geometry.errors.shape)
    return Effect(value / scale, float(np.linalg.norm(slopes * errors)) / max(value * scale, 1e-30)), left


def _constant(path: Array, strengths: Array) -> float:
    """Share of the mean of `strengths` that does not grow with the path, if they significantly grow."""
    line = weighted_line(path, strengths, np.ones(len(path)))
    grows = line.slope > SIGNIFICANT * line.slope_error * line.chi_squared**0.5
    return float(np.clip(line.intercept / strengths.mean(), 0, 1)) if grows and strengths.mean() > 0 else 1.0


def _over_tilts(measured: Array, errors: Array, residuals: Residuals, share: float, *, degree: int = 5) -> Distortion:
    """A distortion beside a polynomial over the tilts: drifts and wrong angles are smooth, noise is not."""
    angles = residuals.tilt_angles
    inner = _between(angles)
    angles, values, inside = angles[inner], measured[inner], errors[inner]
    weights = 1 / inside**2
    away = values - float((weights * values).sum() / weights.sum())
    place = 2 * (angles - angles[0]) / max(float(np.ptp(angles)), 1e-30) - 1
    basis = legendre.legvander(place, min(degree, max(1, len(values) - 2)))
    curve = np.linalg.pinv((basis * weights[:, None]).T @ basis) @ (basis.T @ (weights * values))
    # the excess of χ² over its expectation, in its standard deviations
    freedom = max(1, len(values) - 1)
    scatter = max((float((away**2 * weights).sum()) - freedom) / float(np.sqrt(2 * freedom)), 1e-9)
    left, random = robust_deviation(values - basis @ curve, 0.0), inside**2
    rough = float(np.sqrt(max(0.0, left**2 - float(np.median(random)))))
    return Distortion(Effect(rough, rough / scatter, share=share), measured, errors)


def _between(angles: Array) -> Array:
    """(tilt,) whether there are tilts on both sides, or True if there are few."""
    inner = (angles > angles.min() + HARMLESS["direction"]) & (angles < angles.max() - HARMLESS["direction"])
    return np.asarray(inner if inner.sum() >= _FEWEST else np.ones_like(inner))


def displaced_lines(residuals: Residuals) -> Effect:
    """Displacement of single rows or columns along themselves, pixels rms.

    Each is measured twice, from different pixels, whose noise is independent: the mean of their products has none of it.
    """

    _, height, width = residuals.projections.shape
    lines = [axis for axis, long, wide in ((1, height, width), (2, width, height)) if long > TILE and wide > 2]
    if not lines:
        raise NotTested("needs three rows")
    pairs = ([np.moveaxis(each, axis, 2) for each in (residuals.projections, residuals.residual)] for axis in lines)
    return max(_scatter(*_shifts(*pair)) for pair in pairs)


def _shifts(images: Array, residual: Array) -> tuple[Array, Array]:
    """(part, tilt, line) shifts of the lines (tilt, line, pixel) and their variances."""
    slope, part = np.gradient(images, axis=2), np.arange(images.shape[2]) // TILE % 2
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
    one, other = np.clip(_beside(shifts, -0.5), -TILE, TILE)
    weights = np.prod(1 / (1 + _beside(variances, 0.25)), axis=0)
    parts = (weights * one * other).mean(1) * weights.size / weights.sum() / 1.5  # of three lines
    variance = max(float(parts.mean()), 0.0)
    error = float(parts.std(ddof=1) / np.sqrt(len(parts)))
    return Effect(float(np.sqrt(variance)), error / max(float(np.sqrt(variance)), 1e-30))


def _beside(lines: Array, factor: float) -> Array:
    """(..., line) each inner line plus a factor times both neighbours."""
    return np.asarray(lines[..., 1:-1] + factor * (lines[..., :-2] + lines[..., 2:]))
