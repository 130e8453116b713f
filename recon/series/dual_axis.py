"""Two tilt series of one specimen, about two axes, as one series."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import mapped
from recon.series.tilt_series import TiltSeries


def turned_images(images: NDArray[Any]) -> NDArray[Any]:
    """Images (..., along the axis, across it) of a second series, turned by 90° so that their axis lies along x."""
    return np.swapaxes(images[..., ::-1, :], -1, -2)


def own_images(images: NDArray[Any]) -> NDArray[Any]:
    """The inverse of `turned_images`."""
    return np.swapaxes(images, -1, -2)[..., ::-1, :]


def stacked(first: TiltSeries, second: TiltSeries, *, axis: float = 90.0) -> TiltSeries:
    """Two registered series as one: the tilts of the first, then those of the second.

    Args:
        first: aligned, with its axis along y.
        second: aligned, with its axis along y, and centred like the first; its images are turned by 90°.
        axis: direction of the second axis in the specimen, degrees from the first one towards −x.

    Raises:
        ValueError: modes or sizes differ.
    """
    if first.mode != second.mode:
        raise ValueError(
            f"the series about the first axis is {first.mode}, the other {second.mode}; give both in one mode"
        )
    if first.images.shape[1:] != second.images.shape[:0:-1]:
        raise ValueError(
            f"images of {second.images.shape[1:]} do not fit images of {first.images.shape[1:]} turned by 90°"
        )

    def both(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
        sections = (section for stack in (one, turned_images(other)) for section in stack)
        kind = np.result_type(one, other)
        shape = (len(one) + len(other), *one.shape[1:])
        return mapped.mapped_copy(sections, shape, kind)

    mask = None if first.mask is None and second.mask is None else both(first.used, second.used)
    beam = None
    if first.beam is not None or second.beam is not None:
        beam = np.concatenate([np.ones(each.num_tilts) if each.beam is None else each.beam for each in (first, second)])
    axes = np.r_[np.zeros(first.num_tilts), np.full(second.num_tilts, axis)]
    angles = np.r_[first.tilt_angles, second.tilt_angles]
    return TiltSeries(
        both(first.images, second.images),
        angles,
        first.pixel_size,
        first.mode,
        mask=mask,
        beam=beam,
        axes=axes,
        x_tilt=first.x_tilt,
    )


def about(tilt_series: TiltSeries, *, second: bool) -> TiltSeries:
    """The tilts about one of the two axes, in their own frame, with the axis along y."""
    if tilt_series.axes is None:
        raise ValueError("this series has one tilt axis; join two series with stacked()")
    part = tilt_series.select(np.flatnonzero((tilt_series.axes != 0) == second))
    mask = part.mask
    if second:
        part = part.with_images(own_images(part.images), None if mask is None else own_images(mask))
    return replace(part, axes=None)
