"""What a way to spoil a good tilt series is given and gives back, the list of them, and what several of them do."""

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
    """What a way of spoiling may use.

    Attributes:
        truth: (z, y, x) attenuation.
        series: clean images of it, or noisy ones for what the detector does.
        other: (z, y, x) another object of the same kind.
        intensity: of the beam (transmission), detector units.
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
    """A spoilt series.

    Attributes:
        series: the images.
        thickness: of the volume, voxels; None for as deep as wide.
        truth: what a right reconstruction would show, where the images cannot tell it from the unspoilt; None otherwise.
    """

    series: TiltSeries
    thickness: int | None = None
    truth: Array | None = None


@dataclass(frozen=True)
class Way:
    """One way to spoil a series.

    Attributes:
        spoil: does it.
        reasons: subjects of findings that name it truly; ``geometry`` names angles, axis and magnification as alternatives.
        late: whether it happens in the detector, after the noise.
    """

    spoil: Callable[[Source], Spoilt | TiltSeries]
    reasons: tuple[str, ...]
    late: bool = False


WAYS: dict[str, Way] = {}
"""Ways by name."""


def way(name: str, *reasons: str, late: bool = False) -> Callable[[Any], Any]:
    """Make a function a way to spoil a series."""

    def register(function: Callable[[Source], Spoilt | TiltSeries]) -> Callable[[Source], Spoilt | TiltSeries]:
        WAYS[name] = Way(function, reasons, late)
        return function

    return register


def with_images(source: Source, images: Array) -> TiltSeries:
    """The series with other images, of its own number type."""
    return replace(source.series, images=np.ascontiguousarray(images).astype(source.series.images.dtype))


def moved(source: Source, shifts: Array) -> TiltSeries:
    """Images moved by (tilt, (y, u)) pixels; vacuum comes in from outside."""
    images = [
        ndimage.shift(image, shift, order=1, cval=source.empty)
        for image, shift in zip(source.series.images, shifts, strict=True)
    ]
    return with_images(source, np.stack(images))


def turned(source: Source, degrees: float) -> TiltSeries:
    """Images turned in their plane; vacuum comes in from outside."""
    images = [
        ndimage.rotate(image, degrees, reshape=False, order=1, cval=source.empty) for image in source.series.images
    ]
    return with_images(source, np.stack(images))


def scaled_about_middle(source: Source, image: Array, factors: tuple[float, float]) -> Array:
    """An image magnified by (y, u) factors about its middle."""
    middle = (np.array(image.shape) - 1) / 2
    matrix = 1 / np.array(factors)
    offset = middle - matrix * middle
    return np.asarray(ndimage.affine_transform(image, matrix, offset, order=1, cval=source.empty))


def moved_across(source: Source, shifts: Array) -> TiltSeries:
    """Images moved by (tilt,) pixels along u."""
    return moved(source, np.stack([np.zeros(len(shifts)), shifts], 1))


def with_angles(source: Source, angles: Array) -> TiltSeries:
    """The series with other tilt angles, degrees."""
    return replace(source.series, tilt_angles=angles)


def later(source: Source, volume: Array) -> TiltSeries:
    """From the middle of the series on, images of another volume."""
    images, half = source.series.images.copy(), source.series.num_tilts // 2
    images[half:] = source.images(volume, source.series.tilt_angles[half:])
    return with_images(source, images)


def turned_volume(volume: Array, degrees: float) -> Array:
    """A volume turned about the tilt axis so that its images at θ + `degrees` are those of the volume at θ."""
    theta, size = np.deg2rad(degrees), (np.array(volume.shape)[[0, 2]] - 1) / 2
    matrix = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    slices = [
        ndimage.affine_transform(volume[:, row], matrix, size - matrix @ size, order=1)
        for row in range(volume.shape[1])
    ]
    return np.stack(slices, 1)
