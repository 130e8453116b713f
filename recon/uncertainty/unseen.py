"""The directions that no tilt saw: the missing wedge, the widest gap between projections, which repeat after half a turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def unseen_range(tilt_angles: Array) -> tuple[float, float]:
    """First and last angle of the widest gap between tilts, degrees; the last may exceed 90.

    A projection at θ holds the frequencies along x·cos θ + z·sin θ, so those at the angles of the gap, from x towards z, are
    known to the regulariser alone.

    Args:
        tilt_angles: (tilt,) degrees.
    """
    views = np.unique(np.mod(tilt_angles, 180))
    steps = np.diff(np.r_[views, views[0] + 180])
    widest = int(steps.argmax())
    first = float(views[widest])
    return first, first + float(steps[widest])


def unseen_share(volume: NDArray[np.floating], tilt_angles: Array) -> float:
    """Share of a volume's sum of squares at frequencies that no tilt saw.

    Args:
        volume: (z, y, x), such as an error.
        tilt_angles: (tilt,) degrees.
    """
    first, last = unseen_range(tilt_angles)
    power = (np.abs(np.fft.fftn(volume)) ** 2).sum(1)  # y, the tilt axis, is seen at every tilt
    z, x = (np.fft.fftfreq(size) for size in power.shape)
    angle = np.mod(np.degrees(np.arctan2(z[:, None], x)) - first, 180)
    inside = (angle > 0) & (angle < last - first) & (np.hypot(z[:, None], x) > 0)
    return float(power[inside].sum() / power.sum())


def in_words(tilt_angles: Array) -> str:
    """A sentence for readers of error bars."""
    first, last = unseen_range(tilt_angles)
    return (
        f"No tilt between {first:.4g}° and {last:.4g}° was recorded ({100 * (last - first) / 180:.0f} % of half a turn): detail "
        "along these directions, counted from x towards z, comes from the regulariser alone, and error bars only say how firmly "
        "it holds that."
    )
