"""Masks of unusable pixels: hot, dead, saturated, changing, not covered by both exposures; and outliers of single frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy  # its packages load when they are first used

from calibration.exposures.frames import MINIMUM_SIDE, Image, rails, rounding_step, saturation_level
from calibration.exposures.scaling import MOST_PIXELS, dilated, groups_of, one_sigma, separable, spread_by_level
from calibration.exposures.scaling import Mask as Mask
from calibration.tolerances import CERTAIN, CLEAR, LIKELY, MOST_LEFT_OUT, PIXELS, STANDS_OUT, UNEVEN


@dataclass(frozen=True)
class MaskCounts:
    """Number of pixels of a frame that were excluded, by reason (each pixel counts once, for the first reason); of outliers,
    without their neighbours."""

    outside: int
    saturated: int
    hot: int
    dead: int
    restless: int
    outliers: int


def defects(frames: Sequence[Image] | Image) -> tuple[Mask, Mask]:
    """Find hot and dead pixels, (y, x) each: they differ from their neighbours in the same direction in every frame, or lie on
    `broken_lines`.

    The (frame, y, x) frames must be in detector coordinates, before any is warped. Features of the scene spread over neighbouring
    pixels through the optics, and noise does not repeat between frames.
    """
    hot, dead = np.ones((2, *frames[0].shape), bool)
    for frame in frames:
        deviation = _deviation(frame)
        hot &= deviation > CERTAIN
        dead &= deviation < -CERTAIN
    return hot, dead | broken_lines(frames)


def broken_lines(frames: Sequence[Image] | Image) -> Mask:
    """Rows and columns of (frame, y, x) frames that hold one value, of which so many equal ones are no chance; (y, x) mask."""
    found = np.zeros(frames[0].shape, bool)
    for lines, values in ((found, frames), (found.T, [frame.T for frame in frames])):
        for index in np.flatnonzero(np.all([np.ptp(one, axis=1) == 0 for one in values], axis=0)):
            share = np.mean(values[0] == values[0][index, 0])
            lines[index] = share ** values[0].shape[1] < np.finfo(float).eps
    return found


def saturated(frame: Image) -> Mask:
    """Return the (y, x) mask of pixels at the upper clipping limit."""
    return np.asarray(frame >= saturation_level(frame))


def clear_of_rails(
    frame: Image, level: Image, mask: Mask, *, deviations: float = 3.5, upper_only: bool = False
) -> Mask:
    """Return the (y, x) mask of pixels far enough from the converter's clipping limits that their noise is not clipped.

    Args:
        level: (y, x) signal, estimated from other pixel values: a selection by the values themselves would truncate their noise.
        deviations: required distance from a limit, standard deviations.
    """
    low, high = rails(frame)
    low = -np.inf if upper_only else low
    clear = np.ones(frame.shape, bool)
    for rail, side in ((low, 1.0), (high, -1.0)):
        if np.isfinite(rail):
            near = mask & (side * level <= np.percentile(side * level[mask], 25))  # a black border may be all of them
            # the side away from the limit, which is not clipped
            _, middle, far = one_sigma(side * (frame - level)[near])
            clear &= side * (level - rail) > deviations * (far - middle)
    return clear


def counted(
    frame: Image, signal: Image, level: Image, *, step: float, repeated: float = 1.0, num_levels: int = 8
) -> Image | None:
    """Return mean, variance and its error, (3, 1 + levels), of all pixel values and at each level, if they count photons, which
    nothing rounds or clips: multiples from 0 of a `step`, the unit of what is returned, whose variance is their mean; None if
    not, or if they are too few to show it.

    The covariance of residual and distance from the `level` of the neighbours is the variance without the noise of the signal.
    All are (N,); every independent value is `repeated` so often.
    """
    if frame.min() != 0 or not step:
        return None
    frame, signal, level = frame / step, signal / step, level / step
    squares = (frame - signal) * (frame - level)
    groups = [np.arange(len(frame)), *groups_of(level, num_levels, MINIMUM_SIDE**2)]
    mean, excess, error = (
        np.array([of(values[one]) for one in groups])
        for of, values in ((np.mean, frame), (np.mean, squares - frame), (np.std, squares - frame))
    )
    error *= np.sqrt(repeated / np.array([len(one) for one in groups]))
    deviations = np.where(np.arange(len(groups)) > 1, CLEAR, LIKELY)  # in the darkest level, read noise shows
    far = np.abs(excess) > deviations * error
    return None if far.any() or error[0] > UNEVEN * mean[0] else np.stack([mean, mean + excess, error])


def restless(
    residual: Image, level: Image, mask: Mask, *, step: float, side: int = 5, deviations: float = 4.0, cut: float = 2.5
) -> Mask:
    """Find regions of a burst that change between frames: the residuals of neighbouring pixels are correlated there.

    Noise is independent between pixels, or equally correlated everywhere. Objects that move or blink spread over neighbouring
    pixels through the optics.

    Args:
        residual: (frame, y, x) residuals from the mean of the other frames, at least two frames.
        level: (y, x) mean of the frames at the neighbours, independent of the noise of each pixel.
        step: rounding step of the frames.
        side: side of the neighbourhood that is tested and excluded as a whole, pixels.
        deviations: threshold: standard deviations of the neighbours' covariance above its typical value.
        cut: standard deviations at which residuals are clipped, so that two adjacent outliers are not flagged.
    """
    # an outlier in one frame shifts the mean that the others are compared with
    residual = residual - np.median(residual, axis=0)
    spread = np.ones(level.shape)
    levels = np.broadcast_to(level[mask], (len(residual), int(mask.sum()))).ravel()
    spread[mask] = np.interp(level[mask], *spread_by_level(levels, residual[:, mask].ravel(), step=step))
    clipped = np.clip(residual / spread, -cut, cut)
    square = (clipped**2).sum(axis=0)
    clipped -= clipped.mean(axis=0)  # of skewed noise, the mean is not the median
    covariance, power, scatter = np.zeros((3, *mask.shape))
    for axis in (0, 1):
        both = mask & np.roll(mask, -1, axis)
        both[(slice(None),) * axis + (-1,)] = False
        squares = np.where(both, square * np.roll(square, -1, axis), 0.0)
        covariance += np.where(both, (clipped * np.roll(clipped, -1, axis + 1)).sum(axis=0), 0.0)
        power += np.sqrt(squares)
        scatter += squares / (len(residual) - 1)
    box = np.ones(side)
    total, usual, variance = (separable(image, box, box) for image in (covariance, power, scatter))
    judged = mask & (usual > 0)
    if not judged.any():
        return np.zeros_like(mask)
    excess = total - np.median(total[judged] / usual[judged]) * usual
    moving = judged & (excess > deviations * np.sqrt(np.maximum(variance, 0.0)))
    return mask & dilated(moving, side // 2, square=True)


def _deviation(frame: Image) -> Image:
    """Difference from the median of 3 × 3 pixels, in robust standard deviations at its brightness; 0 if far below `CERTAIN`."""
    middle = _median(frame)
    difference = frame - middle
    number, step = max(1, min(frame.size, MOST_PIXELS) // 2000), rounding_step(frame)
    levels, spread = spread_by_level(middle.ravel(), difference.ravel(), step=step, num_levels=number)
    deviation, least = np.zeros(frame.shape), np.sqrt(np.finfo(float).tiny)
    far = np.abs(difference) > CERTAIN * max(spread.min(), least)
    deviation[far] = difference[far] / np.maximum(np.interp(middle[far], levels, spread), least)
    return deviation


def threshold(z: Image) -> float:
    """Return the deviation that the tail of the noise reaches with probability 1/20, at least `STANDS_OUT`, standard deviations.

    The tail beyond two standard deviations is continued as an exponential function, which bounds that of normal, Poisson and
    gamma noise from above. A heavy-tailed noise thus raises the threshold, and its own values are no outliers.
    """
    found = STANDS_OUT
    size = np.abs(z[np.abs(z) > 2.0])
    for _ in range(3):
        inside = size[size < max(found, STANDS_OUT)]
        two, three = max(len(inside), 1), max(int(np.count_nonzero(inside > 3.0)), 1)
        rate = np.log(max(two, 2) / min(three, max(two, 2) / 1.2))
        found = max(STANDS_OUT, 2.0 + float(np.log(20 * two)) / rate)
    return found


def tracks(z: Image, limit: float) -> Mask:
    """Return the mask of values beyond a limit and of touching values beyond `LIKELY`; the last two axes are those of a frame."""
    far = np.abs(z) > limit
    if not far.any():
        return far
    neighbours = np.ones((1,) * (z.ndim - 2) + (3, 3), bool)
    return np.asarray(scipy.ndimage.binary_propagation(far, neighbours, mask=np.abs(z) > LIKELY))


def outliers_of(
    residual: Image, level: Image, mask: Mask, other: Image, *, step: float, rounds: int = 4
) -> tuple[Mask, tuple[float, ...]]:
    """Return the (y, x) mask of outliers of one exposure within a mask, and the share of weaker ones in the variance, with its
    error, if heights below the threshold are as frequent as between it and twice of it; none if too many stand out, unless the
    `other` exposure as recorded stands out at them, too: hot pixels.

    They are sorted by the signal `level`, (y, x); all are counts, and so is the rounding `step`. Many widen the spread in which
    others hide until the next of the `rounds`.
    """
    found = np.zeros_like(mask)
    for _ in range(rounds):
        rest = mask & ~found
        spread = spread_by_level(level[rest], residual[rest], step=step)
        z = np.where(mask, residual, 0.0) / np.hypot(np.interp(level, *spread), step)
        limit = threshold(z[rest])
        found |= (more := tracks(np.where(rest, z, 0.0), limit))
        if not more.any():
            break
    high = (other - _median(other))[found & (residual > 0)] if found.any() else ()
    hot = len(high) > 1 and np.mean(high) > CLEAR * np.std(high) / np.sqrt(len(high))
    if found.sum() > (MOST_LEFT_OUT if hot else PIXELS) * mask.sum():
        return np.zeros_like(found), ()
    number, each = np.count_nonzero((np.abs(z) > limit) & (np.abs(z) < 2 * limit)), limit**2 / 3 / mask.sum()
    return found, (number * each, np.sqrt(number) * each)


def mended(*frames: Image) -> tuple[list[Image], Mask, Mask]:
    """Return (y, x) frames with the median of 3 × 3 pixels in place of their `defects`, and these, hot and dead."""
    hot, dead = defects(frames)
    bad = hot | dead
    return [np.where(bad, _median(frame), frame) if bad.any() else frame for frame in frames], hot, dead


def _median(frame: Image) -> Image:
    return cv2.medianBlur(frame.astype(np.float32), 3).astype(float)


def without_outliers(frames: Image) -> tuple[Image, int]:
    """Replace the outliers in equal frames of a static scene, and return their number.

    A value stands out if it differs from the median of its pixel over the frames. It is replaced by the value in another frame
    plus the difference of the two frames at a neighbouring pixel, which leaves the variance unchanged. Pixels that stand out in
    several frames are noisy, and stay as they are. The frames are (frame, y, x), counts.
    """
    number = len(frames)
    centred = frames - np.median(frames.reshape(number, -1), axis=1)[:, None, None]
    level = np.median(centred, axis=0) if number > 2 else centred.min(axis=0)
    difference = centred - level
    levels, step = np.broadcast_to(level, frames.shape).ravel(), rounding_step(frames)
    spread = np.interp(level, *spread_by_level(levels, difference.ravel(), step=step))
    z = difference / np.hypot(spread, step)  # the next code is no outlier
    found = tracks(z, threshold(z))
    found &= found.sum(axis=0) <= 1 + number // 100
    low, high = rails(frames)
    found &= ~np.any((frames <= low) | (frames >= high), axis=0)
    any_frame = found.any(axis=0)
    if any_frame.all() or not 0 < found.sum() <= PIXELS * found.size:
        return frames, 0
    cleaned = frames.copy()
    row, column = scipy.ndimage.distance_transform_edt(any_frame, return_distances=False, return_indices=True)
    for index, y, x in np.argwhere(found):
        other = (index + 1) % number
        near = row[y, x], column[y, x]
        cleaned[index, y, x] = frames[other, y, x] + frames[index][near] - frames[other][near]
    return cleaned, int(found.sum())
