"""Further defects for tilt series: effects of microscopes, file formats and well-meant corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import fft, ndimage

from benchmarks import common_defects  # noqa: F401  (registers its ways first)
from benchmarks.defects import (
    Source,
    Spoilt,
    moved_across,
    scaled_about_middle,
    way,
    with_angles,
    with_images,
)
from recon.series.tilt_series import TiltSeries


@way("half of the tilts out of focus", "resolution")
def _out_of_focus(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    images[images.shape[0] // 2 :] = ndimage.gaussian_filter(images[images.shape[0] // 2 :], (0, 3, 3))
    return with_images(source, images)


@way("images stretched across the axis where tilted", "geometry", "magnification", "angles")
def _stretched(source: Source) -> TiltSeries:
    factors = 1 + 0.25 * np.abs(np.sin(np.deg2rad(source.series.tilt_angles)))
    images = source.series.images
    stretched = [scaled_about_middle(source, i, (1.0, f)) for i, f in zip(images, factors, strict=True)]
    return with_images(source, np.stack(stretched))


@way("missing rows", "lines", late=True)
def _missing_rows(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[:, :: max(4, images.shape[1] // 8)] = 0
    return with_images(source, images)


@way("missing columns", "lines", late=True)
def _missing_columns(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[:, :, :: max(4, images.shape[2] // 6)] = 0
    return with_images(source, images)


@way("rows displaced", "lines", "alignment")
def _rows_displaced(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images:
        for row in image:
            row[:] = np.roll(row, int(source.generator.integers(-4, 5)))
    return with_images(source, images)


@way("bright spikes", "outliers", late=True)
def _spikes(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    hit = source.generator.random(images.shape) < 0.003
    return replace(source.series, images=np.where(hit, np.float32(30 * abs(images).max()), images))


@way("drift within every tilt", "resolution")
def _drift_within(source: Source) -> Spoilt:
    """Blur along u, equal at all tilts: identical to images of an object that is blurred across the axis."""
    images, moves = source.series.images.astype(np.float64), range(-3, 4)
    blurred = np.mean([ndimage.shift(images, (0, 0, by), order=1, cval=source.empty) for by in moves], axis=0)
    deviation = float(np.std(moves))
    return Spoilt(with_images(source, blurred), truth=ndimage.gaussian_filter(source.truth, (deviation, 0, deviation)))


@way("half of the tilts with another gain", "beam", "specimen")
def _other_gain(source: Source) -> TiltSeries:
    gain = np.where(np.arange(source.series.num_tilts) < source.series.num_tilts // 2, 1.0, 1.5)
    return with_images(source, source.series.images * gain[:, None, None])


@way("signs of a third of the angles flipped", "geometry", "angles", "specimen", "tilts")
def _signs(source: Source) -> TiltSeries:
    angles = source.series.tilt_angles.copy()
    angles[::3] = -angles[::3] + 1e-3
    return with_angles(source, angles)


@way("blur that grows with the tilt", "resolution")
def _growing_blur(source: Source) -> TiltSeries:
    blurs = 3 * np.abs(np.sin(np.deg2rad(source.series.tilt_angles)))
    images = source.series.images.astype(np.float64)
    return with_images(source, np.stack([ndimage.gaussian_filter(i, b) for i, b in zip(images, blurs, strict=True)]))


@way("half of the thickness", "thickness", "geometry")
def _half_thickness(source: Source) -> Spoilt:
    depth = source.truth.shape[0]
    return Spoilt(source.series, depth // 2, truth=source.truth[depth // 4 : depth // 4 + depth // 2])


@way("contrast inverted in a third of the tilts", "mode", "specimen", "tilts", "beam", late=True)
def _partly_inverted(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    images[::3] = images.max() + images.min() - images[::3]
    return with_images(source, images)


@way("detector's response bent", "mode", "saturation", "response")
def _bent(source: Source) -> TiltSeries:
    """Square root of the contrast, which compresses strong contrast."""
    contrast = (source.series.images - source.empty) / (source.full - source.empty)
    return with_images(source, source.empty + (source.full - source.empty) * np.sqrt(contrast.clip(0)))


@way("borders of zeros after an alignment", "field", "lines", "alignment", late=True)
def _zero_borders(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images:
        left, top = source.generator.integers(2, images.shape[2] // 5, 2)
        image[:, :left] = 0
        image[:top] = 0
    return with_images(source, images)


@way("compressed by blocks of 8 pixels", "pattern", "residuals", late=True)
def _compressed(source: Source) -> TiltSeries:
    """Keep the ten lowest frequencies of the cosine transform of every block, coarsely rounded, as in JPEG."""
    images = source.series.images.astype(np.float64)
    height, width = (8 * (size // 8) for size in images.shape[1:])
    blocks = images[:, :height, :width].reshape(len(images), height // 8, 8, width // 8, 8)
    step = 0.05 * 8 * abs(source.full - source.empty)
    spectrum = step * np.round(fft.dctn(blocks, axes=(2, 4), norm="ortho") / step)
    kept = np.add.outer(np.arange(8), np.arange(8))[:, None, :] < 4
    images[:, :height, :width] = fft.idctn(spectrum * kept, axes=(2, 4), norm="ortho").reshape(
        len(images), height, width
    )
    return with_images(source, images)


@way("hot rows that come and go", "lines", "outliers", "pattern", late=True)
def _hot_rows(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images:
        image[source.generator.integers(0, images.shape[1], 2)] = source.series.images.max()
    return with_images(source, images)


@way("ten neighbouring tilts in reversed order", "geometry", "angles", "tilts", "specimen")
def _run_reversed(source: Source) -> TiltSeries:
    images, start = source.series.images.copy(), source.series.num_tilts // 2
    images[start : start + 10] = images[start : start + 10][::-1]
    return with_images(source, images)


@way("images rotated more and more, up to 10°", "geometry", "axis", "specimen", "alignment")
def _rotating(source: Source) -> TiltSeries:
    degrees = np.linspace(-5, 5, source.series.num_tilts)
    images = source.series.images
    return with_images(
        source,
        np.stack(
            [
                ndimage.rotate(i, d, reshape=False, order=1, cval=source.empty)
                for i, d in zip(images, degrees, strict=True)
            ]
        ),
    )


@way("a bright background that moves", "pattern", "beam")
def _moving_background(source: Source) -> TiltSeries:
    """A smooth bump with a tenth of the contrast that changes its position every few tilts."""
    count, height, width = source.series.images.shape
    centres = source.generator.uniform(0.2, 0.8, (count, 2)) * (height, width)
    y, x = np.arange(height)[:, None], np.arange(width)
    hills = [np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * (width / 5) ** 2)) for a, b in centres]
    return with_images(source, source.series.images + 0.2 * (source.full - source.empty) * np.stack(hills))


@way("drift over ten tilts in the middle", "alignment", "specimen", "angles")
def _middle_drift(source: Source) -> TiltSeries:
    count = source.series.num_tilts
    return moved_across(source, np.interp(np.arange(count), (count // 2 - 5, count // 2 + 5), (0.0, 6.0)))


@way("half of the columns with another gain", "pattern", "lines", late=True)
def _half_gain(source: Source) -> TiltSeries:
    width = source.series.images.shape[2]
    return with_images(source, source.series.images * np.where(np.arange(width) < width // 2, 1.0, 0.8))


@way("angles of another series", "geometry", "angles", "range")
def _other_angles(source: Source) -> TiltSeries:
    return with_angles(source, np.linspace(-30, 70, source.series.num_tilts))


@way("angles sorted, images as taken from 0° outwards", "geometry", "angles", "specimen")
def _sorted_angles(source: Source) -> TiltSeries:
    order = np.argsort(np.abs(source.series.tilt_angles), kind="stable")
    return with_images(source, source.series.images[order])


@way("images shrunk by the cosine of the tilt", "geometry", "magnification", "angles")
def _cosine(source: Source) -> TiltSeries:
    factors = np.cos(np.deg2rad(source.series.tilt_angles))
    images = source.series.images
    return with_images(
        source,
        np.stack([scaled_about_middle(source, i, (1.0, f)) for i, f in zip(images, factors, strict=True)]),
    )


@way("the first half again in place of the second", "repeats", late=True)
def _half_again(source: Source) -> TiltSeries:
    images, half = source.series.images.copy(), source.series.num_tilts // 2
    images[-half:] = images[:half]
    return with_images(source, images)


@way("second half in reversed order", "geometry", "angles", "specimen")
def _half_reversed(source: Source) -> TiltSeries:
    images, half = source.series.images.copy(), source.series.num_tilts // 2
    images[half:] = images[half:][::-1]
    return with_images(source, images)


@way("bytes in the wrong order", "outliers", "noise", "mode", "saturation", late=True)
def _byte_order(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    whole = np.round(1000 * images / np.abs(images).max()).astype(np.int16)
    return TiltSeries(whole.byteswap(), source.series.tilt_angles, source.series.pixel_size, source.series.mode)


@way("each image with zero mean and unit deviation", "beam", "mode", late=True)
def _standardised(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    flat = images - images.mean((1, 2), keepdims=True)
    unit = flat / images.std((1, 2), keepdims=True)
    return TiltSeries(unit, source.series.tilt_angles, source.series.pixel_size, source.series.mode)


@way("frequencies above a quarter taken out", "resolution", "pattern", late=True)
def _low_pass(source: Source) -> TiltSeries:
    """Low-pass filter at a quarter of the Nyquist frequency."""
    images = source.series.images.astype(np.float32)
    spectrum = fft.fft2(images, axes=(1, 2))
    y, x = (np.abs(fft.fftfreq(size)) for size in images.shape[1:])
    spectrum[:, (y[:, None] > 0.125) | (x > 0.125)] = 0
    return with_images(source, fft.ifft2(spectrum, axes=(1, 2)).real)


@way("median of 5 × 5 pixels taken before", "resolution", "noise", late=True)
def _median(source: Source) -> TiltSeries:
    return with_images(source, ndimage.median_filter(source.series.images, (1, 5, 5)))


@way("one region black in all images", "lines", "saturation", "pattern", late=True)
def _black(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    height, width = images.shape[1:]
    images[:, height // 2 : height // 2 + height // 5, width // 2 : width // 2 + width // 5] = 0
    return with_images(source, images)


@way("one amplifier tap brighter in some tilts", "pattern", "lines", "beam", late=True)
def _tap(source: Source) -> TiltSeries:
    images, width = source.series.images.astype(np.float64), source.series.images.shape[2]
    span = abs(source.full - source.empty)
    images[::3, :, : width // 4] += 0.2 * span
    return with_images(source, images)


@way("dose that falls across the images", "pattern", late=True)
def _gradient(source: Source) -> Spoilt:
    width = source.series.images.shape[2]
    return Spoilt(with_images(source, source.series.images * np.linspace(1.0, 0.5, width)))
