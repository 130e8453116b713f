"""Masks of unusable pixels: hot, dead, saturated, changing, or not covered by both exposures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.exposures.frames import Image, rails, saturation_level
from calibration.exposures.scaling import spread_by_level
from noiseflow.statistics import robust_deviation

Mask = NDArray[np.bool_]

DEFECT_DEVIATIONS = 8.0
"""Robust standard deviations by which a pixel must differ from its neighbours, in all frames, to count as a defect."""

CUT = 2.5
"""Standard deviations at which residuals are clipped before neighbours are compared."""


@dataclass(frozen=True)
class MaskCounts:
    """Number of pixels of a frame that were excluded, by reason (each pixel counts once, for the first reason)."""

    outside: int
    saturated: int
    hot: int
    dead: int
    restless: int = 0
    outliers: int = 0


def defects(frames: Image) -> tuple[Mask, Mask]:
    """Find hot and dead pixels: they differ from their neighbours in the same direction in every frame.

    The frames must be in detector coordinates, before any is warped. Features of the scene spread over neighbouring pixels
    through the optics, and noise does not repeat between frames.

    Args:
        frames: (frame, y, x) frames of one detector.

    Returns:
        Masks of the hot and of the dead pixels, each (y, x).
    """
    hot = np.ones(frames.shape[1:], bool)
    dead = hot.copy()
    for frame in frames:
        deviation = _deviation(frame)
        hot &= deviation > DEFECT_DEVIATIONS
        dead &= deviation < -DEFECT_DEVIATIONS
    return hot, dead


def saturated(frame: Image, *, margin: int = 0) -> Mask:
    """Return the (y, x) mask of pixels at the upper clipping limit, dilated by `margin` pixels."""
    at_rail = frame >= saturation_level(frame)
    return np.asarray(ndimage.binary_dilation(at_rail, iterations=margin)) if margin and at_rail.any() else at_rail


def clear_of_rails(
    frame: Image, level: Image, mask: Mask, *, deviations: float = 3.5, upper_only: bool = False
) -> Mask:
    """Return the (y, x) mask of pixels far enough from the converter's clipping limits that their noise is not clipped.

    Args:
        frame: (y, x) pixel values.
        level: (y, x) signal, estimated from other pixel values: a selection by the values themselves would truncate their noise.
        mask: (y, x) pixels used to estimate the noise.
        deviations: required distance from a limit, standard deviations.
        upper_only: ignore the lower limit.
    """
    low, high = rails(frame)
    low = -np.inf if upper_only else low
    clear = np.ones(frame.shape, bool)
    for rail, side in ((low, 1.0), (high, -1.0)):
        if np.isfinite(rail):
            near = mask & (side * level < np.percentile(side * level[mask], 25))
            # the side away from the limit, which is not clipped
            middle, far = np.percentile(side * (frame - level)[near], (50, 84.13))
            clear &= side * (level - rail) > deviations * (far - middle)
    return clear


def restless(residual: Image, level: Image, mask: Mask, *, side: int = 5, deviations: float = 4.0) -> Mask:
    """Find regions of a burst that change between frames: the residuals of neighbouring pixels are correlated there.

    Noise is independent between pixels, or equally correlated everywhere. Objects that move or blink spread over neighbouring
    pixels through the optics. Residuals are clipped at `CUT`, so that two adjacent outliers are not flagged.

    Args:
        residual: (frame, y, x) residuals from the mean of the other frames, at least two frames.
        level: (y, x) mean of the frames.
        mask: (y, x) pixels to test.
        side: side of the neighbourhood that is tested and excluded as a whole, pixels.
        deviations: threshold: standard deviations of the neighbours' covariance above its typical value.
    """
    # an outlier in one frame shifts the mean that the others are compared with
    residual = residual - np.median(residual, axis=0)
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
    """Difference from the median of the eight neighbours, in robust standard deviations among pixels of similar brightness."""
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    middle = ndimage.median_filter(frame, footprint=ring)
    difference = frame - middle
    order = np.argsort(middle, axis=None)
    result = np.empty(frame.size)
    for group in np.array_split(order, max(1, frame.size // 2000)):
        values = difference.flat[group]
        result[group] = values / max(robust_deviation(values, 0.0), np.sqrt(np.finfo(float).tiny))
    return result.reshape(frame.shape)
