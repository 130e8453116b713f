"""The one orientation that a series and its mirror images are reconstructed in, so that all of them give the same volume."""

from __future__ import annotations

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
    """Flips that leave the geometry what it is: the volume is flipped alike. Each of them undoes itself.

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
        """The flips that bring most contrast to greater y, greater u and positive angles.

        The square of a pixel's distance from the mean tells, in used pixels: a constant, a scale, the order of the tilts
        and full turns of their angles do not change it.
        """
        _, height, width = tilt_series.images.shape
        total, count = np.sum([(part.sum(), used.sum()) for part, used in _used(tilt_series)], axis=0)
        down, across = (np.arange(size) - (size - 1) / 2 for size in (height, width))
        moments = np.zeros(3)
        for (part, used), sine in zip(_used(tilt_series), np.sin(np.deg2rad(tilt_series.tilt_angles)), strict=True):
            power = (part - total / count) ** 2 * used
            moments += power.sum(1) @ down, power.sum(0) @ across, power.sum() * sine
        return cls(*(bool(moment < 0) for moment in moments))

    def series(self, tilt_series: TiltSeries) -> TiltSeries:
        """A series in this orientation, its tilts in their order."""
        if self == Orientation():
            return tilt_series
        images = self._stack(tilt_series.images)
        mask = None if tilt_series.mask is None else self._stack(tilt_series.mask)
        angles = -tilt_series.tilt_angles if self.negated else tilt_series.tilt_angles
        flipped = tilt_series.with_images(images, mask)
        return replace(flipped, tilt_angles=angles)

    def _stack(self, images: NDArray[Any]) -> NDArray[Any]:
        if not is_mapped(images):
            return self.images(images)
        return mapped.mapped_copy((self.images(image) for image in images), images.shape, images.dtype)

    def images(self, images: NDArray[Any]) -> NDArray[Any]:
        """Images (..., y, u), there or back."""
        axes = [axis for axis, flip in ((-2, self.upside_down), (-1, self.mirrored)) if flip]
        return np.ascontiguousarray(np.flip(images, tuple(axes)))

    def projections(self, images: NDArray[Any]) -> NDArray[Any]:
        """Images (tilt, y, u) by rising angle, there or back. Those in a file are flipped there."""
        return _flipped(images, {0: self.negated, 1: self.upside_down, 2: self.mirrored})

    def volume(self, volume: NDArray[Any]) -> NDArray[Any]:
        """A volume (z, y, x), there or back: u = x cos θ + z sin θ. One that lies in a file is flipped there."""
        return _flipped(volume, {0: self.mirrored != self.negated, 1: self.upside_down, 2: self.mirrored})


def _used(tilt_series: TiltSeries) -> Iterator[tuple[NDArray[np.float64], NDArray[Any]]]:
    """Image by image, zero where it is masked, and where it is not."""
    for number, image in enumerate(tilt_series.images):
        used = np.ones(image.shape) if tilt_series.mask is None else tilt_series.mask[number]
        yield image.astype(np.float64) * used, used


def _flipped(array: NDArray[Any], axes: dict[int, bool]) -> NDArray[Any]:
    flips = tuple(axis for axis, flip in axes.items() if flip)
    if array.ndim < 3 or not (is_mapped(array) and array.flags.writeable):
        return np.ascontiguousarray(np.flip(array, flips))
    inner = tuple(axis - 1 for axis in flips if axis)
    for place in range((len(array) + 1) // 2 if axes[0] else len(array)) if flips else ():
        other = len(array) - 1 - place if axes[0] else place
        array[other], array[place] = (np.flip(array[section], inner).copy() for section in (place, other))
    return array
