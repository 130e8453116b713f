"""Orientation of series: the standard one, and the turned images of a second tilt axis in one series with the first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import mapped
from noiseflow.io.mapped import is_mapped
from recon.series.tilt_series import TiltSeries


@dataclass(frozen=True)
class Orientation:
    """Flips that preserve the geometry; the volume is flipped accordingly. Each flip is its own inverse.

    Attributes:
        upside_down: whether images are flipped along y.
        mirrored: whether images are flipped along u.
        negated: whether tilt angles are negated.
    """

    upside_down: bool = False
    mirrored: bool = False
    negated: bool = False

    @classmethod
    def of(cls, tilt_series: TiltSeries) -> Orientation:
        """The flips that move the highest contrast to larger y, larger u and positive angles.

        Contrast is the squared deviation of used pixels from the mean. The result does not depend on an added constant, a scale,
        the order of the tilts, or full turns of their angles. A series about two axes is not flipped.
        """
        if tilt_series.axes is not None:
            return cls()
        _, height, width = tilt_series.images.shape
        total, count = np.sum([(part.sum(), used.sum()) for part, used in _used(tilt_series)], axis=0)
        down, across = (np.arange(size) - (size - 1) / 2 for size in (height, width))
        moments = np.zeros(3)
        for (part, used), sine in zip(_used(tilt_series), np.sin(np.deg2rad(tilt_series.tilt_angles)), strict=True):
            power = (part - total / count) ** 2 * used
            moments += power.sum(1) @ down, power.sum(0) @ across, power.sum() * sine
        return cls(*(bool(moment < 0) for moment in moments))

    def series(self, tilt_series: TiltSeries) -> TiltSeries:
        """Convert a series to this orientation and to angles around zero, with its tilts in the same order."""
        mean = float(tilt_series.tilt_angles.mean())
        angles = tilt_series.tilt_angles - (mean - math.remainder(mean, 360))  # whole turns, exactly
        if self == Orientation():
            return replace(tilt_series, tilt_angles=angles)
        images = self._stack(tilt_series.images)
        mask = None if tilt_series.mask is None else self._stack(tilt_series.mask)
        return replace(tilt_series.with_images(images, mask), tilt_angles=-angles if self.negated else angles)

    def _stack(self, images: NDArray[Any]) -> NDArray[Any]:
        if not is_mapped(images):
            return self.images(images)
        return mapped.mapped_copy((self.images(image) for image in images), images.shape, images.dtype)

    def images(self, images: NDArray[Any]) -> NDArray[Any]:
        """Flip images (..., y, u), in either direction."""
        axes = [axis for axis, flip in ((-2, self.upside_down), (-1, self.mirrored)) if flip]
        return np.ascontiguousarray(np.flip(images, tuple(axes)))

    def projections(self, images: NDArray[Any]) -> NDArray[Any]:
        """Flip images (tilt, y, u) sorted by angle, in either direction. Mapped images are flipped in their file."""
        return _flipped(images, {0: self.negated, 1: self.upside_down, 2: self.mirrored})

    def volume(self, volume: NDArray[Any]) -> NDArray[Any]:
        """Flip a volume (z, y, x), in either direction. A mapped volume is flipped in its file."""
        return _flipped(volume, dict.fromkeys(self.axes, True))

    @property
    def axes(self) -> tuple[int, ...]:
        """The axes of a volume (z, y, x) that are flipped (u = x cos θ + z sin θ)."""
        flips = (self.mirrored != self.negated, self.upside_down, self.mirrored)
        return tuple(axis for axis, flip in enumerate(flips) if flip)


def _used(tilt_series: TiltSeries) -> Iterator[tuple[NDArray[np.float64], NDArray[Any]]]:
    """Yield each image, zero at masked pixels, with its mask of used pixels."""
    for number, image in enumerate(tilt_series.images):
        used = np.ones(image.shape) if tilt_series.mask is None else tilt_series.mask[number]
        yield image.astype(np.float64) * used, used


def _flipped(array: NDArray[Any], axes: dict[int, bool]) -> NDArray[Any]:
    flips = tuple(axis for axis, flip in axes.items() if flip)
    if array.ndim < 3 or not (is_mapped(array) and array.flags.writeable):
        return np.ascontiguousarray(np.flip(array, flips))
    inner = tuple(axis - 1 for axis in flips if axis)
    for place in range((len(array) + 1) // 2 if 0 in flips else len(array)) if flips else ():
        other = len(array) - 1 - place if 0 in flips else place
        array[other], array[place] = (np.flip(array[section], inner).copy() for section in (place, other))
    return array


def turned_images(images: NDArray[Any]) -> NDArray[Any]:
    """Images (..., along the axis, across it) of a second series, turned by 90° so that their axis lies along x."""
    return np.swapaxes(images[..., ::-1, :], -1, -2)


def own_images(images: NDArray[Any]) -> NDArray[Any]:
    """The inverse of `turned_images`."""
    return np.swapaxes(images, -1, -2)[..., ::-1, :]


def stacked(first: TiltSeries, second: TiltSeries, *, axis: float = 90.0) -> TiltSeries:
    """Two registered series as one: the tilts of the first, then those of the second.

    Args:
        first, second: aligned, with their axes along y, and centred alike; the images of the second are turned by 90°.
        axis: direction of the second axis in the specimen, degrees from the first one towards −x.

    Raises:
        ValueError: modes or sizes differ.
    """
    if first.mode != second.mode:
        raise ValueError(f"the series about the first axis is {first.mode}, the other {second.mode}; give one mode")
    if first.images.shape[1:] != second.images.shape[:0:-1]:
        raise ValueError(f"images of {second.images.shape[1:]} do not fit {first.images.shape[1:]} turned by 90°")

    def both(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
        sections = (section for stack in (one, turned_images(other)) for section in stack)
        kind = np.result_type(one, other)
        return mapped.mapped_copy(sections, (len(one) + len(other), *one.shape[1:]), kind)

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
