"""The density of a virion from its Protein Data Bank file, included as ``recon/data/zika/density.npz``.

python -m benchmarks.virion_density 5ire.pdb

Atoms of the asymmetric unit, weighted by atomic number, are replicated by the 60 icosahedral operators (``REMARK 350 BIOMT``),
binned to a grid of 6 Å and blurred.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.simulate.phantoms import RADIUS, VOXEL_SIZE

Array = NDArray[Any]

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


if __name__ == "__main__":
    target = Path(__file__).parents[1] / "recon" / "data" / "zika" / "density.npz"
    levels = np.round(255 * density_of_atoms(sys.argv[1])).astype(np.uint8)
    np.savez_compressed(target, density=levels)
    print(f"{target}: {levels.shape}, {target.stat().st_size} bytes")
