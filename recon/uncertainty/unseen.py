"""The missing wedge: the largest gap between tilt angles modulo 180°."""

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


def unseen_share(volume: NDArray[np.floating], tilt_angles: Array) -> float:
    """Share of a volume's sum of squares at frequencies in the missing wedge.

    Args:
        volume: (z, y, x), for example an error.
        tilt_angles: (tilt,) degrees.
    """
    first, last = unseen_range(tilt_angles)
    power = (np.abs(np.fft.fftn(volume)) ** 2).sum(1)  # every tilt contains all frequencies along y, the tilt axis
    z, x = (np.fft.fftfreq(size) for size in power.shape)
    angle = np.mod(np.degrees(np.arctan2(z[:, None], x)) - first, 180)
    inside = (angle > 0) & (angle < last - first) & (np.hypot(z[:, None], x) > 0)
    return float(power[inside].sum() / power.sum())


def in_words(tilt_angles: Array) -> str:
    """A sentence about the missing wedge for readers of error bars."""
    first, last = unseen_range(tilt_angles)
    return (
        f"No tilt between {first:.4g}° and {last:.4g}° was recorded ({100 * (last - first) / 180:.0f} % of 180°): detail "
        "along these directions, measured from x towards z, is determined by the regulariser alone, and the error bars reflect "
        "only its assumptions there."
    )
