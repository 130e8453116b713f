"""Exposures as they come: clean ones, and ones whose noise or scene breaks what a calibration assumes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy import ndimage

from . import simulators as sim
from .simulators import RATIO, Case, both, clean, exposed, long_of, pair

Maker = Callable[[int], Case]


def _blur(sigma: float) -> Callable[[sim.Image], sim.Image]:
    return lambda image: np.asarray(ndimage.gaussian_filter(image, sigma))


def _emccd(seed: int, *, dark: bool) -> Case:
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator, mean=15.0)
    setting = {"gain": 75.0, "offset": 500.0, "read": 30.0}
    short, long = (sim.multiplied(generator, times * scene, **setting) for times in (1, RATIO))
    darks = np.stack([sim.multiplied(generator, 0 * scene, **setting) for _ in range(4)])
    return Case(short, long, {"dark": darks} if dark else {}, gain=150.0)


def _integrating(seed: int, *, rest: float, deviation: float) -> Case:
    """A photomultiplier that scans: pulses of random height, afterglow of `rest` along x, an offset of each row."""
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator)
    exposures = []
    for times in (1, RATIO):
        image = sim.photomultiplied(generator, times * scene, gain=10.0, shape=4.0, offset=100.0, read=3.0)
        glowing = sim.afterglow(image, rest) if rest else image
        exposures.append(np.round(glowing + deviation * generator.standard_normal((len(scene), 1))))
    return Case(*exposures, gain=10.0 * (1 + 1 / 4))


def _gain_error(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    short, long = clean(generator, scene)
    return short, np.round(long - 4e-6 * np.maximum(long - 100, 0) ** 2)


def _soft_saturation(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """A full well at twice the mean signal, with read noise after it."""
    well = 1.5 * scene.mean()
    filled = np.minimum(generator.poisson(scene), well)
    return np.round(100 + 2 * (filled + 3 * generator.standard_normal(scene.shape))), exposed(generator, RATIO * scene)


def _jpeg(image: sim.Image) -> sim.Image:
    from scipy.fft import dctn, idctn

    blocks = image.reshape(len(image) // 8, 8, -1, 8).swapaxes(1, 2)
    found = dctn(blocks, axes=(2, 3), norm="ortho")
    weight = 4.0 * (1 + np.add.outer(np.arange(8), np.arange(8)))
    return np.asarray(
        idctn(np.round(found / weight) * weight, axes=(2, 3), norm="ortho").swapaxes(1, 2).reshape(image.shape)
    )


def _vignette_moved(generator: np.random.Generator, scene: sim.Image) -> sim.Image:
    y, x = np.indices(scene.shape) / len(scene) - 0.5
    return np.asarray(scene * (1 + 0.3 * x + 0.2 * y))


def _common_mode(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """Interference: a faint sine across both frames, at another phase in each."""
    y, x = np.indices(scene.shape)
    wave = [12 * np.sin(0.9 * x + 0.2 * y + phase) for phase in (0.0, 2.0)]
    return tuple(np.round(a + b) for a, b in zip(clean(generator, scene), wave, strict=True))  # type: ignore[return-value]


def _lanczos(factor: float) -> Callable[[sim.Image], sim.Image]:
    """Resampled as image editors do it, by OpenCV's Lanczos kernel of eight pixels."""
    import cv2

    return lambda image: np.asarray(
        cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_LANCZOS4)  # type: ignore[call-overload]
    )


def _turned(order: int) -> Callable[[sim.Image], sim.Image]:
    """Turned by 7° in software, and cropped to what is covered."""
    return lambda image: np.asarray(ndimage.rotate(image, 7.0, reshape=False, order=order)[24:-24, 24:-24])


