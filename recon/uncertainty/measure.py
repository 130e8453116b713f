"""Measurements on a volume with intervals from its error bars, and the error at frequencies that no tilt has seen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recon.projection.classical import directions
from recon.uncertainty.result import LEVEL, Uncertainty, quantile

Array = NDArray[np.float64]
Region = tuple[slice, ...]


@dataclass(frozen=True)
class Measurement:
    """A measured value with its interval.

    Attributes:
        low, high: ends of the interval; None without error bars.
    """

    value: float
    low: float | None = None
    high: float | None = None

    def in_words(self) -> str:
        text = f"{self.value:.4g}"
        return text if self.low is None else f"{text} ({self.low:.4g} to {self.high:.4g})"


def mean_of_region(
    volume: NDArray[np.floating],
    region: Region,
    uncertainty: Uncertainty | None = None,
    *,
    level: float = LEVEL,
    periods: float = 1.5,
) -> Measurement:
    """Mean attenuation of a region.

    Errors are taken as equal within `periods` of the finest resolved detail along each axis, and as independent beyond, except
    for the mean of the bias, which is systematic. Without a known resolution, they are equal in the whole region.

    Args:
        volume: (z, y, x) attenuation per voxel.
        region: slices along z, y and x.
        uncertainty: error bars of the volume.
        level: probability of the interval.
        periods: with 1, intervals of 150 cubes of 6 voxels in four phantoms contained the truth in 89 %, with 1.5 in 94 %.
    """
    value = float(volume[region].mean(dtype=np.float64))
    if uncertainty is None:
        return Measurement(value)
    parts = [part.attenuation[region].astype(np.float64) for part in uncertainty.parts.values()]
    period = np.inf if uncertainty.shells is None else 1 / max(uncertainty.shells.resolution()[0], 1e-30)
    share = float(np.prod([1 / (1 + (size - 1) / (periods * period)) for size in parts[0].shape]))
    bias = uncertainty.bias.attenuation[region].mean(dtype=np.float64)
    variance = share * sum(float(np.mean(part**2)) for part in parts) + (1 - share) * bias**2
    half = quantile(level) * variance**0.5
    return Measurement(value, value - half, value + half)


def volume_above(
    volume: NDArray[np.floating],
    threshold: float,
    region: Region,
    uncertainty: Uncertainty | None = None,
    *,
    level: float = LEVEL,
) -> Measurement:
    """Number of voxels of a region above a threshold.

    The ends of the interval count voxels whose interval is completely above the threshold, and partly above it.

    Args:
        threshold: attenuation per voxel.
        volume, region, uncertainty, level: as for `mean_of_region`, the probability for single voxels.
    """
    part = volume[region]
    value = float((part > threshold).sum())
    if uncertainty is None:
        return Measurement(value)
    half = uncertainty.half_width(level)[region]
    return Measurement(value, float((part - half > threshold).sum()), float((part + half > threshold).sum()))


def line_profile(
    volume: NDArray[np.floating],
    start: tuple[float, float, float],
    stop: tuple[float, float, float],
    uncertainty: Uncertainty | None = None,
    *,
    level: float = LEVEL,
) -> tuple[Array, Array, Array | None]:
    """Attenuation along a line, about one point per voxel, linearly interpolated.

    Args:
        start, stop: (z, y, x) end points, voxels.
        volume, uncertainty, level: as for `mean_of_region`.

    Returns:
        Distance from the start in voxels, attenuation, and half the width of its interval (None without error bars).

    Raises:
        ValueError: an end point is outside the volume.
    """
    ends = np.array([start, stop], dtype=np.float64)
    if (ends < 0).any() or (ends > np.array(volume.shape) - 1).any():
        raise ValueError(f"--line from {start} to {stop} leaves the volume of shape {volume.shape} (z, y, x)")
    length = float(np.linalg.norm(ends[1] - ends[0]))
    distance = np.linspace(0, length, max(2, round(length) + 1))
    points = ends[0][:, None] + (ends[1] - ends[0])[:, None] * (distance / max(length, 1e-30))

    def along(values: NDArray[np.floating]) -> Array:
        return np.asarray(map_coordinates(values.astype(np.float64), points, order=1))

    return distance, along(volume), None if uncertainty is None else along(uncertainty.half_width(level))


def unseen_range(tilt_angles: Array) -> tuple[float, float]:
    """First and last angle of the largest gap between (tilt,) tilts, degrees; the last may exceed 90.

    A projection at θ contains the frequencies along x·cos θ + z·sin θ. Frequencies at the angles of the gap, from x towards z,
    are therefore determined by the regulariser alone.
    """
    views, _, steps = directions(tilt_angles)
    widest = int(steps.argmax())
    return float(views[widest]), float(views[widest] + steps[widest])


def wedge_std(
    volume: NDArray[np.floating],
    std: NDArray[np.floating],
    bias: NDArray[np.floating],
    tilt_angles: Array,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Standard deviation of the error of each voxel at the frequencies of the missing wedge, (z, y, x).

    Posterior samples have about the power of this error, but spread it evenly over the object. It is placed where the volume has
    detail at the frequencies beside the wedge, on both sides over half of its width, and is at most as large as this detail.

    Args:
        volume, std, bias: (z, y, x) volume and error bars from samples, whose power is taken to be uniform over 180°.
        tilt_angles: (tilt,) degrees.
        out: (z, y, x) array for the result.
    """
    first, last = np.radians(unseen_range(tilt_angles)) / np.pi  # half turns
    share, side = last - first, min(last - first, 1 - last + first) / 2
    z, x = (np.fft.fftfreq(size) for size in (volume.shape[0], volume.shape[2]))
    angle = np.mod(np.arctan2(z[:, None], x) / np.pi - first, 2)
    angle[0, 0] = np.nan
    # half of the plane of frequencies gives the envelope of a wave, without its oscillation
    sides = [(angle >= share) & (angle < share + side), angle >= 2 - side]
    found = np.empty(volume.shape, np.float32) if out is None else out
    sampled = detail = 0.0
    for y in range(volume.shape[1]):
        spectrum = np.fft.fft2(volume[:, y])
        powers = [np.square(np.abs(np.fft.ifft2(spectrum * inside))) for inside in sides]
        found[:, y] = share / max(side, 1e-30) * sum(powers)  # twice, for the other half of the plane
        detail += float(found[:, y].sum(dtype=np.float64))
        sampled += sum(float(np.square(part[:, y], dtype=np.float64).sum()) for part in (std, bias))
    factor = np.float32(min(1, share * sampled / max(detail, 1e-30)))
    for y in range(volume.shape[1]):
        found[:, y] = np.sqrt(factor * found[:, y])
    return found


def unseen_in_words(tilt_angles: Array) -> str:
    """A sentence about the missing wedge for readers of error bars."""
    first, last = unseen_range(tilt_angles)
    return (
        f"No tilt between {first:.4g}° and {last:.4g}° was recorded ({100 * (last - first) / 180:.0f} % of 180°): detail "
        "along these directions, measured from x towards z, is determined by the regulariser alone, and the error bars reflect "
        "only its assumptions there."
    )
