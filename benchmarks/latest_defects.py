"""Defects that were written before any result of them was seen; a seeded half of them judges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks import later_defects  # noqa: F401  (registers its ways first)
from benchmarks.defects import WAYS, Source, turned_volume, way, with_angles, with_images
from recon.series.tilt_series import TiltSeries

Array = NDArray[Any]
BEFORE = frozenset(WAYS)
"""The ways of the other files, which were divided into halves before these."""


@way("dark level rises", "beam")
def _dark_level(source: Source) -> TiltSeries:
    added = 0.4 * (source.full - source.empty) * np.linspace(0, 1, source.series.num_tilts)
    return with_images(source, source.series.images + added[:, None, None])


@way("tilt angles wrong by a sine", "angles", "geometry")
def _encoder(source: Source) -> TiltSeries:
    angles = source.series.tilt_angles
    return with_angles(source, angles + 5 * np.sin(np.deg2rad(3 * angles)))


@way("specimen twists with dose", "specimen", "angles", "axis", "geometry")
def _twists(source: Source) -> TiltSeries:
    """The object turns about the tilt axis, up to 20° at the end, while the stage reports the angles as planned."""
    angles = source.series.tilt_angles
    turned = angles + np.linspace(0, 20, len(angles))
    return with_images(source, source.images(source.truth, turned))


@way("each image is the mean of five tilts", "resolution", "tilts", "residuals", "specimen")
def _smeared(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    return with_images(source, ndimage.uniform_filter1d(images, 5, axis=0, mode="nearest"))


@way("pincushion distortion", "geometry", "magnification", "lines", "residuals")
def _pincushion(source: Source) -> TiltSeries:
    _, height, width = source.series.images.shape
    y, x = np.meshgrid(*(np.arange(size) - (size - 1) / 2 for size in (height, width)), indexing="ij")
    factor = 1 + 0.3 * ((2 * y / height) ** 2 + (2 * x / width) ** 2)
    places = [y * factor + (height - 1) / 2, x * factor + (width - 1) / 2]
    images = source.series.images.astype(np.float64)
    return with_images(
        source, np.stack([ndimage.map_coordinates(i, places, order=1, cval=source.empty) for i in images])
    )


@way("eight grey levels", "saturation", "response", "residuals", late=True)
def _grey_levels(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    low, step = images.min(), max(float(np.ptp(images)) / 7, 1e-30)
    return with_images(source, low + step * np.round((images - low) / step))


@way("one pixel in two hundred is hot", "lines", "outliers", "pattern", late=True)
def _hot(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[:, source.generator.random(images.shape[1:]) < 0.005] = images.max()
    return with_images(source, images)


@way("smooth background subtracted from each image", "beam", "response", "field", "residuals", late=True)
def _background(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    flat = images - ndimage.gaussian_filter(images, (0, 6, 6))
    return TiltSeries(flat, source.series.tilt_angles, source.series.pixel_size, source.series.mode)


@way("histogram of each image equalised", "beam", "response", "mode", late=True)
def _equalised(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    ranks = [np.searchsorted(np.sort(i, axis=None), i) / i.size for i in images]
    return TiltSeries(
        np.stack(ranks).astype(np.float32), source.series.tilt_angles, source.series.pixel_size, source.series.mode
    )


@way("focus drifts", "resolution")
def _focus(source: Source) -> TiltSeries:
    blurs = np.linspace(0, 3, source.series.num_tilts)
    images = source.series.images.astype(np.float64)
    return with_images(source, np.stack([ndimage.gaussian_filter(i, b) for i, b in zip(images, blurs, strict=True)]))


@way("some tilts in strong diffraction", "beam", "tilts", "specimen", "residuals")
def _diffraction(source: Source) -> TiltSeries:
    """The brighter half of the image is twice as strong in a fifth of the tilts."""
    contrast = (source.series.images - source.empty) / (source.full - source.empty)
    strong = source.generator.random(source.series.num_tilts) < 0.2
    upper = np.arange(contrast.shape[1])[:, None] < contrast.shape[1] // 2
    changed = np.where(strong[:, None, None] & upper, 2 * contrast, contrast)
    return with_images(source, source.empty + (source.full - source.empty) * changed)


@way("object turned by 8° for a third of the series", "specimen", "angles", "tilts", "alignment", "geometry")
def _turned_for_a_while(source: Source) -> TiltSeries:
    count = source.series.num_tilts
    images, part = source.series.images.copy(), slice(count // 3, 2 * count // 3)
    images[part] = source.images(turned_volume(source.truth, 8.0), source.series.tilt_angles[part])
    return with_images(source, images)