def _hot(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """One pixel in a hundred has 50 to 500 electrons of dark current in the short exposure."""
    dark = np.where(generator.random(scene.shape) < 0.01, generator.uniform(50, 500, scene.shape), 0.0)
    return exposed(generator, scene + dark), exposed(generator, RATIO * (scene + dark))


def corner_full(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """A beam so bright in one corner that the long exposure clips there."""
    y, x = np.indices(scene.shape) / len(scene)
    lit = scene * (1 + 6 * np.exp(-8 * (x**2 + y**2)))
    return exposed(generator, lit), exposed(generator, RATIO * lit, top=8000.0)


def bent(power: float, *, before: bool = False) -> Maker:
    """A response ∝ light^power, of local gain 2·power at the mean, with read noise after it, or `before` it."""

    def spoil(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
        around = scene.mean()
        read = [6 * generator.standard_normal(scene.shape) for _ in range(2)]
        light = [
            generator.poisson(times * scene) + before * noise / 2 for times, noise in zip((1, RATIO), read, strict=True)
        ]
        counts = [2 * around * (np.maximum(one, 0) / around) ** power for one in light]
        return tuple(np.round(100 + one + (not before) * noise) for one, noise in zip(counts, read, strict=True))  # type: ignore[return-value]

    return lambda seed: replace(pair(seed, spoil), gain=2 * power)


def _hum(period: float) -> Callable[[np.random.Generator, sim.Image], tuple[sim.Image, sim.Image]]:
    """Mains hum: rows that rise and fall by 10 counts, at another phase in each exposure."""

    def spoil(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
        rows = 2 * np.pi * np.arange(len(scene))[:, None] / period
        short, long = clean(generator, scene, rounded=False)
        return np.round(short + 10 * np.sin(rows)), np.round(long + 10 * np.sin(rows + 2.0))

    return spoil


def _dark_subtracted(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """One noisy dark frame taken off both exposures."""
    short, long = clean(generator, scene)
    dark = exposed(generator, 0 * scene)
    return short - dark, long - dark


def _flat_divided(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """Both exposures less the offset, over a flat field that falls by a third to the corners."""
    y, x = np.indices(scene.shape) / len(scene) - 0.5
    flat = 1 - (x**2 + y**2) * 2 / 3
    flat /= flat.mean()
    short, long = clean(generator, scene * flat, rounded=False)
    return np.round((short - 100) / flat + 100), np.round((long - 100) / flat + 100)


def _flyback(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
    """A scan whose even lines lie 1.5 pixels off in the short exposure."""
    moved = scene.copy()
    moved[::2] = ndimage.shift(scene, (0, 1.5), order=3, mode="mirror")[::2]
    return exposed(generator, moved), exposed(generator, RATIO * scene)


def _real_jpeg(quality: int) -> Callable[[np.random.Generator, sim.Image], tuple[sim.Image, sim.Image]]:
    """8-bit frames that went through JPEG files."""
    import cv2

    def stored(image: sim.Image) -> sim.Image:
        _, data = cv2.imencode(
            ".jpg", np.round(image).clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
        )
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), float)

    def spoil(generator: np.random.Generator, scene: sim.Image) -> tuple[sim.Image, sim.Image]:
        short = exposed(generator, scene / 2, offset=20.0)
        return stored(short), stored(np.mean([exposed(generator, scene / 2, offset=20.0) for _ in range(16)], 0))

    return spoil


def _burst(
    seed: int,
    number: int,
    frame: Callable[[np.random.Generator, sim.Image], sim.Image],
    *,
    size: int = 128,
    **case: object,
) -> Case:
    """A burst of `number` equal exposures."""
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator, size)
    return replace(Case(np.stack([frame(generator, scene) for _ in range(number)])), **case)  # type: ignore[arg-type]


def counting_photons(generator: np.random.Generator, scene: sim.Image) -> sim.Image:
    """A camera that tells single electrons apart, at a dim scene."""
    return exposed(generator, scene / 16, gain=8.0, read_noise=0.27)


def joined(level: float) -> Callable[[np.random.Generator, sim.Image], sim.Image]:
    """Two converters, of 2 and 0.1 counts per electron and 1.5 and 30 e⁻ of read noise, joined at a brightness."""

    def read(generator: np.random.Generator, scene: sim.Image) -> sim.Image:
        electrons = generator.poisson(scene)
        fine, coarse = (electrons + noise * generator.standard_normal(scene.shape) for noise in (1.5, 30.0))
        bright = np.round(0.1 * coarse) / 0.1
        return np.asarray(np.round(100 + 2 * np.where(100 + 2 * fine < level, fine, bright)))

    return read


def jpeg2000(image: sim.Image, per_mille: int) -> sim.Image:
    """16-bit frames that went through JPEG 2000 files of a share of their size."""
    import cv2

    options = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, per_mille]
    _, data = cv2.imencode(".jp2", np.round(image).clip(0).astype(np.uint16), options)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), float)


def _lagging(seed: int) -> Case:
    """A burst of which each frame keeps 5 % of the one before."""
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator)
    kept, frames = generator.poisson(scene).astype(float), []
    for _ in range(8):
        kept = 0.95 * generator.poisson(scene) + 0.05 * kept
        frames.append(np.round(100 + 2 * (kept + 3 * generator.standard_normal(scene.shape))))
    return Case(np.stack(frames))


