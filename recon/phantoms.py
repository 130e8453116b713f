"""Volumes whose truth is known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Volume3D = NDArray[np.float32]


def shells(size: int, *, generator: np.random.Generator, count: int = 22) -> Volume3D:
    """Randomly placed ellipsoidal shells of random density, about 93 % vacuum, as in Kniesel et al. (CVPR 2022).

    The shapes do not depend on `size`, and edges are covered in proportion, so sizes can be compared.

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
        direction = generator.normal(size=3)
        radius = (0.95 - axes.max()) * generator.uniform() ** (1 / 3)
        centre = direction / np.linalg.norm(direction) * radius
        rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
        thickness, density = generator.uniform(0.03, 0.07), generator.uniform(0.3, 1.0)
        outer = _ellipsoid(size, centre, axes, rotation)
        inner = _ellipsoid(size, centre, axes - thickness, rotation)
        volume = np.maximum(volume, np.float32(density) * (outer - inner))
    return volume


def _ellipsoid(size: int, centre: NDArray[Any], axes: NDArray[Any], rotation: NDArray[Any]) -> NDArray[np.float32]:
    """The covered share of each voxel, the cube being [-1, 1]³."""
    coordinate = ((np.arange(size) + 0.5) * 2 / size - 1).astype(np.float32)
    steps = [coordinate - np.float32(middle) for middle in centre]
    directions = (rotation / axes).astype(np.float32)
    squared = np.zeros((size, size, size), np.float32)
    slope = np.zeros_like(squared)
    for column, length in zip(directions.T, axes, strict=True):
        along = steps[0][:, None, None] * column[0] + steps[1][:, None] * column[1] + steps[2] * column[2]
        squared += along**2
        slope += (along / np.float32(length)) ** 2
    radius, slope = np.sqrt(squared), np.sqrt(slope)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(slope > 0, (radius - 1) * radius / slope, -1)  # (ρ − 1) / |∇ρ|, to first order
    return np.clip(0.5 - distance * (size / 2), 0, 1).astype(np.float32)


PHANTOMS = {"shells": shells}


def make_phantom(name: str, size: int, *, generator: np.random.Generator) -> Volume3D:
    """The phantom of a name.

    Raises:
        ValueError: unknown name, or a size that is too small to draw anything.
    """
    if name not in PHANTOMS:
        raise ValueError(f"phantom '{name}': choose one of {', '.join(PHANTOMS)}")
    if size < 8:
        raise ValueError(f"size {size} is too small for a phantom; use at least 8 voxels")
    return PHANTOMS[name](size, generator=generator)
