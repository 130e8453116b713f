"""The protein shell of a Zika virion, as a density computed from the atoms of Protein Data Bank entry 5IRE (CC0).

The included density was created by ``python -m recon.simulate.virion 5ire.pdb``: atoms of the asymmetric unit, weighted by
atomic number, are replicated by the 60 icosahedral operators (``REMARK 350 BIOMT``), binned to a grid of 6 Å and blurred.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
VOXEL_SIZE = 6.0
RADIUS = 250.0
"""Å; hardly any atom is further out."""
_ATOMIC_NUMBER = {"H": 1, "C": 6, "N": 7, "O": 8, "P": 15, "S": 16}


def density_of_atoms(
    path: str | Path, *, voxel_size: float = VOXEL_SIZE, radius: float = RADIUS, blur: float = 6.0
) -> Array:
    """The density of a capsid from its Protein Data Bank file.

    Args:
        path: file with ``ATOM`` records and ``REMARK 350 BIOMT`` operators.
        voxel_size: Å.
        radius: Å; half the edge of the cube.
        blur: standard deviation of the Gaussian blur, Å.

    Returns:
        (z, y, x) density between 0 and 1, with the middle voxel at the centre of the capsid.

    Raises:
        ValueError: the file has no atoms or no operators.
    """
    from scipy.ndimage import gaussian_filter

    positions, weights, operators = _read(Path(path).read_text())
    size = 2 * int(np.ceil(radius / voxel_size)) + 1
    edges = (np.arange(size + 1) - size / 2) * voxel_size
    total = np.zeros((size, size, size))
    for operator in operators:
        placed = positions @ operator[:, :3].T + operator[:, 3]
        total += np.histogramdd(placed[:, ::-1], bins=(edges, edges, edges), weights=weights)[0]
    smooth = gaussian_filter(total, blur / voxel_size)
    return np.asarray(np.clip(smooth / np.quantile(smooth[smooth > 0.05 * smooth.max()], 0.995), 0, 1))


def _read(text: str) -> tuple[Array, Array, Array]:
    atoms = [line for line in text.splitlines() if line.startswith("ATOM")]
    rows = [line.split()[4:8] for line in text.splitlines() if line.startswith("REMARK 350   BIOMT")]
    if not atoms or not rows or len(rows) % 3:
        raise ValueError(
            "a capsid needs ATOM records and REMARK 350 BIOMT operators with three rows each; give the .pdb file"
        )
    positions = np.array([[float(line[start : start + 8]) for start in (30, 38, 46)] for line in atoms])
    weights = np.array([_ATOMIC_NUMBER.get(line[76:78].strip() or line[13], 6) for line in atoms], dtype=float)
    return positions, weights, np.array(rows, dtype=float).reshape(-1, 3, 4)


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


if __name__ == "__main__":
    target = Path(__file__).parent / "data" / "zika" / "density.npz"
    levels = np.round(255 * density_of_atoms(sys.argv[1])).astype(np.uint8)
    np.savez_compressed(target, density=levels)
    print(f"{target}: {levels.shape}, {target.stat().st_size} bytes")
