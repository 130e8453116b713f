"""Tilt series that share no code with the library: scenes as functions of continuous coordinates, a pixel-driven projector of
subdivided voxels onto area-integrating detector pixels, and noise from NumPy's generators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

import recon

Array = NDArray[Any]
Density = Callable[[Array, Array, Array, np.random.Generator], Array]
SCENES: dict[str, Density] = {}
"""Name → density at points x, y, z (the field of view is −1 to 1 along each), for any generator of details."""
Noise = Callable[[Array, np.random.Generator], tuple[Array, float]]
RANGES = {
    "±60°/2°": np.arange(-60, 61, 2.0),
    "±70°/5°": np.arange(-70, 71, 5.0),
    "±50°/10°": np.arange(-50, 51, 10.0),
    "0…177°/3°": np.arange(0, 178, 3.0),
}
"""Name → tilt angles, degrees."""

_VOXEL_PARTS, _PIXEL_PARTS = 3, 4  # along each axis
_REACH = 1.5  # half width of the region that is projected, in half fields of view: beyond it a truncated object ends


def scene(density: Density) -> Density:
    SCENES[density.__name__] = density
    return density


def ball(x: Array, y: Array, z: Array, centre: Any, radius: float) -> Array:
    return np.asarray((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2 < radius**2)


def balls(x: Array, y: Array, z: Array, random: np.random.Generator, count: int, spread: Any, radii: Any) -> Array:
    found = np.zeros(x.shape, bool)
    for _ in range(count):
        found |= ball(x, y, z, random.uniform(-1, 1, 3) * spread, random.uniform(*radii))
    return found


@scene
def faceted_particle_on_film(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    turned = [0.8 * x - 0.6 * z, 0.9 * y + 0.43 * (0.6 * x + 0.8 * z), 0.9 * (0.6 * x + 0.8 * z) - 0.43 * y]
    largest = np.maximum.reduce([np.abs(each) for each in turned])
    particle = (sum(np.abs(each) for each in turned) < 0.7) & (largest < 0.45)
    film = (np.abs(z - 0.6) < 0.08) & (np.abs(x) < 0.95)
    return np.where(particle, 1.0, 0.15 * (film & (np.abs(y) < 2)))


@scene
def core_shell(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    shell, core = ball(x, y, z, (0.1, 0, -0.05), 0.6), ball(x, y, z, (0.15, 0.05, -0.1), 0.33)
    return np.where(core, 1.0, 0.4 * shell)


@scene
def gyroid(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    a, b, c = 5 * x, 5 * y, 5 * z
    wall = np.sin(a) * np.cos(b) + np.sin(b) * np.cos(c) + np.sin(c) * np.cos(a) > 0.2
    return np.asarray(0.7 * (wall & ball(x, y, z, (0, 0, 0), 0.8)))


@scene
def fibres(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    found = np.zeros(x.shape)
    for _ in range(9):
        along = random.normal(size=3)
        along /= np.linalg.norm(along)
        from_axis = [each - centre for each, centre in zip((x, y, z), random.uniform(-0.5, 0.5, 3), strict=True)]
        position = sum(each * part for each, part in zip(from_axis, along, strict=True))
        distance = sum((each - position * part) ** 2 for each, part in zip(from_axis, along, strict=True))
        found = np.where((distance < random.uniform(0.05, 0.1) ** 2) & ball(x, y, z, (0, 0, 0), 0.85), 0.8, found)
    return found


@scene
def vesicles_in_ice(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    found = 0.2 * ((np.abs(z) < 0.45) & (np.abs(x) < 1) & (np.abs(y) < 2))
    for _ in range(6):
        centre, radius = random.uniform(-1, 1, 3) * (0.75, 0.75, 0.15), random.uniform(0.15, 0.28)
        wall = ball(x, y, z, centre, radius) & ~ball(x, y, z, centre, radius - 0.07)
        found = np.where(wall, 0.45, found)
    return found


@scene
def beads(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    return 1.0 * balls(x, y, z, random, 14, 0.75, (0.07, 0.15))


@scene
def needle_with_precipitates(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    needle = x**2 + z**2 < (0.45 + 0.12 * y) ** 2
    return np.where(needle, 0.5 + 0.5 * balls(x, y, z, random, 12, (0.35, 0.9, 0.35), (0.06, 0.12)), 0.0)


@scene
def truncated_object(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    slab = (np.abs(z) < 0.3) & (np.abs(x) < 1.4)
    return np.where(slab, 0.3 + 0.4 * balls(x, y, z, random, 25, (1.3, 0.9, 0.25), (0.08, 0.2)), 0.0)


@scene
def tilted_slab(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    slab = (np.abs(0.94 * z - 0.34 * x) < 0.22) & (np.abs(0.94 * x + 0.34 * z) < 0.8) & (np.abs(y) < 0.85)
    return 0.8 * (slab & ~balls(x, y, z, random, 14, (0.7, 0.7, 0.3), (0.08, 0.16)))


@scene
def off_axis(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    box = (np.abs(x - 0.5) < 0.2) & (np.abs(y + 0.3) < 0.3) & (np.abs(z - 0.35) < 0.15)
    return 1.0 * box + 0.6 * ball(x, y, z, (0.45, 0.5, 0.4), 0.25)


@scene
def smooth_blobs(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    found = np.zeros(x.shape)
    for _ in range(8):
        centre, width = random.uniform(-0.5, 0.5, 3), random.uniform(0.12, 0.3)
        square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2
        found += random.uniform(0.3, 1) * np.exp(-square / (2 * width**2))
    return found


@scene
def text(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    letters = np.array([list(row) for row in ("###.###", ".#..#..", ".#..##.", ".#..#..", ".#..###")]) == "#"
    column, row = (np.floor((each + 0.7) / 0.2).astype(int) for each in (x, 1.4 * y))
    inside = (column >= 0) & (column < 7) & (row >= 0) & (row < 5) & (np.abs(z + 0.1) < 0.12)
    return np.asarray(0.9 * (inside & letters[row.clip(0, 4), column.clip(0, 6)]))


def poisson(counts: float, *, offset: float = 0.0, read_noise: float = 0.0) -> Noise:
    """Electron counts, `counts` in the brightest pixel, with a dark level and Gaussian read noise."""

    def noisy(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
        drawn = random.poisson(clean * counts).astype(float) + offset
        return drawn + random.normal(0, read_noise, clean.shape) if read_noise else drawn.astype(np.uint16), counts

    return noisy


def clipped(counts: float, offset: float, read_noise: float) -> Noise:
    def noise(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
        images = random.poisson(counts * clean) + random.normal(offset, read_noise, clean.shape)
        return images.round().clip(0), counts

    return noise


def scaled(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    images = random.poisson(40 * clean)
    return np.round(255 / images.max() * images).astype(np.uint8), 255 / images.max() * 40


def binned(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    return random.poisson(40 * clean, (4, *clean.shape)).mean(0), 40.0


def scan_noise(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    images = random.poisson(100 * clean) + random.normal(0, 2, clean.shape) + 20
    return images + random.normal(0, 3, (*clean.shape[:2], 1)), 100.0


def detector_blur(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    return ndimage.gaussian_filter(random.poisson(40 * clean).astype(float), (0, 0.8, 0.8)), 40.0


def eight_bits_with_gamma(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    images = (0.05 + 0.8 * clean + random.normal(0, 0.05, clean.shape)).clip(0, 1) ** 0.8
    return np.round(255 * images).astype(np.uint8), 0.8 * 255


def outliers(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    hit = random.random(clean.shape) < 0.02
    return random.poisson(60 * clean) + 5 + random.normal(0, 1, clean.shape) + hit * random.exponential(
        80, clean.shape
    ), 60.0


NOISES: dict[str, Noise] = {
    "Poisson 2": poisson(2),
    "Poisson 10": poisson(10),
    "Poisson 100": poisson(100),
    "Poisson 40, read noise": poisson(40, offset=10, read_noise=2),
    "scan noise": scan_noise,
    "detector blur": detector_blur,
    "8 bits, gamma": eight_bits_with_gamma,
    "outliers": outliers,
}
"""Name → noise: from clean images with a maximum of 1 to noisy images, and the detector units of that maximum."""


@dataclass(frozen=True)
class IndependentSeries:
    """A noisy tilt series and its truth.

    Attributes:
        series: the noisy series, linear mode.
        truth: (z, y, x) density in detector units per voxel, so that its line integrals are the clean images minus an offset.
        clean: (tilt, y, u) those line integrals.
    """

    series: recon.TiltSeries
    truth: Array
    clean: Array


def independent_series(
    name: str, noise: str | Noise, tilts: str | Array, *, size: int = 32, seed: int = 0
) -> IndependentSeries:
    """A scene with noise at tilts, each by name or given, in a cube of `size` voxels."""
    angles = RANGES[tilts] if isinstance(tilts, str) else np.asarray(tilts, float)
    clean, truth = _clean(name, tuple(angles), size, seed)
    peak = float(clean.max())
    images, unit = (NOISES[noise] if isinstance(noise, str) else noise)(clean / peak, np.random.default_rng(seed + 1))
    series = recon.TiltSeries(images, angles, mode="linear")
    return IndependentSeries(series, truth * unit / peak, clean * unit / peak)


@cache
def _clean(name: str, angles: tuple[float, ...], size: int, seed: int) -> tuple[Array, Array]:
    """Clean images (tilt, y, u) and density (z, y, x) of a scene."""
    return clean_and_truth(SCENES[name], np.array(angles), size, seed)


def clean_and_truth(
    scene: Density, angles: Array, size: int, seed: int, *, reach: float = _REACH
) -> tuple[Array, Array]:
    """Clean images (tilt, y, u) of a density that is projected up to `reach` half fields of view, and that in view (z, y, x)."""
    density, parts = _sampled(scene, size, seed, reach), _VOXEL_PARTS
    clean = np.stack([_project(density, size, np.deg2rad(angle)) for angle in angles])
    margin = (len(density) - size * parts) // 2
    seen = density[margin : margin + size * parts, :, margin : margin + size * parts]
    return clean, seen.reshape(size, parts, size, parts, size, parts).mean((1, 3, 5))


def _sampled(density: Density, size: int, seed: int, reach: float) -> Array:
    """The density at the centres of subdivided voxels, (z, y, x), beyond the field of view along z and x."""
    wide, high = round(size * reach) * _VOXEL_PARTS, size * _VOXEL_PARTS
    wide += (wide - high) % 2
    along, down = ((np.arange(count) + 0.5 - count / 2) * 2 / high for count in (wide, high))
    x, y, z = np.broadcast_arrays(along[None, None], down[None, :, None], along[:, None, None])
    return density(x, y, z, np.random.default_rng(seed)).astype(np.float32)


def _project(density: Array, size: int, theta: float) -> Array:
    """The image (y, u) at a tilt angle (radians): every part of a voxel falls on two neighbouring parts of pixels."""
    wide, high = density.shape[:2]
    centres = (np.arange(wide) + 0.5 - wide / 2) / _VOXEL_PARTS
    u = (centres[None] * np.cos(theta) + centres[:, None] * np.sin(theta)).reshape(-1)
    place = (u + size / 2) * _PIXEL_PARTS - 0.5
    first = np.floor(place).astype(int)
    rows, columns = np.concatenate([first, first + 1]), np.tile(np.arange(u.size), 2)
    weights = np.concatenate([first + 1 - place, place - first]) / _VOXEL_PARTS**2
    on = (rows >= 0) & (rows < size * _PIXEL_PARTS)
    matrix = sparse.csr_matrix(
        (weights[on], (rows[on] // _PIXEL_PARTS, columns[on])), shape=(size, u.size), dtype=np.float32
    )
    image = matrix @ density.transpose(0, 2, 1).reshape(u.size, high)
    return np.asarray(image.reshape(size, size, _VOXEL_PARTS).mean(2).T.astype(np.float64))
