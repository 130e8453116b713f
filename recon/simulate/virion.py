"""The protein shell of a Zika virion, as a density computed from the atoms of Protein Data Bank entry 5IRE (CC0).

In a checkout, ``python -m benchmarks.virion_density 5ire.pdb`` creates the included density.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
VOXEL_SIZE = 6.0
RADIUS = 250.0
"""Å; hardly any atom is further out."""


def zika_in_box(places: tuple[Array, ...], radius: float, rotation: Array) -> NDArray[np.float32]:
    """The density of the virion at points of a regular grid.

    Args:
        places: coordinates (z, y, x) relative to its centre, which broadcast with each other, in the unit of `radius`.
        radius: radius of the virion.
        rotation: (3, 3) orthogonal; a reflection is converted to a rotation, to preserve the handedness.

    Returns:
        Density between 0 and 1, zero outside the virion.
    """
    from scipy.ndimage import map_coordinates

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
    from scipy.ndimage import gaussian_filter

    with (
        as_file(files("recon") / "data" / "zika" / "density.npz") as path,
        np.load(path, allow_pickle=False) as archive,
    ):
        density = archive["density"].astype(np.float32) / 255
    return np.asarray(gaussian_filter(density, 0.5 * max(0.0, voxels**2 - 1) ** 0.5))
