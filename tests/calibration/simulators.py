"""Detectors and mishaps of known truth: what a calibration must measure, or flag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

Image = NDArray[np.float64]
GAIN, OFFSET, READ_NOISE, RATIO = 2.0, 100.0, 3.0, 16.0


@dataclass(frozen=True)
class Case:
    """Frames as `calibrate` takes them, and the gain (counts per electron, times the excess factor) behind them."""

    short: Image
    long: Image | None = None
    options: dict[str, Any] = field(default_factory=dict)
    gain: float = GAIN
    clean: bool = False


def random_scene(
    generator: np.random.Generator, size: int = 256, *, contrast: float = 0.6, mean: float = 80.0
) -> Image:
    """Electrons per pixel of a smooth random field with detail from 2 to 20 pixels, (size, size)."""
    shape = (size, size)
    layers = sum(blur * ndimage.gaussian_filter(generator.standard_normal(shape), blur) for blur in (2.0, 6.0, 20.0))
    return np.asarray(mean * np.exp(contrast * (layers - layers.mean()) / layers.std()))


def star_field(
    generator: np.random.Generator, size: int = 256, *, sky: float = 2.0, width: float = 1.2, bright: float = 2000.0
) -> Image:
    """Electrons per pixel of point sources, a few of them bright, blurred by `width` pixels on a sky, (size, size)."""
    number, (y, x) = size * size // 650, np.mgrid[:size, :size].astype(float)
    image = np.full((size, size), sky)
    flux = np.minimum(0.02 * bright / generator.random(number), 20 * bright) / (2 * np.pi * width**2)
    for height, at_x, at_y in zip(flux, *generator.uniform(0, size, (2, number)), strict=True):
        near = np.s_[max(int(at_y) - 8, 0) : int(at_y) + 9, max(int(at_x) - 8, 0) : int(at_x) + 9]
        image[near] += height * np.exp(-((x[near] - at_x) ** 2 + (y[near] - at_y) ** 2) / (2 * width**2))
    return image


def exposed(
    generator: np.random.Generator,
    electrons: Image,
    *,
    gain: float | Image = GAIN,
    offset: float | Image = OFFSET,
    read_noise: float | Image = READ_NOISE,
    rounded: bool = True,
    top: float = np.inf,
) -> Image:
    """Poisson-Gaussian pixel values, rounded and clipped to 0 ... top."""
    noise = read_noise * generator.standard_normal(electrons.shape)
    values = offset + gain * (generator.poisson(electrons) + noise)
    return np.asarray(np.round(values).clip(0, top) if rounded else values)


def multiplied(generator: np.random.Generator, electrons: Image, *, gain: float, offset: float, read: float) -> Image:
    """Pixel values of an electron-multiplying CCD: the register gives k electrons a gamma distribution of shape k."""
    counts = generator.poisson(electrons)
    charge = np.where(counts > 0, generator.gamma(np.maximum(counts, 1e-9), gain), 0.0)
    return np.round(offset + charge + read * generator.standard_normal(electrons.shape)).clip(0)


def counted_with_dead_time(generator: np.random.Generator, rate: Image, *, dead_time: float) -> Image:
    """Counts of a non-paralysable counter, `dead_time` as a share of the exposure, event by event."""
    counts, clock = np.zeros(rate.shape), np.zeros(rate.shape)
    running = np.ones(rate.shape, bool)
    while running.any():
        clock = clock + generator.exponential(1.0, rate.shape) / np.maximum(rate, 1e-12)
        running = clock < 1.0
        counts += running
        clock = np.where(running, clock + dead_time, 2.0)
    return counts


def photomultiplied(
    generator: np.random.Generator, electrons: Image, *, gain: float, shape: float, offset: float, read: float
) -> Image:
    """Pixel values of an integrating detector: each electron gives a pulse of gamma-distributed height of mean `gain`."""
    counts = generator.poisson(electrons)
    charge = np.where(counts > 0, generator.gamma(np.maximum(shape * counts, 1e-9), gain / shape), 0.0)
    return np.round(offset + charge + read * generator.standard_normal(electrons.shape))


def landau_pulse(gain: float, scale: float) -> Any:
    """Landau distribution of the energy of one electron, counts, cut off at its 2 % tail as the energy is; mean `gain`."""
    low, high = stats.landau.ppf([1e-6, 0.98])
    nodes = np.linspace(low, high, 20_001)
    below = (stats.landau.cdf(nodes) - stats.landau.cdf(low)) / (stats.landau.cdf(high) - stats.landau.cdf(low))
    mean = np.sum(np.diff(below) * (nodes[1:] + nodes[:-1]) / 2)
    return stats.rv_histogram((np.diff(below), gain + scale * (nodes - mean)), density=False)


def landau_straggled(
    generator: np.random.Generator, electrons: Image, *, gain: float, scale: float, offset: float, read: float
) -> Image:
    """Pixel values of a direct detector whose electrons deposit energies as `landau_pulse` says; `electrons` is flat."""
    counts = generator.poisson(electrons)
    pulses = landau_pulse(gain, scale).rvs(size=int(counts.sum()), random_state=generator)
    charge = np.bincount(np.repeat(np.arange(counts.size), counts), pulses, minlength=counts.size)
    return np.round(offset + charge + read * generator.standard_normal(counts.size))


def afterglow(image: Image, rest: float, *, axis: int = 1) -> Image:
    """A detector that still shows `rest` of the previous pixel along its fast axis."""
    from scipy.signal import lfilter

    start = rest * np.take(image, [0], axis=axis)
    return np.asarray(lfilter([1 - rest], [1, -rest], image, axis=axis, zi=start)[0])


def drifted(electrons: Image, pixels: int) -> Image:
    """A scene that moved along x by `pixels` during the exposure."""
    return np.asarray(
        np.mean(
            [
                ndimage.shift(electrons, (0, step), order=1, mode="wrap")
                for step in np.linspace(-pixels / 2, pixels / 2, 4 * pixels + 1)
            ],
            axis=0,
        )
    )


def pair(seed: int, spoil: Callable[[np.random.Generator, Image], tuple[Image, Image]], **options: Any) -> Case:
    """A pair made from one random scene."""
    generator = np.random.default_rng(seed)
    return Case(*spoil(generator, random_scene(generator)), options=options)


def clean(generator: np.random.Generator, scene: Image, **options: Any) -> tuple[Image, Image]:
    return exposed(generator, scene, **options), exposed(generator, RATIO * scene, **options)


def both(change: Callable[[Image], Image]) -> Callable[[np.random.Generator, Image], tuple[Image, Image]]:
    """The same change of both exposures after they were read."""

    def spoil(generator: np.random.Generator, scene: Image) -> tuple[Image, Image]:
        short, long = clean(generator, scene, rounded=False)
        return np.round(change(short)), np.round(change(long))

    return spoil


def long_of(change: Callable[[np.random.Generator, Image], Image]) -> Callable[..., tuple[Image, Image]]:
    """A change of the scene that only the long exposure saw."""
    return lambda g, scene: (exposed(g, scene), exposed(g, RATIO * change(g, scene)))


def moved_patch(generator: np.random.Generator, scene: Image) -> Image:
    """4 % of the area shows another place of the scene."""
    changed, side = scene.copy(), round(0.2 * len(scene))
    changed[60 : 60 + side, 80 : 80 + side] = np.roll(scene, 37, axis=0)[60 : 60 + side, 80 : 80 + side]
    return changed


def row_offsets(deviation: float) -> Callable[[np.random.Generator, Image], tuple[Image, Image]]:
    def spoil(generator: np.random.Generator, scene: Image) -> tuple[Image, Image]:
        return tuple(  # type: ignore[return-value]
            np.round(image + deviation * generator.standard_normal((len(scene), 1)))
            for image in clean(generator, scene, rounded=False)
        )

    return spoil


def scmos(generator: np.random.Generator, scene: Image, frames: int = 10) -> Image:
    """A burst of a camera whose pixels differ in gain, offset and read noise."""
    gain = GAIN * (1 + 0.05 * generator.standard_normal(scene.shape))
    offset = OFFSET + 3 * generator.standard_normal(scene.shape)
    read = 1.5 * generator.lognormal(0.0, 0.6, scene.shape)
    return np.stack([exposed(generator, scene, gain=gain, offset=offset, read_noise=read) for _ in range(frames)])


def resampled(image: Image) -> Image:
    return np.asarray(ndimage.zoom(image, 0.8, order=1))
