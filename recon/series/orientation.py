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
        images, mask = tilt_series.images, tilt_series.mask
        if is_mapped(images) and images.nbytes > mapped.IN_MEMORY:
            images = mapped.mapped_copy((self.images(image) for image in images), images.shape, images.dtype)
        else:
            images = self.images(images)
        angles = -tilt_series.tilt_angles if self.negated else tilt_series.tilt_angles
        flipped = tilt_series.with_images(images, None if mask is None else self.images(mask))
        return replace(flipped, tilt_angles=angles)

    def images(self, images: NDArray[Any]) -> NDArray[Any]:
        """Images (..., y, u), there or back."""
        return _flipped(images, {-2: self.upside_down, -1: self.mirrored})

    def volume(self, volume: NDArray[Any]) -> NDArray[Any]:
        """A volume (z, y, x), there or back: u = x cos θ + z sin θ. One that lies in a file is flipped there."""
        axes = {0: self.mirrored != self.negated, 1: self.upside_down, 2: self.mirrored}
        if not is_mapped(volume):
            return _flipped(volume, axes)
        for z in range((len(volume) + 1) // 2 if axes[0] else len(volume)):
            other = len(volume) - 1 - z if axes[0] else z
            lower, upper = (_flipped(np.array(volume[place]), {0: axes[1], 1: axes[2]}) for place in (z, other))
            volume[other], volume[z] = lower, upper
        return volume


def _used(tilt_series: TiltSeries) -> Iterator[tuple[NDArray[np.float64], NDArray[Any]]]:
    """Image by image, zero where it is masked, and where it is not."""
    for number, image in enumerate(tilt_series.images):
        used = np.ones(image.shape) if tilt_series.mask is None else tilt_series.mask[number]
        yield image.astype(np.float64) * used, used


def _flipped(array: NDArray[Any], axes: dict[int, bool]) -> NDArray[Any]:
    return np.ascontiguousarray(np.flip(array, tuple(axis for axis, flip in axes.items() if flip)))
