"""Defects that were added last, half of them to judge limits that were set without them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks import rarer_defects  # noqa: F401  (registers its ways first)
from benchmarks.defects import WAYS, Source, moved, moved_across, scaled_about_middle, way, with_angles, with_images
from recon.series.tilt_series import TiltSeries

Array = NDArray[Any]
EARLIER = frozenset(WAYS)
"""The ways of the other files, which were divided into halves before these."""


def of_contrast(source: Source, images: Array) -> Array:
    """Images as a share of the strongest contrast: 0 in vacuum."""
    return np.asarray((images - source.empty) / (source.full - source.empty))


def from_contrast(source: Source, contrast: Array) -> TiltSeries:
    return with_images(source, source.empty + (source.full - source.empty) * contrast)


@way("strong contrast saturates smoothly", "response", "saturation")
def _saturates(source: Source) -> TiltSeries:
    contrast = of_contrast(source, source.series.images).clip(0)
    return from_contrast(source, (1 - np.exp(-2.5 * contrast)) / 2.5)


@way("contrast lost with dose", "beam", "specimen")
def _fades(source: Source) -> TiltSeries:
    left = np.linspace(1, 0.5, source.series.num_tilts).reshape(-1, 1, 1)
    return from_contrast(source, of_contrast(source, source.series.images) * left)


@way("each image divided by its brightest pixel", "beam", late=True)
def _by_brightest(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    scaled = images / images.max((1, 2), keepdims=True)
    return TiltSeries(scaled, source.series.tilt_angles, source.series.pixel_size, source.series.mode)


@way("angles scaled by 0.9", "angles", "geometry")
def _scaled_by_nine_tenths(source: Source) -> TiltSeries:
    return with_angles(source, source.series.tilt_angles * 0.9)


@way("lines jitter", "lines")
def _lines_jitter(source: Source) -> TiltSeries:
    return rows_moved(source, source.generator.normal(0, 1.5, source.series.images.shape[:2]))


AIMED_AT = frozenset(WAYS) - EARLIER
"""The ways above were known to be missed when the present checks were written; none of them judges."""


@way("interlaced lines apart", "lines")
def _interlaced(source: Source) -> TiltSeries:
    shifts = np.zeros(source.series.images.shape[:2])
    shifts[:, 1::2] = 3.0
    return rows_moved(source, shifts)


@way("scan drifts while an image is taken", "lines", "alignment", "axis", "geometry")
def _skewed(source: Source) -> TiltSeries:
    count, height = source.series.images.shape[:2]
    slopes = source.generator.uniform(-5, 5, (count, 1))
    return rows_moved(source, slopes * np.linspace(-1, 1, height))


@way("afterglow of the image before", "specimen", "beam", "tilts", "residuals", "resolution")
def _afterglow(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    left = images.copy()
    for number in range(1, len(left)):
        left[number] = 0.5 * images[number] + 0.5 * left[number - 1]
    return with_images(source, left)


@way("contamination grows", "specimen", "beam", "residuals")
def _contamination(source: Source) -> TiltSeries:
    """A blob that is not there at first and as dense as the object at last."""
    z, y, x = (np.linspace(-1, 1, size).reshape([-1 if i == axis else 1 for i in range(3)])
               for axis, size in enumerate(source.truth.shape))  # fmt: skip
    blob = float(source.truth.max()) * (z**2 + (y - 0.3) ** 2 + (x + 0.3) ** 2 < 0.35**2)
    grown = np.linspace(0, 1, source.series.num_tilts)[:, None, None]
    there = source.images(source.truth + blob.astype(np.float32))
    alone = source.images(source.truth)
    return with_images(source, source.series.images + grown * (there - alone))


@way("a ramp of another direction in each image", "beam", "pattern")
def _ramps(source: Source) -> TiltSeries:
    count, height, width = source.series.images.shape
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)
    slopes = source.generator.normal(0, 0.15, (count, 2, 1, 1))
    ramps = slopes[:, 0] * y + slopes[:, 1] * x
    return with_images(source, source.series.images + (source.full - source.empty) * ramps)


@way("magnification grows by a tenth", "geometry", "magnification", "specimen")
def _zooms(source: Source) -> TiltSeries:
    factors = np.linspace(0.95, 1.05, source.series.num_tilts)
    images = source.series.images.astype(np.float64)
    zoomed = [scaled_about_middle(source, i, (f, f)) for i, f in zip(images, factors, strict=True)]
    return with_images(source, np.stack(zoomed))


@way("backlash of 5° between two branches", "angles", "geometry", "tilts", "specimen")
def _backlash(source: Source) -> TiltSeries:
    """Taken outwards in both directions; every other image belongs to the second branch."""
    angles = source.series.tilt_angles.copy()
    angles[1::2] += 5.0
    return with_angles(source, angles)


@way("every third image mirrored", "specimen", "tilts", "angles", "geometry")
def _mirrored(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[::3] = images[::3, :, ::-1]
    return with_images(source, images)


@way("specimen charges where tilted", "alignment", "geometry")
def _charges(source: Source) -> TiltSeries:
    tilted = np.sin(2 * np.deg2rad(source.series.tilt_angles))
    return moved(source, np.stack([5 * tilted**2, 4 * np.abs(tilted)], 1))


@way("shifts rounded to 4 pixels", "alignment")
def _rounded(source: Source) -> TiltSeries:
    true = np.cumsum(source.generator.normal(0, 1.5, source.series.num_tilts))
    return moved_across(source, true - 4 * np.round(true / 4))


@way("angles rounded to 10°", "angles", "geometry", "repeats")
def _angles_rounded(source: Source) -> TiltSeries:
    angles = source.series.tilt_angles
    return with_angles(source, 10 * np.round(angles / 10) + 1e-3 * np.arange(len(angles)))


def rows_moved(source: Source, shifts: Array) -> TiltSeries:
    """Every row (tilt, y) moved along u by its own shift, pixels, filled with vacuum."""
    images = source.series.images.astype(np.float64)
    found = [
        [ndimage.shift(row, by, order=1, cval=source.empty) for row, by in zip(image, moves, strict=True)]
        for image, moves in zip(images, shifts, strict=True)
    ]
    return with_images(source, np.array(found))
