"""Phantoms. Shapes do not depend on the number of voxels, and edges are antialiased.

Every phantom can be drawn as a whole or a few y-slices at a time, with identical voxels. The protein shell of a Zika virion is a
density computed from the atoms of Protein Data Bank entry 5IRE (CC0); in a checkout, ``python -m benchmarks.virion_density
5ire.pdb`` creates it.
"""

from collections.abc import Callable
from functools import lru_cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

Array = NDArray[np.float32]
VOXEL_SIZE = 6.0
RADIUS = 250.0
"""Å; hardly any atom is further out."""


def zika_in_box(places: tuple[NDArray[Any], ...], radius: float, rotation: NDArray[Any]) -> NDArray[np.float32]:
    """The density of the virion at points of a regular grid.

    Args:
        places: coordinates (z, y, x) relative to its centre, which broadcast with each other, in the unit of `radius`.
        rotation: (3, 3) orthogonal; a reflection is converted to a rotation, to preserve the handedness.

    Returns:
        Density between 0 and 1, zero outside the virion.
    """
    spacing = float(places[2][1] - places[2][0]) if places[2].size > 1 else 0.0
    density = _shipped(round(spacing / radius * RADIUS / VOXEL_SIZE, 2))
    proper = rotation * np.sign(np.linalg.det(rotation))
    scale = RADIUS / radius / VOXEL_SIZE
    inside = [sum(axis * place for axis, place in zip(column, places, strict=True)) * scale for column in proper.T]
    middle = (density.shape[0] - 1) / 2
    return np.asarray(map_coordinates(density, [axis + middle for axis in inside], order=1, cval=0.0), dtype=np.float32)


@lru_cache(maxsize=8)
def _shipped(voxels: float) -> NDArray[np.float32]:
    """The included density, smoothed for sampling at steps of `voxels` of its voxels."""
    with (
        as_file(files("recon") / "data" / "zika" / "density.npz") as path,
        np.load(path, allow_pickle=False) as archive,
    ):
        density = archive["density"].astype(np.float32) / 255
    return np.asarray(gaussian_filter(density, 0.5 * max(0.0, voxels**2 - 1) ** 0.5))


class Canvas:
    """The y-slices `rows` of a cube [-1, 1]³ of `size` voxels along each edge.

    Args:
        size: voxels along each edge.
        rows: y-slices to draw, all by default.
    """

    def __init__(self, size: int, rows: slice | None = None) -> None:
        self.size = size
        self.rows = range(size)[slice(None) if rows is None else rows]
        self.volume = np.zeros((size, len(self.rows), size), np.float32)

    def window(self, centre: NDArray[Any], reach: float) -> tuple[tuple[slice, ...], tuple[NDArray[Any], ...]]:
        """The region of `volume` within `reach` of a centre, and its coordinates (z, y, x) relative to the centre."""
        low = np.maximum(0, ((centre - reach + 1) / 2 * self.size).astype(int))
        high = np.clip(np.ceil((centre + reach + 1) / 2 * self.size).astype(int), low, self.size)
        first, last = (int(np.clip(end, self.rows.start, self.rows.stop)) for end in (low[1], high[1]))
        low[1], high[1] = first, last
        places = [
            ((np.arange(*span) + 0.5) * 2 / self.size - 1) - c
            for span, c in zip(zip(low, high, strict=True), centre, strict=True)
        ]
        z, y, x = (slice(start, stop) for start, stop in zip(low, high, strict=True))
        y = slice(first - self.rows.start, last - self.rows.start)
        return (z, y, x), (places[0][:, None, None], places[1][:, None], places[2])

    def covered(self, places: tuple[NDArray[Any], ...], axes: NDArray[Any], rotation: NDArray[Any]) -> Array:
        """The share of each voxel inside an ellipsoid around the origin of `places`."""
        z, y, x = places
        squared, slope = (np.zeros(np.broadcast_shapes(z.shape, y.shape, x.shape), np.float32) for _ in range(2))
        for column, length in zip((rotation / axes).astype(np.float32).T, axes, strict=True):
            along = (z * column[0] + y * column[1] + x * column[2]).astype(np.float32)
            squared += along**2
            slope += (along / np.float32(length)) ** 2
        radius, slope = np.sqrt(squared), np.sqrt(slope)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(slope > 0, (radius - 1) * radius / slope, -1)  # (ρ − 1) / |∇ρ|, to first order
        return np.clip(0.5 - distance * (self.size / 2), 0, 1).astype(np.float32)

    def put(
        self,
        density: float,
        centre: NDArray[Any],
        axes: NDArray[Any],
        rotation: NDArray[Any],
        *,
        hollow: NDArray[Any] | None = None,
    ) -> None:
        """Draw an ellipsoid where it is denser than the existing volume; `hollow` are the semi-axes of the space inside it."""
        box, places = self.window(centre, axes.max() + 2 / self.size)
        shape = self.covered(places, axes, rotation)
        if hollow is not None:
            shape = shape - self.covered(places, hollow, rotation)
        self.volume[box] = np.maximum(self.volume[box], np.float32(density) * shape)

    def ball(self, density: float, centre: NDArray[Any], radius: float, *, hollow: float | None = None) -> None:
        """Draw a ball, or a spherical shell with inner radius `hollow`."""
        inside = None if hollow is None else np.full(3, hollow)
        self.put(density, centre, np.full(3, radius), np.eye(3), hollow=inside)


