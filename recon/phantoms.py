"""Volumes whose truth is known. Shapes do not depend on the size, and edges are covered in proportion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def shells(size: int, *, generator: np.random.Generator, count: int = 22) -> Array:
    """Randomly placed ellipsoidal shells of random density, about 93 % vacuum, as in Kniesel et al. (CVPR 2022).

    Args:
        size: voxels along each edge.
        generator: source of places, shapes and densities.
        count: how many shells.

    Returns:
        (z, y, x) density of order one, zero outside the sphere that touches the faces.
    """
    volume = np.zeros((size, size, size), np.float32)
    for _ in range(count):
        axes = generator.uniform(0.1, 0.34, 3)
        centre, rotation = _place(generator, axes.max()), _rotation(generator)
        thickness, density = generator.uniform(0.03, 0.07), generator.uniform(0.3, 1.0)
        shell = _ellipsoid(size, centre, axes, rotation) - _ellipsoid(size, centre, axes - thickness, rotation)
        volume = np.maximum(volume, np.float32(density) * shell)
    return volume


def virions(size: int, *, generator: np.random.Generator, count: int = 5) -> Array:
    """Spheres of a dense coat with spikes, a membrane and a thin core. Arguments and result as `shells`."""
    volume = np.zeros((size, size, size), np.float32)
    for _ in range(count):
        radius, identity = generator.uniform(0.18, 0.27), np.eye(3)
        centre = _place(generator, radius + 0.04)
        for outer, thickness, density in ((1.0, 0.12, 0.8), (0.78, 0.09, 0.5), (0.6, 0.6, 0.2)):
            shell = _ellipsoid(size, centre, np.full(3, outer * radius), identity)
            if thickness < outer:
                shell = shell - _ellipsoid(size, centre, np.full(3, (outer - thickness) * radius), identity)
            volume = np.maximum(volume, np.float32(density) * shell)
        for direction in (_rotation(generator) @ _fibonacci_sphere(32)).T:
            spike = _ellipsoid(size, centre + direction * radius * 1.04, np.full(3, 0.028), identity)
            volume = np.maximum(volume, spike)
    return volume


def filaments(size: int, *, generator: np.random.Generator, count: int = 10) -> Array:
    """Long curved tubes of different thickness. Arguments and result as `shells`."""
    volume = np.zeros((size, size, size), np.float32)
    for _ in range(count):
        point, heading = _place(generator, 0.1), _direction(generator)
        radius, density = generator.uniform(0.025, 0.05), generator.uniform(0.4, 1.0)
        for _ in range(int(1.6 / radius)):
            if np.linalg.norm(point) > 0.95 - radius:
                heading = -point / np.linalg.norm(point) + 0.5 * _direction(generator)
            heading = heading + 0.12 * _direction(generator)
            heading /= np.linalg.norm(heading)
            point = point + 0.7 * radius * heading
            bead = _ellipsoid(size, point, np.full(3, radius), np.eye(3))
            volume = np.maximum(volume, np.float32(density) * bead)
    return volume


def particles(size: int, *, generator: np.random.Generator, count: int = 60) -> Array:
    """Compact dense particles of many sizes. Arguments and result as `shells`."""
    volume = np.zeros((size, size, size), np.float32)
    for _ in range(count):
        axes = generator.uniform(0.03, 0.13) * generator.uniform(0.7, 1.3, 3)
        particle = _ellipsoid(size, _place(generator, axes.max()), axes, _rotation(generator))
        volume = np.maximum(volume, np.float32(generator.uniform(0.4, 1.0)) * particle)
    return volume


def slab(size: int, *, generator: np.random.Generator, count: int = 120) -> Array:
    """A dense section without vacuum, 40 % of the depth: a matrix with pores, vesicles and grains. As `shells`."""
    depth = np.abs((np.arange(size) + 0.5) * 2 / size - 1)
    inside = np.clip(0.5 + (0.4 - depth) * size / 2, 0, 1).astype(np.float32)[:, None, None]
    volume = np.full((size, size, size), 0.4, np.float32)
    for _ in range(count):
        axes = generator.uniform(0.05, 0.2) * generator.uniform(0.7, 1.3, 3)
        centre = generator.uniform(-1, 1, 3) * (0.4, 1, 1)
        shape = _ellipsoid(size, centre, axes, _rotation(generator))
        volume += shape * (np.float32(generator.choice([0.1, 0.7, 1.0])) - volume)
    return np.asarray(volume * inside)


PHANTOMS: dict[str, Callable[..., Array]] = {
    "shells": shells,
    "virions": virions,
    "filaments": filaments,
    "particles": particles,
    "slab": slab,
}


def make_phantom(name: str, size: int, *, generator: np.random.Generator) -> Array:
    """The phantom of a name, (z, y, x).

    Raises:
        ValueError: unknown name, or a size that is too small to draw anything.
    """
    if name not in PHANTOMS:
        raise ValueError(f"phantom '{name}': choose one of {', '.join(PHANTOMS)}")
    if size < 8:
        raise ValueError(f"size {size} is too small for a phantom; use at least 8 voxels")
    return PHANTOMS[name](size, generator=generator)


def _direction(generator: np.random.Generator) -> NDArray[Any]:
    vector = generator.normal(size=3)
    unit: NDArray[Any] = vector / np.linalg.norm(vector)
    return unit


def _place(generator: np.random.Generator, radius: float) -> NDArray[Any]:
    """A centre at which a ball of this radius stays inside the sphere that touches the faces."""
    place: NDArray[Any] = _direction(generator) * (0.95 - radius) * generator.uniform() ** (1 / 3)
    return place


def _rotation(generator: np.random.Generator) -> NDArray[Any]:
    return np.asarray(np.linalg.qr(generator.normal(size=(3, 3)))[0])


def _fibonacci_sphere(count: int) -> NDArray[Any]:
    """(3, count) nearly even directions."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([height, across * np.cos(turn), across * np.sin(turn)])


def _ellipsoid(size: int, centre: NDArray[Any], axes: NDArray[Any], rotation: NDArray[Any]) -> Array:
    """The covered share of each voxel, the cube being [-1, 1]³."""
    volume = np.zeros((size, size, size), np.float32)
    reach = axes.max() + 2 / size
    box = tuple(
        slice(max(0, int((middle - reach + 1) / 2 * size)), max(0, int(np.ceil((middle + reach + 1) / 2 * size))))
        for middle in centre
    )
    z, y, x = (
        ((np.arange(size) + 0.5) * 2 / size - 1)[part] - middle for part, middle in zip(box, centre, strict=True)
    )
    squared, slope = (np.zeros((z.size, y.size, x.size), np.float32) for _ in range(2))
    for column, length in zip((rotation / axes).astype(np.float32).T, axes, strict=True):
        along = (z[:, None, None] * column[0] + y[:, None] * column[1] + x * column[2]).astype(np.float32)
        squared += along**2
        slope += (along / np.float32(length)) ** 2
    radius, slope = np.sqrt(squared), np.sqrt(slope)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(slope > 0, (radius - 1) * radius / slope, -1)  # (ρ − 1) / |∇ρ|, to first order
    volume[box] = np.clip(0.5 - distance * (size / 2), 0, 1)
    return volume
