"""Defects for tilt series, one function each, with the reasons that a verdict may correctly name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from benchmarks.defects import (
    WAYS,
    Source,
    Spoilt,
    later,
    moved,
    moved_across,
    scaled_about_middle,
    turned,
    turned_volume,
    way,
    with_angles,
    with_images,
)
from recon.series.tilt_series import Mode, TiltSeries

__all__ = ["WAYS", "Source", "Spoilt"]  # their old place


@way("axis wrong by 90°", "geometry", "axis")
def _axis_90(source: Source) -> TiltSeries:
    return with_images(source, source.series.images.transpose(0, 2, 1))


@way("axis wrong by 45°", "geometry", "axis")
def _axis_45(source: Source) -> TiltSeries:
    return turned(source, 45)


@way("axis wrong by 10°", "geometry", "axis")
def _axis_10(source: Source) -> TiltSeries:
    return turned(source, 10)


@way("axis wrong by 5°", "geometry", "axis")
def _axis_5(source: Source) -> TiltSeries:
    return turned(source, -5)


@way("axis 5 pixels off the middle", "alignment")
def _axis_off(source: Source) -> TiltSeries:
    return moved_across(source, np.full(source.series.num_tilts, 5.0))


@way("shifts of 5 pixels", "alignment")
def _shifts_5(source: Source) -> TiltSeries:
    return moved(source, source.generator.uniform(-5, 5, (source.series.num_tilts, 2)))


@way("shifts of 2 pixels", "alignment")
def _shifts_2(source: Source) -> TiltSeries:
    return moved(source, source.generator.uniform(-2, 2, (source.series.num_tilts, 2)))


@way("shifts along the axis alone", "alignment")
def _shifts_y(source: Source) -> TiltSeries:
    shifts = source.generator.uniform(-4, 4, (source.series.num_tilts, 2))
    return moved(source, shifts * (1, 0))


@way("drift of the specimen", "alignment", "specimen")
def _specimen_drift(source: Source) -> Spoilt:
    """Nearly identical to images of an object shifted along the beam; a correct volume is shifted accordingly."""
    drift, sine = np.linspace(-6, 6, source.series.num_tilts), np.sin(np.deg2rad(source.series.tilt_angles))
    place = float((drift * sine).sum() / (sine**2).sum())
    return Spoilt(moved_across(source, drift), truth=np.asarray(ndimage.shift(source.truth, (place, 0, 0), order=1)))


@way("jump of the stage", "alignment", "specimen")
def _jump(source: Source) -> TiltSeries:
    return moved_across(source, np.where(np.arange(source.series.num_tilts) < source.series.num_tilts // 2, 0.0, 5.0))


@way("angles in reversed order")
def _reversed(source: Source) -> Spoilt:
    """Images of a mirrored and slightly rotated object: correct except for the handedness, which images do not determine."""
    angles = source.series.tilt_angles[::-1].copy()
    offset = angles[0] + source.series.tilt_angles[0]
    mirrored = source.truth[::-1]
    return Spoilt(with_angles(source, angles), truth=turned_volume(mirrored, -offset))


@way("angles offset by 10°")
def _offset(source: Source) -> Spoilt:
    """Images of a rotated object: correct except for the orientation, which images do not determine."""
    return Spoilt(with_angles(source, source.series.tilt_angles + 10), truth=turned_volume(source.truth, 10))


@way("angles scaled by 1.3", "geometry", "angles")
def _scaled(source: Source) -> TiltSeries:
    return with_angles(source, source.series.tilt_angles * 1.3)


@way("angles scaled by 0.6", "geometry", "angles")
def _scaled_down(source: Source) -> TiltSeries:
    return with_angles(source, source.series.tilt_angles * 0.6)


@way("angles in radians", "angles", "range")
def _radians(source: Source) -> TiltSeries:
    return with_angles(source, np.deg2rad(source.series.tilt_angles))


@way("angles shuffled", "geometry", "angles")
def _shuffled(source: Source) -> TiltSeries:
    return with_angles(source, source.generator.permutation(source.series.tilt_angles))


@way("angles without their sign", "geometry", "angles")
def _unsigned(source: Source) -> TiltSeries:
    angles = source.series.tilt_angles
    return with_angles(source, np.abs(angles) + 1e-3 * (angles < 0))


@way("angles one tilt late beyond the middle", "geometry", "angles", "tilts", "specimen")
def _skipped(source: Source) -> TiltSeries:
    angles, step = source.series.tilt_angles, np.diff(source.series.tilt_angles).mean()
    return with_angles(source, np.where(angles > np.median(angles), angles + 6 * step, angles))


@way("angles jittered by 5°", "geometry", "angles")
def _jittered(source: Source) -> TiltSeries:
    return with_angles(source, source.series.tilt_angles + source.generator.normal(0, 5, source.series.num_tilts))


@way("wrong mode", "mode")
def _mode(source: Source) -> TiltSeries:
    other: Mode = "transmission" if source.series.mode == "linear" else "linear"
    return replace(source.series, mode=other)


@way("contrast inverted", "mode", late=True)
def _inverted(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    return with_images(source, images.max() + images.min() - images)


@way("logarithm taken before", "mode", "response", late=True)
def _logarithm(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    least = max(1e-3, 1e-2 * images.max())
    return replace(source.series, images=np.log(images.clip(least)).astype(np.float32) + 10, mode=source.series.mode)


@way("object larger than the field", "field")
def _too_large(source: Source) -> TiltSeries:
    width = source.series.images.shape[2]
    doubled = ndimage.zoom(source.truth, 2, order=1) / 2
    start = doubled.shape[2] // 2 - width // 2
    rows = slice(doubled.shape[1] // 2 - width // 2, doubled.shape[1] // 2 + (width + 1) // 2)
    return with_images(source, source.images(doubled[:, rows])[:, :, start : start + width])


@way("cropped to the left 60 %", "field", "alignment")
def _cropped(source: Source) -> TiltSeries:
    width = source.series.images.shape[2]
    return with_images(source, source.series.images[:, :, : round(0.6 * width)])


@way("a quarter of the thickness", "thickness")
def _thin(source: Source) -> Spoilt:
    return Spoilt(source.series, thickness=source.truth.shape[0] // 4)


@way("half of the object moved", "specimen", "alignment")
def _half_moved(source: Source) -> TiltSeries:
    half_moved, width = source.truth.copy(), source.truth.shape[2]
    half_moved[:, :, : width // 2] = np.roll(half_moved[:, :, : width // 2], 6, axis=0)
    return later(source, half_moved)


@way("object turned at half time", "geometry", "specimen", "angles")
def _object_turned(source: Source) -> TiltSeries:
    return later(source, turned_volume(source.truth, 15))


@way("object shrinks by 15 %", "geometry", "specimen", "magnification", "beam")
def _shrinks(source: Source) -> TiltSeries:
    count, images = source.series.num_tilts, source.series.images
    factors = np.linspace(1, 0.85, count)
    return with_images(
        source, np.stack([scaled_about_middle(source, i, (f, f)) for i, f in zip(images, factors, strict=True)])
    )


@way("two series spliced", "specimen")
def _spliced(source: Source) -> TiltSeries:
    return later(source, source.other)


@way("every other tilt of another object", "specimen")
def _interleaved(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[1::2] = source.images(source.other)[1::2]
    return with_images(source, images)


@way("two tilts swapped", "tilts", "angles")
def _swapped(source: Source) -> TiltSeries:
    images, count = source.series.images.copy(), source.series.num_tilts
    first, second = count // 5, 4 * count // 5
    images[[first, second]] = images[[second, first]]
    return with_images(source, images)


@way("one tilt of another object", "tilts")
def _one_other(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    middle = source.series.num_tilts // 2
    images[middle] = source.images(source.other)[middle]
    return with_images(source, images)


@way("half of the images upside down", "specimen", "alignment")
def _upside_down(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    half = source.series.num_tilts // 2
    images[half:] = images[half:, ::-1]
    return with_images(source, images)


@way("beam drifts by 40 %", "beam")
def _beam_drift(source: Source) -> TiltSeries:
    beam = np.linspace(1.2, 0.8, source.series.num_tilts)
    return with_images(source, source.series.images * beam[:, None, None])


@way("beam flickers by 20 %", "beam")
def _beam_flickers(source: Source) -> TiltSeries:
    beam = np.exp(source.generator.normal(0, 0.2, source.series.num_tilts))
    return with_images(source, source.series.images * beam[:, None, None])


@way("offset changes from tilt to tilt", "beam")
def _offsets(source: Source) -> TiltSeries:
    span = abs(source.full - source.empty)
    offsets = source.generator.normal(0, 0.15 * span, source.series.num_tilts)
    return with_images(source, source.series.images + offsets[:, None, None])


@way("each image scaled to its own range", "beam", late=True)
def _own_range(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    low, high = (np.quantile(images, share, axis=(1, 2), keepdims=True) for share in (0.01, 0.99))
    return replace(source.series, images=(images - low) / (high - low) * np.float32(source.series.images.max()))


@way("every tilt twice", "repeats", late=True)
def _doubled(source: Source) -> TiltSeries:
    twice = np.repeat(np.arange(source.series.num_tilts), 2)
    return source.series.select(twice)


@way("one image repeated over a third of the tilts", "repeats", "tilts", late=True)
def _frozen(source: Source) -> TiltSeries:
    images, count = source.series.images.copy(), source.series.num_tilts
    images[count // 3 : 2 * count // 3] = images[count // 3]
    return with_images(source, images)


@way("half of the tilt range", "range", late=True)
def _half_range(source: Source) -> TiltSeries:
    return source.series.select(slice(0, source.series.num_tilts // 2))


@way("nine tilts", "range", late=True)
def _few(source: Source) -> TiltSeries:
    return source.series.select(np.linspace(0, source.series.num_tilts - 1, 9).astype(int))


@way("a gap of 50° in the tilts", "range", late=True)
def _gap(source: Source) -> TiltSeries:
    return source.series.select(np.abs(source.series.tilt_angles - 10) > 25)


@way("pure noise", "noise", late=True)
def _noise(source: Source) -> TiltSeries:
    images = source.series.images
    flat = images.reshape(-1).copy()
    source.generator.shuffle(flat)
    return with_images(source, flat.reshape(images.shape))


@way("pixels shuffled in half of the tilts", "tilts", "specimen", late=True)
def _half_noise(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images[1::2]:
        source.generator.shuffle(image.reshape(-1))
    return with_images(source, images)


@way("gain pattern of 10 %", "pattern", late=True)
def _gain(source: Source) -> TiltSeries:
    gain = source.generator.normal(1, 0.1, source.series.images.shape[1:])
    return with_images(source, source.series.images * gain)


@way("uneven illumination", "pattern", late=True)
def _vignette(source: Source) -> TiltSeries:
    _, height, width = source.series.images.shape
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)
    return with_images(source, source.series.images * (1 - 0.2 * (y**2 + (x - 0.3) ** 2)))


@way("saturation", "saturation", "response", late=True)
def _saturation(source: Source) -> TiltSeries:
    images = source.series.images
    if source.series.mode == "linear":
        return with_images(source, np.minimum(images, 0.35 * source.full))
    return with_images(source, np.maximum(images, source.empty - 0.35 * (source.empty - source.full)))


@way("overflow of the number type", "outliers", "saturation", late=True)
def _overflow(source: Source) -> TiltSeries:
    images = source.series.images
    limit = 0.6 * float(np.quantile(images, 0.999))
    return with_images(source, np.where(images > limit, images - limit, images))


@way("half of the tilts rebinned", "geometry", "magnification", "resolution", late=True)
def _rebinned(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    half = source.series.num_tilts // 2
    for image in images[half:]:
        image[:] = scaled_about_middle(source, image.astype(np.float64), (0.5, 0.5)).astype(image.dtype)
    return with_images(source, images)
