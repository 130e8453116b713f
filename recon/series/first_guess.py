"""Initial estimates from a tilt series before any fit: detector response, scale of attenuation, slabs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.projection.base import Projector
from recon.projection.classical import sirt
from recon.projection.image_formation import Linear, Transmission
from recon.series.masks import binned, filled, used_values
from recon.series.tilt_series import TiltSeries


def estimate_response(tilt_series: TiltSeries, *, estimate: bool = True, level: float = 0.0) -> Transmission | Linear:
    """Initial estimate of the detector response: vacuum is brightest in bright field and darkest in HAADF.

    Args:
        tilt_series: the data.
        estimate: whether the fit refines the response.
        level: constant level of linear images, detector units; the response is that of pixel values above it.

    Raises:
        ValueError: bright-field images have no positive values.
    """
    images = tilt_series.images
    beam = None if tilt_series.beam is None else torch.from_numpy(tilt_series.beam.astype(np.float32))
    block = max(1, min(8, *(size // 8 for size in images.shape[1:])))
    small = binned(tilt_series, block, block)
    means: NDArray[np.floating[Any]] = small.images
    if tilt_series.mode == "linear":
        dark, bright = (float(level) for level in np.quantile(used_values(small, means), (0.02, 0.98)))
        span = bright - dark if bright > dark else 1.0
        return Linear(offset=dark - level, beam=beam, offset_unit=span, estimate=estimate)
    if tilt_series.beam is not None:
        means = means / tilt_series.beam[:, None, None]
    intensity = float(np.quantile(used_values(small, means), 0.95))
    if intensity <= 0:
        raise ValueError(
            "the vacuum of a transmission series must be positive, but these images are negative; try --mode linear"
        )
    return Transmission(intensity if beam is None else intensity * beam, estimate=estimate)


def rough_volume(tilt_series: TiltSeries, response: Transmission | Linear, projector: Projector) -> Tensor:
    """A few iterations of SIRT on bands of four slices, (z, y/4, x); of single slices, if they are not independent."""
    bands = binned(tilt_series, 1 if projector.fixed_height else min(4, tilt_series.images.shape[1]), 1)
    images = torch.from_numpy(bands.images).to(projector.device)
    used = None if bands.mask is None else torch.from_numpy(bands.mask).to(images)
    with torch.no_grad():
        return sirt(response.invert(images).contiguous(), projector, num_iterations=30, used=used)


def attenuation_scale(volume: Tensor) -> float:
    """Typical attenuation per voxel outside vacuum: the mean weighted by the squared attenuation."""
    power = (volume**2).sum()
    return float((volume**3).sum() / power) if power > 0 else 1.0


def contrast_slab(tilt_series: TiltSeries, num_slices: int) -> slice:
    """The `num_slices` neighbouring slices with the largest variation of the images; all of a series about two axes."""
    height = tilt_series.images.shape[1]
    if num_slices >= height or tilt_series.axes is not None:
        return slice(0, height)
    start = int(_variation(tilt_series, num_slices).argmax())
    return slice(start, start + num_slices)


def calm_slab(tilt_series: TiltSeries, num_slices: int, apart_from: slice) -> slice:
    """At most `num_slices` neighbouring slices with the smallest variation of the images, outside `apart_from`."""
    num_slices = min(num_slices, max(apart_from.start, tilt_series.images.shape[1] - apart_from.stop))
    if num_slices == 0:
        return slice(0, 0)
    variation = _variation(tilt_series, num_slices)
    variation[max(0, apart_from.start - num_slices + 1) : apart_from.stop] = np.inf
    start = int(variation.argmin())
    return slice(start, start + num_slices)


def _variation(tilt_series: TiltSeries, num_slices: int) -> NDArray[np.float64]:
    """Variation of the mean image in every range of `num_slices` neighbouring slices, by its first slice."""
    if tilt_series.mask is None:
        mean = tilt_series.images.mean(0, dtype=np.float32)
    else:
        pairs = zip(tilt_series.images, tilt_series.mask, strict=True)
        total = sum((np.where(use, image, 0).astype(np.float32) for image, use in pairs), np.float32(0))
        count = tilt_series.mask.sum(0)
        mean = filled(total / np.maximum(count, 1), count > 0)
    return np.convolve(mean.var(1), np.ones(num_slices), mode="valid")
