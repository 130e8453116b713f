"""A volume of any height, block of slices by block: memory for one block."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.files import reserve
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

Images = NDArray[np.float32]
Solve = Callable[[slice], tuple[Images, Images]]
"""``solve(rows)`` reconstructs some slices: their part of the volume (z, rows, x) and of the projections (tilt, rows, u)."""

HALO = 6
"""Slices on either side of a block that a fit sees and does not keep, so that the regulariser sees across the border."""

SETTLED_ON = 32
"""Slices on which what all blocks share is settled."""


def solve_in_blocks(
    solve: Solve, tilt_series: TiltSeries, grid: VolumeGrid, scratch: Path, slices_at_once: int
) -> tuple[Volume, Images]:
    """Reconstruct block by block.

    Args:
        solve: reconstructs some slices.
        tilt_series: the images; a memory-mapped array will do.
        grid: of the whole volume.
        scratch: a new ``.npy`` file that holds the volume.
        slices_at_once: slices of a block.

    Returns:
        The volume, mapped to memory, and the projections (tilt, y, u), in a file that is gone when they are let go of.

    Raises:
        OSError: the disk has no room for the volume.
    """
    volume = np.lib.format.open_memmap(scratch, "w+", np.float32, grid.shape)
    reserve(scratch, scratch.stat().st_size)
    with tempfile.TemporaryFile(dir=scratch.parent) as file:
        projections = np.memmap(file, np.float32, "w+", shape=tilt_series.images.shape)
    for rows in blocks(grid.height, slices_at_once):
        volume[:, rows], projections[:, rows] = solve(rows)
        volume.flush()
    return Volume(volume, grid.voxel_size), projections


def blocks(height: int, slices_at_once: int) -> Iterator[slice]:
    """Neighbouring slices, so many at a time."""
    yield from (slice(start, min(start + slices_at_once, height)) for start in range(0, height, slices_at_once))


def with_halo(rows: slice, height: int) -> tuple[slice, slice]:
    """Some slices with their halo, and where they lie in it."""
    wide = slice(max(0, rows.start - HALO), min(height, rows.stop + HALO))
    return wide, slice(rows.start - wide.start, rows.stop - wide.start)


def block_memory(
    tilt_series: TiltSeries, grid: VolumeGrid, slices_at_once: int, *, fitted: bool
) -> tuple[TiltSeries, VolumeGrid]:
    """What is in memory at a time, for `recon.scale.memory.needed_memory`: one block of the series and of the grid."""
    rows = min(grid.height, max(slices_at_once + 2 * HALO, SETTLED_ON) if fitted else slices_at_once)
    return tilt_series.rows(slice(0, rows)), replace(grid, height=rows)
