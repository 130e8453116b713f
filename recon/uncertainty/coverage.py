"""The part of a volume that no tilt has seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def unseen_range(tilt_angles: Array) -> tuple[float, float]:
    """First and last angle of the largest gap between tilts, degrees; the last may exceed 90.

    A projection at θ contains the frequencies along x·cos θ + z·sin θ. Frequencies at the angles of the gap, from x towards z,
    are therefore determined by the regulariser alone.

    Args:
        tilt_angles: (tilt,) degrees.
    """
    views = np.unique(np.mod(tilt_angles, 180))
    steps = np.diff(np.r_[views, views[0] + 180])
    widest = int(steps.argmax())
    first = float(views[widest])
    return first, first + float(steps[widest])


def unseen_part(volume: NDArray[np.floating], tilt_angles: Array) -> NDArray[np.float32]:
    """The part of a volume that no tilt has seen: its frequencies in the missing wedge, which the regulariser alone determines.

    Where it is as large as the volume, a feature may be absent or elongated. The error at these frequencies was 0.16 of it (RMS)
    for a core in a shell and 0.74 for beads, at ±60°.

    Args:
        volume: (z, y, x).
        tilt_angles: (tilt,) degrees.

    Returns:
        (z, y, x), in units of the volume; its mean is 0.
    """
    inside = _wedge(volume.shape, tilt_angles)[..., : volume.shape[2] // 2 + 1]
    found = np.empty(volume.shape, np.float32)
    for y in range(volume.shape[1]):  # every tilt contains all frequencies along y, the tilt axis
        spectrum = np.fft.rfft2(volume[:, y]) * inside
        found[:, y] = np.fft.irfft2(spectrum, s=(volume.shape[0], volume.shape[2]))
    return found


def _wedge(shape: tuple[int, ...], tilt_angles: Array) -> NDArray[np.bool_]:
    """Whether each frequency (z, x) of a volume (z, y, x) is in the missing wedge."""
    first, last = unseen_range(tilt_angles)
    z, x = (np.fft.fftfreq(size) for size in (shape[0], shape[2]))
    angle = np.mod(np.degrees(np.arctan2(z[:, None], x)) - first, 180)
    inside: NDArray[np.bool_] = (angle > 0) & (angle < last - first) & (np.hypot(z[:, None], x) > 0)
    return inside


def in_words(tilt_angles: Array) -> str:
    """A sentence about the missing wedge for readers of error bars."""
    first, last = unseen_range(tilt_angles)
    return (
        f"No tilt between {first:.4g}° and {last:.4g}° was recorded ({100 * (last - first) / 180:.0f} % of 180°): detail "
        "along these directions, measured from x towards z, is determined by the regulariser alone, and the error bars reflect "
        "only its assumptions there."
    )
