"""Smooth shrinkage of the specimen with the dose, from the length of its profile along the tilt axis."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import SIGNIFICANT, NotTested
from noiseflow.described import described
from recon.series.alignment import Alignment
from recon.series.alignment_search import line_integrals_of
from recon.series.first_guess import beyond_sides
from recon.series.masks import coarse
from recon.series.matching import ROUNDS
from recon.series.tilt_series import TiltSeries
from recon.series.views import AROUND, HARMLESS

Array = NDArray[np.float64]


@described(change="of the size", error="of the size", centre="px")
@dataclass(frozen=True)
class Shrinkage:
    """The change of the specimen's size from the first to the last image that was taken.

    Attributes:
        change: relative change of its size, equal in all directions; negative if it shrinks.
        error: standard error, from the scatter over the tilts.
        order: the order of acquisition: ``given``, or the assumption under which a change explains most.
        dose: (tilt,) share of the dose before each image, 0 to 1.
        centre: position along the axis that does not move, pixels from the centre of the images.
    """

    change: float
    error: float
    order: str
    dose: Array
    centre: float

    @property
    def found(self) -> bool:
        """Whether the change is significant, and large enough to matter."""
        return abs(self.change) > max(HARMLESS["size"], SIGNIFICANT * self.error)

    def correct(self, alignment: Alignment) -> Alignment:
        """An alignment that shows all images at the size of the specimen in the middle of the dose.

        The images of a specimen that shrinks equally in all directions are those of the unchanged one, made smaller.
        """
        sizes = 1 + self.change * (self.dose - 0.5)
        along = (1 - sizes) * self.centre
        given = np.eye(2) if alignment.stretches is None else alignment.stretches
        moved = alignment.moved(np.stack([along, np.zeros_like(along)], 1))
        return replace(moved, stretches=given * sizes[:, None, None])


def estimate_shrinkage(tilt_series: TiltSeries) -> Shrinkage:
    """Measure the change of the specimen's size with the dose.

    Row sums of line integrals do not depend on the tilt angle, whatever the specimen is (the zeroth moment of the consistency
    conditions of Helgason and Ludwig), so that the length of this profile along the axis shows the size at each tilt. A volume
    would absorb most of a change. Position, brightness and background of each profile are free. The error comes from the scatter
    over the tilts, and allows for correlated neighbours. A change along the beam alone is not measured.

    Args:
        tilt_series: aligned, with its axis along y, about one axis. If its dose is None, the common orders of acquisition are
            tried.

    Raises:
        NotTested: there are fewer than nine tilts, the specimen goes on beside the images, so that each shows another part of
            it, or no row is visible in most images.
    """
    if tilt_series.num_tilts < AROUND:
        raise NotTested(f"{tilt_series.num_tilts} tilts are too few to measure a shrinkage, which needs {AROUND}")
    if beyond_sides(coarse(tilt_series)):
        raise NotTested("the specimen goes on beside the images, which show more of it when tilted")
    orders = acquisition_orders(tilt_series.tilt_angles) if tilt_series.dose is None else {"given": tilt_series.dose}
    sizes, moves, errors = profile_lengths(tilt_series)
    lines = {name: _line(_ranked(order), sizes, errors, tilt_series.tilt_angles) for name, order in orders.items()}
    name = max(lines, key=lambda each: lines[each][2])
    change, error, _ = lines[name]
    ranked = _ranked(orders[name])
    drift, *_ = _line(ranked, moves, errors, tilt_series.tilt_angles)
    return Shrinkage(change, error, name, ranked, -drift / change if abs(change) > HARMLESS["size"] else 0.0)


def profile_lengths(tilt_series: TiltSeries) -> tuple[Array, Array, Array]:
    """Relative length of the profile along the tilt axis in every image, its position in pixels, and the standard error of the
    length, (tilt,) each.

    Args:
        tilt_series: aligned, with its axis along y.

    Raises:
        ValueError: no row is visible in most images.
    """
    # masked pixels have the values of their neighbours
    profiles, seen = line_integrals_of(tilt_series).double().numpy().mean(2), tilt_series.used.mean(2)
    place = np.arange(profiles.shape[1]) - (profiles.shape[1] - 1) / 2
    sizes, moves = np.ones(len(profiles)), np.zeros(len(profiles))
    errors = np.full(len(profiles), np.inf)
    for _ in range(ROUNDS):
        where = [size * place + move for size, move in zip(sizes, moves, strict=True)]
        aligned = np.stack([np.interp(each, place, row) for each, row in zip(where, profiles, strict=True)])
        shares = [np.interp(each, place, row, left=0, right=0) for each, row in zip(where, seen, strict=True)]
        inside = np.stack(shares) > 1 - HARMLESS["hidden part"]
        used = inside.mean(0) > 0.5
        if used.sum() < AROUND:
            raise NotTested("the profile along the tilt axis is not visible in most images")
        mean = np.average(aligned, axis=0, weights=inside + 1e-9)
        slope = np.gradient(mean)
        columns = np.stack([place * slope, slope, mean, np.ones_like(mean)], 1)
        for tilt, (row, rows) in enumerate(zip(aligned, inside & used, strict=True)):
            found, error = _least_squares(columns[rows], mean[rows] - row[rows])
            level = max(1 - found[2], 0.1)  # the brightness of this image relative to the mean
            sizes[tilt], moves[tilt] = sizes[tilt] + found[0] / level, moves[tilt] + found[1] / level
            errors[tilt] = error[0] / level
        sizes /= np.average(sizes, weights=1 / errors.clip(1e-30) ** 2)
        sizes = sizes.clip(0.5, 2)
    return sizes, moves, errors


def _least_squares(columns: Array, target: Array) -> tuple[Array, Array]:
    """Coefficients and standard errors."""
    inverse = np.linalg.pinv(columns.T @ columns)
    found = inverse @ columns.T @ target
    left = target - columns @ found
    variance = float(left @ left) / max(1, len(target) - columns.shape[1])
    return found, np.sqrt(variance * np.diag(inverse).clip(1e-30))


def _line(dose: Array, sizes: Array, errors: Array, angles: Array) -> tuple[float, float, float]:
    """The slope of sizes over the dose, its standard error, and the share of their variance that it explains."""
    weights = 1 / (errors**2 + np.median(errors) ** 2)
    away, late = sizes - np.average(sizes, weights=weights), dose - np.average(dose, weights=weights)
    power = float((weights * late**2).sum())
    slope = float((weights * late * away).sum()) / power
    left = away - slope * late
    error = float(np.sqrt((weights**2 * late**2 * left**2).sum())) / power
    beside = left[np.argsort(angles, kind="stable")]
    alike = float(np.clip((beside[1:] * beside[:-1]).sum() / max((beside**2).sum(), 1e-30), 0.0, 0.9))
    explained = slope**2 * power / max(float((weights * away**2).sum()), 1e-30)
    return slope, error * float(np.sqrt((1 + alike) / (1 - alike))), explained


def acquisition_orders(tilt_angles: Array) -> Mapping[str, Array]:
    """The common orders of acquisition, (tilt,) time of each image; a negated time is the same order with growth.

    Args:
        tilt_angles: (tilt,) degrees, in the order of the file.
    """
    count, zero = len(tilt_angles), float(tilt_angles[np.argmin(np.abs(tilt_angles))])
    side = tilt_angles - zero
    orders = {
        "rising or falling angle": tilt_angles,
        "dose-symmetric": np.abs(side) - 1e-6 * side,
        "from zero up, then down": np.where(side >= 0, side, side.max() - side),
        "from zero down, then up": np.where(side <= 0, -side, side - side.min()),
    }
    sorted_by_angle = len(set(np.sign(np.diff(tilt_angles))) - {0.0}) < 2
    return orders if sorted_by_angle else {"that of the file": np.arange(count, dtype=np.float64)} | orders


def _ranked(order: Array) -> Array:
    """Ranks from 0 to 1, because every image takes the same dose."""
    return np.argsort(np.argsort(order, kind="stable")) / (len(order) - 1)
