"""Unspoilt series that share neither scenes, projector nor noise with the other benchmarks, and real series.

Ellipsoids are projected by a formula; real and simulated series of other groups are those in the folder of data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from recon.series.files import read_tilt_series
from recon.series.masks import binned
from recon.series.prepare import prepare
from recon.series.tilt_series import Mode, TiltSeries

Array = NDArray[Any]
_PARTS = 3  # rays along each edge of a pixel
_MOST = 80  # pixels across: larger series are binned
TILTS = {
    "±65°/2.5°": np.arange(-65, 66, 2.5),
    "uneven ±60°": np.rad2deg(np.arctan(np.linspace(-1.73, 1.73, 45))),
    "0…178°/2°": np.arange(0, 179, 2.0),
}


def ellipsoids(count: int, largest: float, angles: Array, *, size: int, seed: int) -> Array:
    """(tilt, y, u) line integrals through ellipsoids of random size, direction and density, in half widths of the image."""
    random = np.random.default_rng(seed)
    place = (np.arange(size * _PARTS) + 0.5) * 2 / (size * _PARTS) - 1
    y, u = place[:, None], place
    images = np.zeros((len(angles), size * _PARTS, size * _PARTS))
    for _ in range(count):
        centre, radii = random.uniform(-0.5, 0.5, 3), largest * random.uniform(0.3, 1, 3)
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        shape, density = turn @ np.diag(radii**-2) @ turn.T, random.uniform(0.3, 1)
        for image, theta in zip(images, np.deg2rad(angles), strict=True):
            # coordinates (x, y, z); rays along the beam direction `along`, through the point `across`·u + y
            across, along = np.array([np.cos(theta), 0, np.sin(theta)]), np.array([-np.sin(theta), 0, np.cos(theta)])
            start = u[..., None] * across + y[..., None] * np.array([0.0, 1.0, 0.0]) - centre
            a, b = along @ shape @ along, start @ (shape @ along)
            inside = b**2 - a * (np.einsum("yui,ij,yuj->yu", start, shape, start) - 1)
            image += density * 2 * np.sqrt(inside.clip(0)) / a
    return np.asarray(images.reshape(len(angles), size, _PARTS, size, _PARTS).mean((2, 4)) * size / 2)


def _gain_register(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    """Counts that a gain register multiplies at random, as in an EMCCD."""
    electrons = random.poisson(30 * clean / clean.max())
    return 10 * random.standard_gamma(np.maximum(electrons, 1e-9)) + random.normal(100, 5, clean.shape), "linear"


def _flickering(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    """More scattered than Poisson noise: negative binomial counts."""
    mean = 50 * clean / clean.max() + 1
    return random.negative_binomial(20, 20 / (20 + mean)), "linear"


def _bright_field(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    return random.poisson(200 * np.exp(-1.5 * clean / clean.max())), "transmission"


def _long_tails(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    scale = 0.02 + 0.04 * clean / clean.max()
    return (clean / clean.max() + random.laplace(0, 1, clean.shape) * scale).astype(np.float32), "linear"


def gaussians(count: int, widest: float, angles: Array, *, size: int, seed: int) -> Array:
    """(tilt, y, u) line integrals through Gaussians of random shape, whose projections are Gaussians."""
    random = np.random.default_rng(seed)
    place = (np.arange(size) + 0.5) * 2 / size - 1
    images = np.zeros((len(angles), size, size))
    for _ in range(count):
        centre, widths = random.uniform(-0.45, 0.45, 3), widest * random.uniform(0.2, 1, 3)
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        spread, weight = turn @ np.diag(widths**2) @ turn.T, random.uniform(0.3, 1) * np.prod(widths)
        for image, theta in zip(images, np.deg2rad(angles), strict=True):
            seen = np.array([[np.cos(theta), 0, np.sin(theta)], [0.0, 1.0, 0.0]])  # u and y of (x, y, z)
            shape, middle = np.linalg.inv(seen @ spread @ seen.T), seen @ centre
            u, y = place - middle[0], (place - middle[1])[:, None]
            power = shape[0, 0] * u**2 + 2 * shape[0, 1] * u * y + shape[1, 1] * y**2
            image += weight * np.sqrt(np.linalg.det(shape)) * np.exp(-power / 2)
    return images * size / 2


def _in_bytes(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    """Whole numbers up to 255, with headroom."""
    noisy = 20 + 180 * clean / clean.max() + random.normal(0, 4, clean.shape)
    return np.round(noisy).clip(0, 255).astype(np.uint8), "linear"


def _few_counts(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    return random.poisson(4 * clean / clean.max()).astype(np.uint16), "linear"


def _thin(clean: Array, random: np.random.Generator) -> tuple[Array, Mode]:
    """Bright field of a thin object: a tenth of the beam at most."""
    return random.poisson(2000 * np.exp(-0.1 * clean / clean.max())), "transmission"


NOISES = (_gain_register, _flickering, _bright_field, _long_tails)


def _made(noise: Any, angles: Array, seed: int) -> TiltSeries:
    count, largest = ((12, 0.3), (4, 0.45), (30, 0.15))[seed % 3]
    clean = ellipsoids(count, largest, angles, size=(40, 48, 36)[seed % 3], seed=seed)
    images, mode = noise(clean, np.random.default_rng(1000 + seed))
    return TiltSeries(images, angles, mode=mode)


LATER_NOISES = (_in_bytes, _few_counts, _thin)
LATER_TILTS = {
    "-40…70°/2.5°": np.arange(-40, 71, 2.5),
    "dose-symmetric ±60°/3°": np.array([0.0, *(side * angle for angle in range(3, 61, 3) for side in (1, -1))]),
}


def _of_gaussians(noise: Any, angles: Array, seed: int) -> TiltSeries:
    count, widest = ((10, 0.2), (25, 0.1))[seed % 2]
    clean = gaussians(count, widest, angles, size=(44, 56, 64)[seed % 3], seed=2000 + seed)
    images, mode = noise(clean, np.random.default_rng(3000 + seed))
    return TiltSeries(images, angles, mode=mode)


def _small(series: TiltSeries) -> TiltSeries:
    """Binned to at most 80 pixels across."""
    by = -(-series.images.shape[2] // _MOST)
    return series if by == 1 else binned(series, by, by)


def _read(path: Path, *, mode: Mode) -> TiltSeries:
    return _small(read_tilt_series(path, mode=mode))


def _aligned(path: Path) -> TiltSeries:
    """A raw series, aligned by the library."""
    return prepare(_small(read_tilt_series(path, mode="linear")), refine_alignment=True).tilt_series


def tooth(path: Path, by: int = 8) -> TiltSeries:
    """X-ray projections divided by their flats, `by` pixels binned across; the axis is at column 296.5 of 640, so the left 594
    have it in their middle."""
    with h5py.File(path) as file:
        images, flats, darks = (
            np.asarray(file[f"exchange/{name}"], float) for name in ("data", "data_white", "data_dark")
        )
        angles = np.linspace(0, 180, len(images), endpoint=False)
    dark = darks.mean(0)
    transmitted = (images - dark) / (flats.mean(0) - dark)
    return binned(TiltSeries(transmitted[:, :, :594], angles, mode="transmission"), 1, by)


def _silicon(path: Path) -> TiltSeries:
    images = loadmat(path)["Trunc_projections_forBM3D"].transpose(2, 1, 0)
    return _small(TiltSeries(images, np.arange(0.0, 178, 3), mode="linear"))


def _with_counts(series: TiltSeries, counts: float) -> TiltSeries:
    images = series.images.astype(float) - float(series.images.min())
    noisy = np.random.default_rng(0).poisson(counts * images / images.max())
    return replace(series, images=noisy)


def other_series(data: Path | None) -> dict[str, Callable[[], TiltSeries]]:
    """Name → series; those of other groups only where their folder of data is given."""
    found: dict[str, Callable[[], TiltSeries]] = {}
    for seed, (noise, tilts) in enumerate((noise, tilts) for noise in NOISES for tilts in TILTS):
        name = f"ellipsoids, {noise.__name__[1:].replace('_', ' ')}, {tilts}"
        found[name] = partial(_made, noise, TILTS[tilts], seed)
    for seed, (noise, tilts) in enumerate((noise, tilts) for noise in LATER_NOISES for tilts in LATER_TILTS):
        name = f"Gaussians, {noise.__name__[1:].replace('_', ' ')}, {tilts}"
        found[name] = partial(_of_gaussians, noise, LATER_TILTS[tilts], seed)
    if data is None:
        return found
    found["tooth"] = partial(tooth, data / "flatdark_tooth" / "tooth.h5")
    found["needle of 256 pixels, raw"] = partial(_aligned, data / "tilt_needle_256" / "needle_256_raw.mrc")
    needle = data / "tilt_needle" / "needle_aligned.mrc"
    found["needle"] = partial(_read, needle, mode="linear")
    found["needle, every second tilt"] = lambda: _read(needle, mode="linear").select(slice(None, None, 2))
    found["needle, ±60°"] = lambda: _read(needle, mode="linear").select(slice(15, 76))
    for counts in (10, 100):
        found[f"needle, Poisson {counts}"] = partial(lambda n: _with_counts(_read(needle, mode="linear"), n), counts)
    for path in sorted((data / "tilt_silicon_simulated").glob("aSi_*.mat")):
        found[f"silicon, {path.stem.split('_')[2]}"] = partial(_silicon, path)
    return found