CASES: dict[str, Maker] = {
    "clean": lambda s: replace(pair(s, clean), clean=True),
    "clean, ratio known": lambda s: replace(pair(s, clean, exposure_ratio=RATIO), clean=True),
    "clean, low dose": lambda s: replace(pair(s, lambda g, x: clean(g, x / 20)), clean=True),
    "clean, shifted by 3.4 pixels": lambda s: replace(
        pair(s, lambda g, x: (exposed(g, x), exposed(g, RATIO * ndimage.shift(x, (1.3, 3.4), order=5, mode="mirror")))),
        clean=True,
    ),
    "clean burst of 6": lambda s: replace(
        pair(s, lambda g, x: (np.stack([exposed(g, x) for _ in range(6)]), None)),
        clean=True,  # type: ignore[arg-type,return-value]
    ),
    "both resampled × 0.8": lambda s: pair(s, both(sim.resampled)),
    "both resampled × 0.8, cubic": lambda s: pair(s, both(lambda image: np.asarray(ndimage.zoom(image, 0.8, order=3)))),
    "both binned 2 × 2 (mean)": lambda s: replace(
        pair(s, both(lambda image: image.reshape(128, 2, 128, 2).mean((1, 3)))), gain=0.5
    ),
    "afterglow 0.35 along x": lambda s: pair(s, both(lambda image: sim.afterglow(image, 0.35))),
    "afterglow 0.1 along y": lambda s: pair(s, both(lambda image: sim.afterglow(image, 0.1, axis=0))),
    "long drifted by 4 pixels": lambda s: pair(s, long_of(lambda g, x: sim.drifted(x, 4))),
    "long drifted by 2 pixels": lambda s: pair(s, long_of(lambda g, x: sim.drifted(x, 2))),
    "long drifted by 4 pixels, ratio known": lambda s: pair(
        s, long_of(lambda g, x: sim.drifted(x, 4)), exposure_ratio=RATIO
    ),
    "long blurred, 2 pixels": lambda s: pair(s, long_of(lambda g, x: _blur(2.0)(x))),
    "long blurred, 0.7 pixels": lambda s: pair(s, long_of(lambda g, x: _blur(0.7)(x))),
    "short blurred by optics, 1.5 pixels": lambda s: pair(
        s, lambda g, x: (exposed(g, _blur(1.5)(x)), exposed(g, RATIO * x))
    ),
    "4 % of the area moved": lambda s: pair(s, long_of(sim.moved_patch)),
    "illumination changed across the field": lambda s: pair(s, long_of(_vignette_moved)),
    "row offsets of 12": lambda s: pair(s, sim.row_offsets(12.0)),
    "row offsets of 3": lambda s: pair(s, sim.row_offsets(3.0)),
    "interference pattern": lambda s: pair(s, _common_mode),
    "sCMOS burst": lambda s: pair(s, lambda g, x: (sim.scmos(g, x), None)),  # type: ignore[arg-type,return-value]
    "both Gaussian-filtered, 0.8": lambda s: pair(s, both(_blur(0.8))),
    "both Gaussian-filtered, 0.4": lambda s: pair(s, both(_blur(0.4))),
    "both median-filtered 3 × 3": lambda s: pair(s, both(lambda image: np.asarray(ndimage.median_filter(image, 3)))),
    "both sharpened": lambda s: pair(s, both(lambda image: 1.8 * image - 0.8 * _blur(1.0)(image))),
    "both compressed (DCT)": lambda s: pair(s, both(_jpeg)),
    "long not linear": lambda s: pair(s, _gain_error),
    "full well below the converter's end": lambda s: pair(s, _soft_saturation),
    "EMCCD, gain × F² 150": lambda s: _emccd(s, dark=False),
    "EMCCD, gain × F² 150, darks": lambda s: _emccd(s, dark=True),
    "photomultiplier, gain × F² 12.5": lambda s: _integrating(s, rest=0.0, deviation=0.0),
    "photomultiplier, afterglow 0.3, row offsets": lambda s: _integrating(s, rest=0.3, deviation=20.0),
    "averaged short (4 frames), unknown": lambda s: replace(
        pair(s, lambda g, x: (np.round(np.mean([exposed(g, x) for _ in range(4)], 0)), exposed(g, RATIO * x))), gain=0.5
    ),
    "both resampled × 1.25, cubic": lambda s: pair(
        s, both(lambda image: np.asarray(ndimage.zoom(image, 1.25, order=3)))
    ),
    "both resampled × 0.8, Lanczos": lambda s: pair(s, both(_lanczos(0.8))),
    "both resampled × 1.25, Lanczos": lambda s: pair(s, both(_lanczos(1.25))),
    "both turned by 7°, linear": lambda s: pair(s, both(_turned(1))),
    "both turned by 7°, cubic": lambda s: pair(s, both(_turned(3))),
    "both as logarithms": lambda s: pair(s, both(lambda image: 1000 * np.log(image.clip(1)))),
    "both as square roots": lambda s: pair(s, both(lambda image: 64 * np.sqrt(image.clip(0)))),
    "JPEG, quality 95": lambda s: pair(s, _real_jpeg(95)),
    "JPEG, quality 75": lambda s: pair(s, _real_jpeg(75)),
    "a noisy dark frame subtracted": lambda s: pair(s, _dark_subtracted),
    "divided by a flat field": lambda s: pair(s, _flat_divided),
    "hot pixels, 1 %": lambda s: pair(s, _hot),
    "both averaged over 4 frames": lambda s: replace(
        pair(s, lambda g, x: tuple(np.mean([exposed(g, t * x) for _ in range(4)], 0) for t in (1, RATIO))),  # type: ignore[arg-type,return-value]
        gain=0.5,
    ),
    "short in electrons": lambda s: replace(
        pair(s, lambda g, x: ((exposed(g, x) - 100) / 2, exposed(g, RATIO * x))), gain=1.0
    ),
    "long in electrons": lambda s: pair(s, lambda g, x: (exposed(g, x), (exposed(g, RATIO * x) - 100) / 2)),
    "mains hum, 7.3 rows": lambda s: pair(s, _hum(7.3)),
    "mains hum, 60 rows": lambda s: pair(s, _hum(60.0)),
    "both binned 2 × 2 (sum)": lambda s: pair(s, both(lambda image: image.reshape(128, 2, 128, 2).sum((1, 3)))),
    "short median-filtered 3 × 3": lambda s: pair(
        s, lambda g, x: (np.asarray(ndimage.median_filter(exposed(g, x), 3)), exposed(g, RATIO * x))
    ),
    "two lowest bits missing": lambda s: pair(s, both(lambda image: 4 * np.floor(image / 4))),
    "lines of the short scan off by 1.5 pixels": lambda s: pair(s, _flyback),
    "exposures swapped": lambda s: pair(s, lambda g, x: clean(g, x)[::-1]),  # type: ignore[arg-type,return-value]
    "single electrons resolved": lambda s: replace(
        pair(s, lambda g, x: (counting_photons(g, x), counting_photons(g, RATIO * x))), gain=8.0, clean=True
    ),
    "burst of 8, single electrons resolved": lambda s: _burst(s, 8, counting_photons, gain=8.0, clean=True),
    "burst of 10, 4 electrons": lambda s: _burst(s, 10, lambda g, x: exposed(g, x / 20), clean=True),
    "burst of 8, noise as fine as the codes": lambda s: _burst(
        s, 8, lambda g, x: exposed(g, 8 * x, gain=0.05, offset=10.0), gain=0.05, clean=True
    ),
    "burst of 6, brightest tenth saturated": lambda s: _burst(
        s, 6, lambda g, x: exposed(g, x, top=np.round(100 + 2 * np.percentile(x, 90))), clean=True
    ),
    "burst of 8, image lag of 5 %": _lagging,
    "burst of 8, filtered by 0.3 pixels": lambda s: _burst(
        s, 8, lambda g, x: np.round(_blur(0.3)(exposed(g, x, rounded=False))), size=256
    ),
    "two converters joined at 800 counts": lambda s: pair(
        s, lambda g, x: (joined(800.0)(g, x), joined(800.0)(g, RATIO * x))
    ),
    "two converters joined at 300 counts": lambda s: pair(
        s, lambda g, x: (joined(300.0)(g, x), joined(300.0)(g, RATIO * x))
    ),
    "JPEG 2000, a third of the size": lambda s: pair(s, both(lambda image: jpeg2000(image, 300))),
    "JPEG 2000, a tenth of the size": lambda s: pair(s, both(lambda image: jpeg2000(image, 100))),
    "response light^0.9 after the read noise": bent(0.9, before=True),
    "gamma-encoded": lambda s: pair(s, both(lambda image: 255 * (image.clip(0) / 4000) ** 0.45)),
}


def cases() -> Iterator[tuple[str, Maker]]:
    yield from CASES.items()
