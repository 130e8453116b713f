"""The one way to honour masks in coarse images: means of used pixels, and the mask of the blocks that have enough of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import mapped
from recon.series.pixels import block_mean, filled
from recon.series.tilt_series import TiltSeries

# share of used pixels: the centre of fewer is too far from the centre of their block
_ENOUGH = 0.5


def binned(tilt_series: TiltSeries, down: int, across: int) -> TiltSeries:
    """Means of the used pixels of blocks, in float32; blocks with less than half of their pixels in use are masked.

    Incomplete blocks are dropped, evenly at both edges.

    Args:
        tilt_series: (tilt, y, u) images.
        down, across: block size along y and u, pixels.
    """
    images, mask = tilt_series.images, tilt_series.mask
    if mask is None:
        return tilt_series.with_images(np.stack([block_mean(image, down, across) for image in images]), None)
    shares = np.stack([block_mean(use, down, across) for use in mask])
    sums = (block_mean(np.where(use, image, 0), down, across) for image, use in zip(images, mask, strict=True))
    used = shares >= _ENOUGH
    means = [total / np.maximum(share, _ENOUGH) for total, share in zip(sums, shares, strict=True)]
    whole = np.stack([filled(mean, use) for mean, use in zip(means, used, strict=True)])
    return tilt_series.with_images(whole, None if used.all() else used)


def detector_offset(tilt_series: TiltSeries, across: int) -> float:
    """Distance of the centre of the binned images from that of the whole ones along u, coarse pixels: an odd remainder is
    dropped unevenly."""
    remainder = int(tilt_series.images.shape[2] % across)
    return -(remainder % 2) / 2 / across


def coarse(tilt_series: TiltSeries, *, height: int, width: int) -> TiltSeries:
    """The series, `binned` to at most `height` rows and `width` columns."""
    _, rows, columns = tilt_series.images.shape
    return binned(tilt_series, -(-rows // height), -(-columns // width))


def plausible(tilt_series: TiltSeries) -> TiltSeries:
    """The series with masked pixels replaced by the nearest used value of their image."""
    images, mask = tilt_series.images, tilt_series.mask
    if mask is None:
        return tilt_series
    whole = (filled(image, use) for image, use in zip(images, mask, strict=True))
    kept = mapped.mapped_copy(whole, images.shape, images.dtype, in_memory=mapped.IN_MEMORY)
    return tilt_series.with_images(kept, mask)


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
