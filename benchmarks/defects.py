"""Registry of defects for tilt series, their input and output, and shared operations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.metrics.comparison import project
from recon.series.tilt_series import TiltSeries

Array = NDArray[Any]


@dataclass(frozen=True)
class Source:
    """Input of a defect function.

    Attributes:
        truth: (z, y, x) attenuation.
        series: clean images of it, or noisy ones for defects of the detector.
        other: (z, y, x) another object of the same type.
        intensity: incident intensity (transmission), detector units.
        generator: source of random choices.
    """

    truth: Array
    series: TiltSeries
    other: Array
    intensity: float
    generator: np.random.Generator

    def images(self, volume: Array, angles: Array | None = None) -> Array:
        """Clean images of any volume, detector units."""
        angles = self.series.tilt_angles if angles is None else angles
        if self.series.mode == "linear":
            return project(volume, angles, mode="linear")
        return self.intensity * project(volume, angles, mode="transmission")

    @property
    def empty(self) -> float:
        """The pixel value of vacuum."""
        return 0.0 if self.series.mode == "linear" else self.intensity

    @property
    def full(self) -> float:
        """The pixel value at the strongest contrast."""
        images = self.series.images
        return float(images.max() if self.series.mode == "linear" else images.min())


@dataclass(frozen=True)
class Spoilt:
    """A series with a defect.

    Attributes:
        series: the images.
        thickness: thickness of the volume, voxels; None if it equals the width.
        truth: the expected reconstruction, if the images are consistent with a different object; None otherwise.
    """

    series: TiltSeries
    thickness: int | None = None
    truth: Array | None = None


@dataclass(frozen=True)
class Way:
    """One defect.

    Attributes:
        spoil: function that applies it.
        reasons: subjects of findings that name it correctly; ``geometry`` stands for angles, axis or magnification.
        late: whether it is applied in the detector, after the noise.
    """

    spoil: Callable[[Source], Spoilt | TiltSeries]
    reasons: tuple[str, ...]
    late: bool = False


WAYS: dict[str, Way] = {}
"""Defects by name."""


def way(name: str, *reasons: str, late: bool = False) -> Callable[[Any], Any]:
    """Register a function as a defect."""

    def register(function: Callable[[Source], Spoilt | TiltSeries]) -> Callable[[Source], Spoilt | TiltSeries]:
        WAYS[name] = Way(function, reasons, late)
        return function

    return register


def with_images(source: Source, images: Array) -> TiltSeries:
    """The series with other images, in its own data type."""
    return replace(source.series, images=np.ascontiguousarray(images).astype(source.series.images.dtype))


def moved(source: Source, shifts: Array) -> TiltSeries:
    """Images shifted by (tilt, (y, u)) pixels, filled with vacuum."""
    images = [
        ndimage.shift(image, shift, order=1, cval=source.empty)
        for image, shift in zip(source.series.images, shifts, strict=True)
    ]
    return with_images(source, np.stack(images))


def turned(source: Source, degrees: float) -> TiltSeries:
    """Images rotated in their plane, filled with vacuum."""
    images = [
        ndimage.rotate(image, degrees, reshape=False, order=1, cval=source.empty) for image in source.series.images
    ]
    return with_images(source, np.stack(images))


def scaled_about_middle(source: Source, image: Array, factors: tuple[float, float]) -> Array:
    """An image magnified by (y, u) factors about its centre."""
    middle = (np.array(image.shape) - 1) / 2
    matrix = 1 / np.array(factors)
    offset = middle - matrix * middle
    return np.asarray(ndimage.affine_transform(image, matrix, offset, order=1, cval=source.empty))


def moved_across(source: Source, shifts: Array) -> TiltSeries:
    """Images shifted by (tilt,) pixels along u."""
    return moved(source, np.stack([np.zeros(len(shifts)), shifts], 1))


def with_angles(source: Source, angles: Array) -> TiltSeries:
    """The series with other tilt angles, degrees."""
    return replace(source.series, tilt_angles=angles)


def later(source: Source, volume: Array) -> TiltSeries:
    """Images of another volume in the second half of the series."""
    images, half = source.series.images.copy(), source.series.num_tilts // 2
    images[half:] = source.images(volume, source.series.tilt_angles[half:])
    return with_images(source, images)


def turned_volume(volume: Array, degrees: float) -> Array:
    """A volume rotated about the tilt axis, so that its images at θ + `degrees` are those of the original at θ."""
    theta, size = np.deg2rad(degrees), (np.array(volume.shape)[[0, 2]] - 1) / 2
    matrix = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    slices = [
        ndimage.affine_transform(volume[:, row], matrix, size - matrix @ size, order=1)
        for row in range(volume.shape[1])
    ]
    return np.stack(slices, 1)