def shells(canvas: Canvas, generator: np.random.Generator, count: int = 22) -> None:
    """Randomly placed ellipsoidal shells of random density, about 93 % vacuum, as in Kniesel et al. (CVPR 2022)."""
    for _ in range(count):
        axes = generator.uniform(0.1, 0.34, 3)
        centre, rotation = _place(generator, axes.max()), _rotation(generator)
        thickness, density = generator.uniform(0.03, 0.07), generator.uniform(0.3, 1.0)
        canvas.put(density, centre, axes, rotation, hollow=axes - thickness)


def virions(canvas: Canvas, generator: np.random.Generator, count: int = 5) -> None:
    """Zika virions; with voxels coarser than 15 Å, spheres with spikes, coat, membrane and core."""
    for _ in range(count):
        radius = generator.uniform(0.18, 0.27)
        _put_virion(canvas, _place(generator, radius + 0.04), radius, _rotation(generator))


def _put_virion(
    canvas: Canvas, centre: NDArray[Any], radius: float, rotation: NDArray[Any], *, fewest: int = 32
) -> None:
    """Draw a virion; of `fewest` voxels or more in diameter, because coarser ones do not resolve its density, known to 15 Å."""
    if radius * canvas.size >= fewest:
        box, places = canvas.window(centre, 1.05 * radius)
        canvas.volume[box] = np.maximum(canvas.volume[box], zika_in_box(places, radius, rotation))
        return
    canvas.ball(0.8, centre, radius, hollow=0.88 * radius)
    canvas.ball(0.5, centre, 0.78 * radius, hollow=0.69 * radius)
    canvas.ball(0.2, centre, 0.6 * radius)
    for direction in (rotation @ _fibonacci_sphere(32)).T:
        canvas.ball(1.0, centre + direction * radius * 1.04, min(0.028, 0.155 * radius))


