"""Ways to spoil a good tilt series. Each is one function; what a verdict may rightly name as the reason stands beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from recon.metrics.comparison import project
from recon.series.tilt_series import Mode, TiltSeries

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


def _with(source: Source, images: Array) -> TiltSeries:
    return replace(source.series, images=np.ascontiguousarray(images).astype(source.series.images.dtype))


def _moved(source: Source, shifts: Array) -> TiltSeries:
    """Images moved by (tilt, (y, u)) pixels; vacuum comes in from outside."""
    moved = [
        ndimage.shift(image, shift, order=1, cval=source.empty)
        for image, shift in zip(source.series.images, shifts, strict=True)
    ]
    return _with(source, np.stack(moved))


def _turned(source: Source, degrees: float) -> TiltSeries:
    turned = [
        ndimage.rotate(image, degrees, reshape=False, order=1, cval=source.empty) for image in source.series.images
    ]
    return _with(source, np.stack(turned))


def _scaled_about_middle(source: Source, image: Array, factors: tuple[float, float]) -> Array:
    """An image magnified by (y, u) factors about its middle."""
    middle = (np.array(image.shape) - 1) / 2
    matrix = 1 / np.array(factors)
    offset = middle - matrix * middle
    return np.asarray(ndimage.affine_transform(image, matrix, offset, order=1, cval=source.empty))


def _across(source: Source, shifts: Array) -> TiltSeries:
    return _moved(source, np.stack([np.zeros(len(shifts)), shifts], 1))


def _angles(source: Source, angles: Array) -> TiltSeries:
    return replace(source.series, tilt_angles=angles)


@way("axis wrong by 90°", "geometry", "axis")
def _axis_90(source: Source) -> TiltSeries:
    return _with(source, source.series.images.transpose(0, 2, 1))


@way("axis wrong by 45°", "geometry", "axis")
def _axis_45(source: Source) -> TiltSeries:
    return _turned(source, 45)


@way("axis wrong by 10°", "geometry", "axis")
def _axis_10(source: Source) -> TiltSeries:
    return _turned(source, 10)


@way("axis wrong by 5°", "geometry", "axis")
def _axis_5(source: Source) -> TiltSeries:
    return _turned(source, -5)


@way("axis 5 pixels off the middle", "alignment")
def _axis_off(source: Source) -> TiltSeries:
    return _across(source, np.full(source.series.num_tilts, 5.0))


@way("shifts of 5 pixels", "alignment")
def _shifts_5(source: Source) -> TiltSeries:
    return _moved(source, source.generator.uniform(-5, 5, (source.series.num_tilts, 2)))


@way("shifts of 2 pixels", "alignment")
def _shifts_2(source: Source) -> TiltSeries:
    return _moved(source, source.generator.uniform(-2, 2, (source.series.num_tilts, 2)))


@way("shifts along the axis alone", "alignment")
def _shifts_y(source: Source) -> TiltSeries:
    shifts = source.generator.uniform(-4, 4, (source.series.num_tilts, 2))
    return _moved(source, shifts * (1, 0))


@way("drift of the specimen", "alignment", "specimen")
def _specimen_drift(source: Source) -> Spoilt:
    """Nearly the images of an object that lies elsewhere along the beam, by which a right volume is moved."""
    drift, sine = np.linspace(-6, 6, source.series.num_tilts), np.sin(np.deg2rad(source.series.tilt_angles))
    place = float((drift * sine).sum() / (sine**2).sum())
    return Spoilt(_across(source, drift), truth=np.asarray(ndimage.shift(source.truth, (place, 0, 0), order=1)))


@way("jump of the stage", "alignment", "specimen")
def _jump(source: Source) -> TiltSeries:
    return _across(source, np.where(np.arange(source.series.num_tilts) < source.series.num_tilts // 2, 0.0, 5.0))


@way("angles in reversed order")
def _reversed(source: Source) -> Spoilt:
    """The images of a mirrored and slightly turned object: right but for the handedness, which no image tells."""
    angles = source.series.tilt_angles[::-1].copy()
    offset = angles[0] + source.series.tilt_angles[0]
    mirrored = source.truth[::-1]
    return Spoilt(_angles(source, angles), truth=_turned_volume(mirrored, -offset))


@way("angles offset by 10°")
def _offset(source: Source) -> Spoilt:
    """The images of a turned object, right but for the orientation, which no image tells."""
    return Spoilt(_angles(source, source.series.tilt_angles + 10), truth=_turned_volume(source.truth, 10))


@way("angles scaled by 1.3", "geometry", "angles")
def _scaled(source: Source) -> TiltSeries:
    return _angles(source, source.series.tilt_angles * 1.3)


@way("angles scaled by 0.6", "geometry", "angles")
def _scaled_down(source: Source) -> TiltSeries:
    return _angles(source, source.series.tilt_angles * 0.6)


@way("angles in radians", "angles", "range")
def _radians(source: Source) -> TiltSeries:
    return _angles(source, np.deg2rad(source.series.tilt_angles))


@way("angles shuffled", "geometry", "angles")
def _shuffled(source: Source) -> TiltSeries:
    return _angles(source, source.generator.permutation(source.series.tilt_angles))


@way("angles without their sign", "geometry", "angles")
def _unsigned(source: Source) -> TiltSeries:
    angles = source.series.tilt_angles
    return _angles(source, np.abs(angles) + 1e-3 * (angles < 0))


@way("angles one tilt late beyond the middle", "geometry", "angles", "tilts", "specimen")
def _skipped(source: Source) -> TiltSeries:
    angles, step = source.series.tilt_angles, np.diff(source.series.tilt_angles).mean()
    return _angles(source, np.where(angles > 0, angles + 6 * step, angles))


@way("angles jittered by 5°", "geometry", "angles")
def _jittered(source: Source) -> TiltSeries:
    return _angles(source, source.series.tilt_angles + source.generator.normal(0, 5, source.series.num_tilts))


@way("wrong mode", "mode")
def _mode(source: Source) -> TiltSeries:
    other: Mode = "transmission" if source.series.mode == "linear" else "linear"
    return replace(source.series, mode=other)


@way("contrast inverted", "mode", late=True)
def _inverted(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    return _with(source, images.max() + images.min() - images)


@way("logarithm taken before", "mode", late=True)
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
    return _with(source, source.images(doubled[:, rows])[:, :, start : start + width])


@way("cropped to the left 60 %", "field", "alignment")
def _cropped(source: Source) -> TiltSeries:
    width = source.series.images.shape[2]
    return _with(source, source.series.images[:, :, : round(0.6 * width)])


@way("a quarter of the thickness", "thickness")
def _thin(source: Source) -> Spoilt:
    return Spoilt(source.series, thickness=source.truth.shape[0] // 4)


@way("half of the object moved", "specimen", "alignment")
def _half_moved(source: Source) -> TiltSeries:
    moved, width = source.truth.copy(), source.truth.shape[2]
    moved[:, :, : width // 2] = np.roll(moved[:, :, : width // 2], 6, axis=0)
    return _later(source, moved)


@way("object turned at half time", "geometry", "specimen", "angles")
def _object_turned(source: Source) -> TiltSeries:
    return _later(source, _turned_volume(source.truth, 15))


@way("object shrinks by 15 %", "geometry", "specimen", "magnification", "beam")
def _shrinks(source: Source) -> TiltSeries:
    count, images = source.series.num_tilts, source.series.images
    factors = np.linspace(1, 0.85, count)
    return _with(
        source, np.stack([_scaled_about_middle(source, i, (f, f)) for i, f in zip(images, factors, strict=True)])
    )


@way("two series spliced", "specimen")
def _spliced(source: Source) -> TiltSeries:
    return _later(source, source.other)


@way("every other tilt of another object", "specimen")
def _interleaved(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[1::2] = source.images(source.other)[1::2]
    return _with(source, images)


@way("two tilts swapped", "tilts", "angles")
def _swapped(source: Source) -> TiltSeries:
    images, count = source.series.images.copy(), source.series.num_tilts
    first, second = count // 5, 4 * count // 5
    images[[first, second]] = images[[second, first]]
    return _with(source, images)


@way("one tilt of another object", "tilts")
def _one_other(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    middle = source.series.num_tilts // 2
    images[middle] = source.images(source.other)[middle]
    return _with(source, images)


@way("half of the images upside down", "specimen", "alignment")
def _upside_down(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    half = source.series.num_tilts // 2
    images[half:] = images[half:, ::-1]
    return _with(source, images)


@way("beam drifts by 40 %", "beam")
def _beam_drift(source: Source) -> TiltSeries:
    beam = np.linspace(1.2, 0.8, source.series.num_tilts)
    return _with(source, source.series.images * beam[:, None, None])


@way("beam flickers by 20 %", "beam")
def _beam_flickers(source: Source) -> TiltSeries:
    beam = np.exp(source.generator.normal(0, 0.2, source.series.num_tilts))
    return _with(source, source.series.images * beam[:, None, None])


@way("offset changes from tilt to tilt", "beam")
def _offsets(source: Source) -> TiltSeries:
    span = abs(source.full - source.empty)
    offsets = source.generator.normal(0, 0.15 * span, source.series.num_tilts)
    return _with(source, source.series.images + offsets[:, None, None])


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
    return _with(source, images)


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
    return _with(source, flat.reshape(images.shape))


@way("pixels shuffled in half of the tilts", "tilts", "specimen", late=True)
def _half_noise(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images[1::2]:
        source.generator.shuffle(image.reshape(-1))
    return _with(source, images)


@way("gain pattern of 10 %", "pattern", late=True)
def _gain(source: Source) -> TiltSeries:
    gain = source.generator.normal(1, 0.1, source.series.images.shape[1:])
    return _with(source, source.series.images * gain)


@way("uneven illumination", "pattern", late=True)
def _vignette(source: Source) -> TiltSeries:
    _, height, width = source.series.images.shape
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)
    return _with(source, source.series.images * (1 - 0.2 * (y**2 + (x - 0.3) ** 2)))


@way("saturation", "saturation", late=True)
def _saturation(source: Source) -> TiltSeries:
    images = source.series.images
    if source.series.mode == "linear":
        return _with(source, np.minimum(images, 0.35 * source.full))
    return _with(source, np.maximum(images, source.empty - 0.35 * (source.empty - source.full)))


@way("overflow of the number type", "outliers", "saturation", late=True)
def _overflow(source: Source) -> TiltSeries:
    images = source.series.images
    limit = 0.6 * float(np.quantile(images, 0.999))
    return _with(source, np.where(images > limit, images - limit, images))


@way("half of the tilts rebinned", "geometry", "magnification", "resolution", late=True)
def _rebinned(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    half = source.series.num_tilts // 2
    for image in images[half:]:
        image[:] = _scaled_about_middle(source, image.astype(np.float64), (0.5, 0.5)).astype(image.dtype)
    return _with(source, images)


@way("half of the tilts out of focus", "resolution")
def _out_of_focus(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    images[images.shape[0] // 2 :] = ndimage.gaussian_filter(images[images.shape[0] // 2 :], (0, 3, 3))
    return _with(source, images)


@way("images stretched across the axis where tilted", "geometry", "magnification", "angles")
def _stretched(source: Source) -> TiltSeries:
    factors = 1 + 0.25 * np.abs(np.sin(np.deg2rad(source.series.tilt_angles)))
    images = source.series.images
    stretched = [_scaled_about_middle(source, i, (1.0, f)) for i, f in zip(images, factors, strict=True)]
    return _with(source, np.stack(stretched))


@way("missing rows", "lines", late=True)
def _missing_rows(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[:, :: max(4, images.shape[1] // 8)] = 0
    return _with(source, images)


@way("missing columns", "lines", late=True)
def _missing_columns(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    images[:, :, :: max(4, images.shape[2] // 6)] = 0
    return _with(source, images)


@way("rows displaced", "lines", "alignment")
def _rows_displaced(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images:
        for row in image:
            row[:] = np.roll(row, int(source.generator.integers(-4, 5)))
    return _with(source, images)


@way("bright spikes", "outliers", late=True)
def _spikes(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float32)
    hit = source.generator.random(images.shape) < 0.003
    return replace(source.series, images=np.where(hit, np.float32(30 * abs(images).max()), images))


@way("drift within every tilt", "resolution")
def _drift_within(source: Source) -> Spoilt:
    """Exposures blurred along u, the same at all tilts: the images of an object that is blurred across the axis."""
    images, moves = source.series.images.astype(np.float64), range(-3, 4)
    blurred = np.mean([ndimage.shift(images, (0, 0, by), order=1, cval=source.empty) for by in moves], axis=0)
    deviation = float(np.std(moves))
    return Spoilt(_with(source, blurred), truth=ndimage.gaussian_filter(source.truth, (deviation, 0, deviation)))


@way("half of the tilts with another gain", "beam", "specimen")
def _other_gain(source: Source) -> TiltSeries:
    gain = np.where(np.arange(source.series.num_tilts) < source.series.num_tilts // 2, 1.0, 1.5)
    return _with(source, source.series.images * gain[:, None, None])


@way("signs of a third of the angles flipped", "geometry", "angles", "specimen", "tilts")
def _signs(source: Source) -> TiltSeries:
    angles = source.series.tilt_angles.copy()
    angles[::3] = -angles[::3] + 1e-3
    return _angles(source, angles)


@way("blur that grows with the tilt", "resolution")
def _growing_blur(source: Source) -> TiltSeries:
    blurs = 3 * np.abs(np.sin(np.deg2rad(source.series.tilt_angles)))
    images = source.series.images.astype(np.float64)
    return _with(source, np.stack([ndimage.gaussian_filter(i, b) for i, b in zip(images, blurs, strict=True)]))


@way("half of the thickness", "thickness", "geometry")
def _half_thickness(source: Source) -> Spoilt:
    depth = source.truth.shape[0]
    return Spoilt(source.series, depth // 2, truth=source.truth[depth // 4 : depth // 4 + depth // 2])


@way("contrast inverted in a third of the tilts", "mode", "specimen", "tilts", "beam", late=True)
def _partly_inverted(source: Source) -> TiltSeries:
    images = source.series.images.astype(np.float64)
    images[::3] = images.max() + images.min() - images[::3]
    return _with(source, images)


@way("detector's response bent", "mode", "saturation")
def _bent(source: Source) -> TiltSeries:
    """The square root of the contrast: strong contrast counts for too little."""
    contrast = (source.series.images - source.empty) / (source.full - source.empty)
    return _with(source, source.empty + (source.full - source.empty) * np.sqrt(contrast.clip(0)))


@way("borders of zeros after an alignment", "field", "lines", "alignment", late=True)
def _zero_borders(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images:
        left, top = source.generator.integers(2, images.shape[2] // 5, 2)
        image[:, :left] = 0
        image[:top] = 0
    return _with(source, images)


@way("compressed by blocks of 8 pixels", "pattern", "residuals", late=True)
def _compressed(source: Source) -> TiltSeries:
    """The cosine transform of every block keeps its ten lowest frequencies, coarsely rounded, as a photograph's file does."""
    images = source.series.images.astype(np.float64)
    height, width = (8 * (size // 8) for size in images.shape[1:])
    blocks = images[:, :height, :width].reshape(len(images), height // 8, 8, width // 8, 8)
    step = 0.05 * 8 * abs(source.full - source.empty)
    spectrum = step * np.round(fft.dctn(blocks, axes=(2, 4), norm="ortho") / step)
    kept = np.add.outer(np.arange(8), np.arange(8))[:, None, :] < 4
    images[:, :height, :width] = fft.idctn(spectrum * kept, axes=(2, 4), norm="ortho").reshape(
        len(images), height, width
    )
    return _with(source, images)


@way("hot rows that come and go", "lines", "outliers", "pattern", late=True)
def _hot_rows(source: Source) -> TiltSeries:
    images = source.series.images.copy()
    for image in images:
        image[source.generator.integers(0, images.shape[1], 2)] = source.series.images.max()
    return _with(source, images)


@way("ten neighbouring tilts in reversed order", "geometry", "angles", "tilts", "specimen")
def _run_reversed(source: Source) -> TiltSeries:
    images, start = source.series.images.copy(), source.series.num_tilts // 2
    images[start : start + 10] = images[start : start + 10][::-1]
    return _with(source, images)


@way("images rotated more and more, up to 10°", "geometry", "axis", "specimen", "alignment")
def _rotating(source: Source) -> TiltSeries:
    degrees = np.linspace(-5, 5, source.series.num_tilts)
    images = source.series.images
    return _with(
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
    """A smooth hill, of a tenth of the contrast, that stays where it is for a few tilts and then lies elsewhere."""
    count, height, width = source.series.images.shape
    centres = source.generator.uniform(0.2, 0.8, (count, 2)) * (height, width)
    y, x = np.arange(height)[:, None], np.arange(width)
    hills = [np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * (width / 5) ** 2)) for a, b in centres]
    return _with(source, source.series.images + 0.2 * (source.full - source.empty) * np.stack(hills))


def _later(source: Source, volume: Array) -> TiltSeries:
    """From the middle of the series on, images of another volume."""
    images, half = source.series.images.copy(), source.series.num_tilts // 2
    images[half:] = source.images(volume, source.series.tilt_angles[half:])
    return _with(source, images)


def _turned_volume(volume: Array, degrees: float) -> Array:
    """A volume turned about the tilt axis so that its images at θ + `degrees` are those of the volume at θ."""
    theta, size = np.deg2rad(degrees), (np.array(volume.shape)[[0, 2]] - 1) / 2
    matrix = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    slices = [
        ndimage.affine_transform(volume[:, row], matrix, size - matrix @ size, order=1)
        for row in range(volume.shape[1])
    ]
    return np.stack(slices, 1)
