"""Pixels and their masks: unused ones replaced, oblong ones made square, and means of the used pixels of blocks."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, distance_transform_edt, generate_binary_structure

from noiseflow import statistics
from noiseflow.arrays import strided
from noiseflow.io import mapped
from recon.series.tilt_series import TiltSeries
from recon.series.views import HARMLESS

WIDTH = 32
"""Pixels of coarse images, which are fitted in milliseconds."""


def binned(tilt_series: TiltSeries, down: int, across: int) -> TiltSeries:
    """Means of the used pixels of blocks, in float32; blocks with less than half of their pixels in use are masked.

    Incomplete blocks are dropped, evenly at both edges.

    Args:
        tilt_series: (tilt, y, u) images.
        down, across: block size along y and u, pixels.
    """
    images, mask = tilt_series.images, tilt_series.mask
    if mask is None:
        return tilt_series.with_images(block_mean(images, down, across), None)
    shares = block_mean(mask, down, across)
    sums = [block_mean(np.where(use, image, 0), down, across) for image, use in zip(images, mask, strict=True)]
    used = shares >= 0.5  # the centre of fewer is too far from the centre of their block
    whole = np.stack([filled(mean, use) for mean, use in zip(sums / np.maximum(shares, 0.5), used, strict=True)])
    return tilt_series.with_images(whole, None if used.all() else used)


def detector_offset(tilt_series: TiltSeries, across: int) -> float:
    """Distance of the centre of the binned images from that of the whole ones along u, coarse pixels: an odd remainder is
    dropped unevenly."""
    remainder = int(tilt_series.images.shape[2] % across)
    return -(remainder % 2) / 2 / across


def coarse(tilt_series: TiltSeries, width: int = WIDTH) -> TiltSeries:
    """The series, `binned` to at most `width` columns and half as many rows."""
    _, rows, columns = tilt_series.images.shape
    return binned(tilt_series, -(-2 * rows // width), -(-columns // width))


def without_spikes(tilt_series: TiltSeries) -> TiltSeries:
    """The series with a mask that leaves out pixels beyond five times the range of the others, which noise with long tails does
    not reach, as far as they are single or in lines, as tracks of cosmic rays: a particle in a wide field is no spike."""
    images, used = tilt_series.images, tilt_series.used
    low, high = (float(end) for end in np.quantile(strided(images)[strided(used)], (0.005, 0.995)))

    def kept(image: NDArray[Any], use: NDArray[np.bool_]) -> NDArray[np.bool_]:
        far = np.asarray(np.abs(image - (low + high) / 2) > (5 * (high - low) or np.inf)) & use
        around = convolve(far.astype(np.uint8), generate_binary_structure(2, 2), mode="constant")
        return np.asarray(use & ~(far & (around <= 3)))

    mask = mapped.mapped_copy(map(kept, images, used), images.shape, np.bool_)
    return tilt_series if np.array_equal(mask, used) else tilt_series.with_images(images, mask)


def plausible(tilt_series: TiltSeries) -> TiltSeries:
    """The series with masked pixels replaced by the nearest used value of their image."""
    images, mask = tilt_series.images, tilt_series.mask
    if mask is None:
        return tilt_series
    return tilt_series.with_images(mapped.mapped_copy(map(filled, images, mask), images.shape, images.dtype), mask)


def used_values(tilt_series: TiltSeries, images: NDArray[Any] | None = None) -> NDArray[Any]:
    """The used pixels of the images, or of other arrays of their shape, in one dimension."""
    images = tilt_series.images if images is None else images
    return images.reshape(-1) if tilt_series.mask is None else images[tilt_series.mask]


def weights_of_rays(tilt_series: TiltSeries) -> NDArray[np.bool_] | None:
    """(tilt, y, u) True for rays that a method without a prior uses; None for all.

    Rows that are masked in all images, such as dead rows of a detector, would leave slices empty. They take the values of the
    neighbouring rows.
    """
    mask = tilt_series.mask
    return None if mask is None else mask | ~np.asarray(mask.any((0, 2)))[:, None]


def filled(image: NDArray[Any], use: NDArray[np.bool_]) -> NDArray[Any]:
    """A (y, u) image whose unused pixels are replaced by the nearest used value; zero if there is none."""
    if use.all():
        return image
    if not use.any():
        return np.zeros_like(image)
    return np.asarray(image[tuple(distance_transform_edt(~use, return_distances=False, return_indices=True))])


def block_mean(images: NDArray[Any], down: int, across: int) -> NDArray[np.float32]:
    """Means of blocks of pixels of images (..., y, u); incomplete blocks are dropped, evenly at both edges."""
    height, width = images.shape[-2:]
    inner = images[..., height % down // 2 :, width % across // 2 :]
    return statistics.block_means(inner, down, across).astype(np.float32)


def squared(
    images: NDArray[Any], mask: NDArray[np.bool_] | None, ratio: float
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Images and their mask with square pixels of the larger edge; the centre stays in place.

    Pixels are averaged by the areas that they share with the new ones; whole numbers of integers are added, because sums of
    counts are counts. Pixels that a mask touches are masked.

    Args:
        images: (tilt, y, u).
        mask: of their shape, or None.
        ratio: height of a pixel over its width.
    """
    axis, factor = (2, ratio) if ratio > 1 else (1, 1 / ratio)
    factor = float(round(factor)) if abs(factor / round(factor) - 1) <= HARMLESS["pixel size"] else factor
    shared = _shared(images.shape[axis], factor)
    counts = factor.is_integer() and images.dtype.kind in "iu"
    kind = np.int32 if counts else np.float32
    shape = list(images.shape)
    shape[axis] = len(shared)
    weights = shared if counts else shared / factor

    def moved(stack: NDArray[Any], by: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        return (by @ image if axis == 1 else image @ by.T for image in stack)

    whole = mapped.mapped_copy(moved(images, weights), shape, kind)
    if mask is None:
        return whole, None
    used = (share > 1 - HARMLESS["masked part"] for share in moved(mask, shared / factor))
    return whole, mapped.mapped_copy(used, shape, np.bool_)


def _shared(count: int, factor: float) -> NDArray[np.float64]:
    """(new, old) overlap of old pixels and of `factor` times larger ones around the same centre, in old pixels."""
    number = int(count / factor + 1e-9)
    start = (count - number * factor) / 2 + factor * np.arange(number)[:, None]
    left, right = np.maximum(start, np.arange(count)), np.minimum(start + factor, np.arange(count) + 1)
    return np.asarray(np.maximum(right - left, 0.0))
