"""Values that stand out in one frame only: cosmic rays, sparks and dropped values."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from calibration.exposures.frames import Image, rails, rounding_step
from calibration.exposures.scaling import Mask, spread_by_level

LEAST_DEVIATION = 6.0
"""Standard deviations from which a value may be an outlier; of 10⁸ values of normal noise, none gets there by chance."""

TRACK = 3.0
"""Standard deviations from which a neighbour of an outlier belongs to its track."""

MOST_OUTLIERS = 0.005
"""Largest share of outliers that is excluded. Rare electrons of a multiplying register stand out just as cosmic rays do, but more
often; excluding them would remove the noise to be measured."""


def threshold(z: Image) -> float:
    """Return the deviation that the tail of the noise reaches with probability 1/20, at least `LEAST_DEVIATION`.

    The tail beyond two standard deviations is continued as an exponential function, which bounds that of normal, Poisson and
    gamma noise from above. A heavy-tailed noise thus raises the threshold, and its own values are no outliers.

    Args:
        z: deviations in standard deviations, any shape.
    """
    found = LEAST_DEVIATION
    size = np.abs(z)
    for _ in range(3):
        inside = size[size < max(found, LEAST_DEVIATION)]
        two, three = (max(int(np.count_nonzero(inside > edge)), 1) for edge in (2.0, 3.0))
        rate = np.log(max(two, 2) / min(three, max(two, 2) / 1.2))
        found = max(LEAST_DEVIATION, 2.0 + float(np.log(20 * two)) / rate)
    return found


def tracks(z: Image, limit: float) -> Mask:
    """Return the mask of values beyond a limit and of touching values beyond `TRACK`; the last two axes are those of a frame."""
    far = np.abs(z) > limit
    if not far.any():
        return far
    neighbours = np.ones((1,) * (z.ndim - 2) + (3, 3), bool)
    return np.asarray(ndimage.binary_propagation(far, neighbours, mask=np.abs(z) > TRACK))


def outliers_of(residual: Image, level: Image, mask: Mask, *, step: float) -> Mask:
    """Return the (y, x) mask of outliers among the residuals of one exposure; empty if too many stand out.

    Args:
        residual: (y, x) counts.
        level: (y, x) signal that sorts the residuals, counts.
        mask: (y, x) pixels to test.
        step: rounding step, counts.
    """
    z = np.zeros(mask.shape)
    z[mask] = residual[mask] / np.hypot(spread_by_level(level[mask], residual[mask]), step)
    found = tracks(z, threshold(z[mask])) & mask
    return found if found.sum() <= MOST_OUTLIERS * mask.sum() else np.zeros_like(found)


def without_outliers(frames: Image) -> tuple[Image, int]:
    """Replace the outliers in equal frames of a static scene, and return their number.

    A value stands out if it differs from the median of its pixel over the frames. It is replaced by the value in another frame
    plus the difference of the two frames at a neighbouring pixel, which leaves the variance unchanged. Pixels that stand out in
    several frames are noisy, and stay as they are.

    Args:
        frames: (frame, y, x) counts.
    """
    number = len(frames)
    centred = frames - np.median(frames.reshape(number, -1), axis=1)[:, None, None]
    level = np.median(centred, axis=0) if number > 2 else centred.min(axis=0)
    difference = centred - level
    spread = spread_by_level(np.broadcast_to(level, frames.shape).ravel(), difference.ravel()).reshape(frames.shape)
    z = difference / np.hypot(spread, rounding_step(frames))  # the next code is no outlier
    found = tracks(z, threshold(z))
    found &= found.sum(axis=0) <= 1 + number // 100
    low, high = rails(frames)
    found &= ~np.any((frames <= low) | (frames >= high), axis=0)
    if not 0 < found.sum() <= MOST_OUTLIERS * found.size:
        return frames, 0
    cleaned = frames.copy()
    any_frame = found.any(axis=0)
    if any_frame.all():
        return frames, 0
    row, column = ndimage.distance_transform_edt(any_frame, return_distances=False, return_indices=True)
    for index, y, x in np.argwhere(found):
        other = (index + 1) % number
        near = row[y, x], column[y, x]
        cleaned[index, y, x] = frames[other, y, x] + frames[index][near] - frames[other][near]
    return cleaned, int(found.sum())
