"""Pixels that cannot be trusted: hot, dead, saturated, and those no exposure covers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.exposures.frames import Image, rails, saturation_level
from calibration.exposures.scaling import spread_by_level

Mask = NDArray[np.bool_]

DEFECT_DEVIATIONS = 8.0
"""Robust standard deviations by which a pixel must differ from its neighbours, in all frames, to count as a defect."""


CUT = 2.5
"""Robust standard deviations at which residuals are cut before neighbours are compared."""


@dataclass(frozen=True)
class MaskCounts:
    """How many pixels of a frame were left out, and why (a pixel counts once, for the first reason)."""

    outside: int
    saturated: int
    hot: int
    dead: int
    restless: int = 0


def defects(frames: Image) -> tuple[Mask, Mask]:
    """Hot and dead pixels: those that differ from their neighbours in the same direction in every frame of one
    detector.

    Judged in detector coordinates, before any frame is warped. A real feature of the scene spreads over neighbours
    through the optics; a single noisy pixel value does not repeat.

    Args:
        frames: (frame, y, x).

    Returns:
        Two (y, x) masks.
    """
    hot = np.ones(frames.shape[1:], bool)
    dead = hot.copy()
    for frame in frames:
        deviation = _deviation(frame)
        hot &= deviation > DEFECT_DEVIATIONS
        dead &= deviation < -DEFECT_DEVIATIONS
    return hot, dead


def saturated(frame: Image, *, margin: int = 0) -> Mask:
    """Pixels at the upper clipping limit, grown by `margin` pixels."""
    at_rail = frame >= saturation_level(frame)
    return np.asarray(ndimage.binary_dilation(at_rail, iterations=margin)) if margin and at_rail.any() else at_rail


def clear_of_rails(
    frame: Image, level: Image, mask: Mask, *, deviations: float = 3.5, upper_only: bool = False
) -> Mask:
    """Pixels whose level lies at least some standard deviations off the converter's clipping limits, so that no noise is cut off.

    Args:
        frame: (y, x) pixel values.
        level: (y, x) the signal by other pixel values than the frame's own: a choice by these would cut their noise.
        mask: (y, x) pixels to judge the noise by.
        deviations: the distance asked for.
        upper_only: the lower limit does not count.
    """
    low, high = rails(frame)
    low = -np.inf if upper_only else low
    clear = np.ones(frame.shape, bool)
    for rail, side in ((low, 1.0), (high, -1.0)):
        if np.isfinite(rail):
            near = mask & (side * level < np.percentile(side * level[mask], 25))
            middle, far = np.percentile(side * (frame - level)[near], (50, 84.13))  # the other side is the clipped one
            clear &= side * (level - rail) > deviations * (far - middle)
    return clear


def restless(residual: Image, level: Image, mask: Mask, *, side: int = 5, deviations: float = 4.0) -> Mask:
    """Places where a burst does not stand still: neighbouring pixels there rise and fall together.

    Noise, however uneven or heavy-tailed, is independent between pixels, or correlated alike everywhere; what moves or
    blinks spreads over neighbours through the optics. Residuals are cut at some deviations, so that two outliers side
    by side condemn nothing.

    Args:
        residual: (frame, y, x) each of two frames or more, less the mean of the others.
        level: (y, x) mean of the frames.
        mask: (y, x) pixels to judge.
        side: of the neighbourhood judged as one, and condemned as one, pixels.
        deviations: standard deviations by which the neighbours' covariance exceeds the frame's usual one.
    """
    residual = residual - np.median(residual, axis=0)  # an outlier of one frame shifts the mean that others are held to
    spread = np.ones(level.shape)
    levels = np.broadcast_to(level[mask], (len(residual), int(mask.sum()))).ravel()
    spread[mask] = spread_by_level(levels, residual[:, mask].ravel())[: int(mask.sum())]
    cut = np.clip(residual / spread, -CUT, CUT)
    square = (cut**2).sum(axis=0)
    covariance, power, scatter = np.zeros((3, *mask.shape))
    for axis in (0, 1):
        both = mask & np.roll(mask, -1, axis)
        both[(slice(None),) * axis + (-1,)] = False
        squares = np.where(both, square * np.roll(square, -1, axis), 0.0)
        covariance += np.where(both, (cut * np.roll(cut, -1, axis + 1)).sum(axis=0), 0.0)
        power += np.sqrt(squares)
        scatter += squares / (len(residual) - 1)
    total, usual, variance = (side**2 * ndimage.uniform_filter(image, side) for image in (covariance, power, scatter))
    judged = mask & (usual > 0)
    if not judged.any():
        return np.zeros_like(mask)
    excess = total - np.median(total[judged] / usual[judged]) * usual
    moving = judged & (excess > deviations * np.sqrt(np.maximum(variance, 0.0)))
    return np.asarray(mask & ndimage.binary_dilation(moving, np.ones((side, side), bool)))


def _deviation(frame: Image) -> Image:
    """Departure from the median of the eight neighbours, over its robust spread among pixels of like brightness."""
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    middle = ndimage.median_filter(frame, footprint=ring)
    difference = frame - middle
    order = np.argsort(middle, axis=None)
    result = np.empty(frame.size)
    for group in np.array_split(order, max(1, frame.size // 2000)):
        values = difference.flat[group]
        result[group] = values / max(1.4826 * np.median(np.abs(values)), np.sqrt(np.finfo(float).tiny))
    return result.reshape(frame.shape)