def cell(canvas: Canvas, generator: np.random.Generator, count: int = 18) -> None:
    """Shells with small virions among them, as in the synthetic data of Kniesel et al. (CVPR 2022)."""
    shells(canvas, generator, count)
    for _ in range(count // 2):
        radius = generator.uniform(0.07, 0.11)
        _put_virion(canvas, _place(generator, radius), radius, _rotation(generator))


def filaments(canvas: Canvas, generator: np.random.Generator, count: int = 10) -> None:
    """Long curved tubes of different thickness."""
    for _ in range(count):
        point, heading = _place(generator, 0.1), _direction(generator)
        radius, density = generator.uniform(0.025, 0.05), generator.uniform(0.4, 1.0)
        for _ in range(int(1.6 / radius)):
            if np.linalg.norm(point) > 0.95 - radius:
                heading = -point / np.linalg.norm(point) + 0.5 * _direction(generator)
            heading = heading + 0.12 * _direction(generator)
            heading /= np.linalg.norm(heading)
            point = point + 0.7 * radius * heading
            canvas.ball(density, point, radius)


def particles(canvas: Canvas, generator: np.random.Generator, count: int = 60) -> None:
    """Compact dense particles of many sizes."""
    for _ in range(count):
        axes = generator.uniform(0.03, 0.13) * generator.uniform(0.7, 1.3, 3)
        centre, rotation = _place(generator, axes.max()), _rotation(generator)
        canvas.put(generator.uniform(0.4, 1.0), centre, axes, rotation)


def slab(canvas: Canvas, generator: np.random.Generator, count: int = 120) -> None:
    """A dense section without vacuum, 40 % of the depth: a matrix with pores, vesicles and grains."""
    depth = np.abs((np.arange(canvas.size) + 0.5) * 2 / canvas.size - 1)
    inside = np.clip(0.5 + (0.4 - depth) * canvas.size / 2, 0, 1).astype(np.float32)[:, None, None]
    canvas.volume += np.float32(0.4)
    for _ in range(count):
        axes = generator.uniform(0.05, 0.2) * generator.uniform(0.7, 1.3, 3)
        centre = generator.uniform(-1, 1, 3) * (0.4, 1, 1)
        rotation, density = _rotation(generator), np.float32(generator.choice([0.1, 0.7, 1.0]))
        box, places = canvas.window(centre, axes.max() + 2 / canvas.size)
        canvas.volume[box] += canvas.covered(places, axes, rotation) * (density - canvas.volume[box])
    canvas.volume *= inside


def atoms(
    canvas: Canvas, generator: np.random.Generator, count: int = 300, *, width: float = 0.035, apart: float = 0.13
) -> None:
    """A particle at atomic resolution: Gaussians at random sites, about four voxels of 64 or more `apart` and one wide, so that
    neighbours are resolved."""
    sites: list[NDArray[Any]] = []
    for _ in range(20 * count):
        site = 0.75 * _place(generator, 0.05)
        if len(sites) < count and all(np.linalg.norm(site - other) > apart for other in sites):
            sites.append(site)
    for site in sites:
        height = generator.uniform(0.5, 1.0)
        box, (z, y, x) = canvas.window(site, 4 * width)
        canvas.volume[box] += (height * np.exp(-(z**2 + y**2 + x**2) / (2 * width**2))).astype(np.float32)


def texture(canvas: Canvas, generator: np.random.Generator, count: int = 40) -> None:
    """A body with a density gradient and a texture of `count` waves, without internal edges."""
    box, places = canvas.window(np.zeros(3), 0.9)
    body = canvas.covered(places, np.array([0.55, 0.85, 0.8]), np.eye(3))
    shade = 0.5 + 0.3 * places[2] + 0.3 * _waves(places, generator, count, longest=0.5, shortest=0.15)
    canvas.volume[box] = body * np.clip(shade, 0.05, 1).astype(np.float32)


def catalyst(canvas: Canvas, generator: np.random.Generator, count: int = 40) -> None:
    """A porous support of curved walls with `count` small dense particles on it."""
    box, places = canvas.window(np.zeros(3), 0.9)
    body = canvas.covered(places, np.array([0.7, 0.85, 0.8]), np.eye(3))
    waves = _waves(places, generator, 60, longest=0.8, shortest=0.5)
    # around the zeros of the waves: a sponge with one connected wall
    walls = np.clip(0.5 + (0.3 - np.abs(waves)) * 3, 0, 1)
    canvas.volume[box] = (0.4 * body * walls).astype(np.float32)
    for _ in range(count):
        radius = generator.uniform(0.03, 0.06)
        canvas.ball(1.0, 0.75 * _place(generator, radius), radius)


def _waves(
    places: tuple[NDArray[Any], ...], generator: np.random.Generator, count: int, *, longest: float, shortest: float
) -> NDArray[Any]:
    """Sum of plane waves with random directions and phases, variance 1; wavelengths in half-edges of the cube."""
    z, y, x = places
    total = np.zeros(np.broadcast_shapes(z.shape, y.shape, x.shape))
    for _ in range(count):
        kz, ky, kx = 2 * np.pi / generator.uniform(shortest, longest) * _direction(generator)
        total += np.cos(z * kz + y * ky + x * kx + generator.uniform(0, 2 * np.pi))
    return np.asarray(total * np.sqrt(2 / count))


_DRAWN = (shells, virions, cell, filaments, particles, slab, atoms, texture, catalyst)
PHANTOMS: dict[str, Callable[..., None]] = {draw.__name__: draw for draw in _DRAWN}


def make_phantom(
    name: str, size: int, *, generator: np.random.Generator, rows: slice | None = None, **settings: int
) -> Array:
    """Create a phantom by name, (z, y, x), a density of order one; with `rows`, only these y-slices, with ``count``, this many
    objects. Raises ValueError if the name is unknown, or the size is too small."""
    if name not in PHANTOMS:
        raise ValueError(f"phantom '{name}': choose one of {', '.join(PHANTOMS)}")
    if size < 8:
        raise ValueError(f"size {size} is too small for a phantom; use at least 8 voxels")
    canvas = Canvas(size, rows)
    PHANTOMS[name](canvas, generator, **settings)
    return canvas.volume


def _direction(generator: np.random.Generator) -> NDArray[Any]:
    vector = generator.normal(size=3)
    return vector / np.linalg.norm(vector)


def _place(generator: np.random.Generator, radius: float) -> NDArray[Any]:
    """A random centre such that a ball of this radius is inside the sphere that touches the faces."""
    return np.asarray(_direction(generator) * (0.95 - radius) * generator.uniform() ** (1 / 3))


def _rotation(generator: np.random.Generator) -> NDArray[Any]:
    return np.asarray(np.linalg.qr(generator.normal(size=(3, 3)))[0])


def _fibonacci_sphere(count: int) -> NDArray[Any]:
    """(3, count) nearly uniformly distributed directions."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([height, across * np.cos(turn), across * np.sin(turn)])
