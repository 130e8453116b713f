"""A volume of any height, block of slices by block: memory for one block.

What all slices share is settled once, on a slab and a coarse volume of all of them. A block is fitted with a halo of slices that
its neighbours fit too; around each border one block fades into the next. A finished block is a file, which is never computed
twice, wherever and in whatever order blocks are computed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import atomic_path
from noiseflow.io.mapped import create_volume, finish_volume, let_go, temporary_map
from noiseflow.io.numpy_files import write as write_npy
from noiseflow.kept_memory import hand_back
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.uncertainty.result import error_bar_paths
from recon.uncertainty.shell_band import ShellPowers

if TYPE_CHECKING:
    from recon.reconstruction import Reconstruction

Images = NDArray[np.float32]

HALO = 12
"""Slices on either side of a block that a fit sees too. Of a slab of 128³ that fills the field, 32 slices in the middle lose 0.09
dB with 8 or 10 of them beside the whole volume, 0.04 with 4 or 14, and nothing with 12, 16 or 20."""

_FADE = 4  # slices on either side of a border; the outer half of the halo feels where its block ends
SETTLED_ON = 48
"""Slices on which what all blocks share is settled."""


@dataclass(frozen=True)
class Block:
    """Slices that are reconstructed together.

    Attributes:
        rows: the block's own.
        wide: these and their halo.
        height: slices of the whole volume.
        overlap: slices on either side of a border that belong to two blocks, and to no third.
    """

    rows: slice
    wide: slice
    height: int
    overlap: int

    def shares(self) -> Images:
        """(y,) how much of each `wide` slice is this block's, neighbours having the rest: the squares of all add up to one."""
        place = np.arange(self.wide.start, self.wide.stop) + 0.5
        found = np.ones(len(place), dtype=np.float32)
        for border, inward in ((self.rows.start, 1), (self.rows.stop, -1)):
            if self.overlap and 0 < border < self.height:
                found *= np.sin(np.pi / 4 * (1 + np.clip(inward * (place - border) / self.overlap, -1, 1)))
        return found


@dataclass(frozen=True)
class Blockwise:
    """A method that reconstructs slices apart.

    Attributes:
        solve: from the images of a block's `wide` slices to their part of the volume (z, y, x) and of the projections
            (tilt, y, u), and where `num_samples` says so of standard deviation and bias, and the table of `ShellPowers`.
        finish: makes the result of the whole volume and its projections.
        halo: slices that a block sees beyond its own.
        forget: called with every block that is kept, for what only an unfinished one wants.
        num_samples: that error bars come from; 0 for none.
    """

    solve: Callable[[TiltSeries, Block], tuple[Images, ...]]
    finish: Callable[[Volume, Images], Reconstruction]
    halo: int = 0
    forget: Callable[[Block], None] | None = None
    num_samples: int = 0


def blocks(height: int, slices_at_once: int, halo: int) -> list[Block]:
    """Blocks of nearly equal height, of so many slices at most."""
    count = -(-height // slices_at_once)
    ends = [round(number * height / count) for number in range(count + 1)]
    overlap = min(halo, int(np.diff(ends).min()) // 2)
    return [
        Block(slice(start, stop), slice(max(0, start - halo), min(height, stop + halo)), height, overlap)
        for start, stop in pairwise(ends)
    ]


def fitted_slices(height: int, slices_at_once: int) -> int:
    """Slices that are fitted where a volume is fitted in blocks: those with their halo, and what is settled first."""
    wide: int = sum(part.wide.stop - part.wide.start for part in blocks(height, slices_at_once, HALO))
    return wide + min(height, SETTLED_ON)


@dataclass(frozen=True)
class BlockFiles:
    """The finished blocks of one volume.

    Attributes:
        folder: theirs alone.
        error_bars: whether each has them.
    """

    folder: Path
    error_bars: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """What a block gives, one file each."""
        return ("volume", "projections", "std", "bias", "shells") if self.error_bars else ("volume", "projections")

    def finished(self, block: Block) -> bool:
        """Whether a block need not be computed again."""
        return self._path("projections", block).is_file()  # which is written last

    def write(self, block: Block, *arrays: Images) -> None:
        """Keep what a block gave, in the order of `names`; each file is whole or not there."""
        for name, array in sorted(zip(self.names, arrays, strict=True), key=lambda pair: pair[0] == "projections"):
            with atomic_path(self._path(name, block)) as partial:
                write_npy(partial, np.asarray(array, dtype=np.float32))

    def read(self, block: Block) -> list[Images]:
        """What has a value for each voxel or pixel, mapped to memory."""
        return [np.load(self._path(name, block), mmap_mode="r") for name in self.names if name != "shells"]

    def powers(self, parts: list[Block]) -> ShellPowers:
        """Of the whole volume and its samples, from those of all blocks."""
        tables = (np.load(self._path("shells", part)).astype(np.float64) for part in parts)
        return ShellPowers.of(np.sum(list(tables), axis=0))

    def _path(self, name: str, block: Block) -> Path:
        # by the block's own slices: those with the halo may be the same of two blocks of a low volume
        return self.folder / f"{name}-{block.rows.start:07d}-{block.rows.stop:07d}.npy"


def solve_block(method: Blockwise, tilt_series: TiltSeries, block: Block, files: BlockFiles) -> None:
    """Reconstruct one block, where that is not done."""
    if not files.finished(block):
        hand_back()  # after other blocks, or what was settled, whose arrays have other sizes: they would add up
        files.write(block, *method.solve(tilt_series.rows(block.wide), block))
        if method.forget is not None:
            method.forget(block)


def assemble(
    parts: list[Block], files: BlockFiles, tilt_series: TiltSeries, grid: VolumeGrid, scratch: Path
) -> tuple[Images, list[Volume]]:
    """The projections (tilt, y, u), in a file that is gone when they are let go of, and the volume in a new one; where blocks
    have error bars, standard deviation and bias follow in files beside it.

    Raises:
        OSError: the disk has no room for them.
    """
    size = grid.voxel_size
    voxel = None if size is None else (size, size, size)
    paths = [scratch, *(error_bar_paths(scratch).values() if files.error_bars else ())]
    volumes = [create_volume(path, grid.shape, voxel) for path in paths]
    projections = temporary_map(tilt_series.images.shape, np.float32, folder=scratch.parent)
    fade = min(_FADE, parts[0].overlap)
    for number, part in enumerate(parts):
        for target, found in zip((volumes[0], projections, *volumes[1:]), files.read(part), strict=True):
            first = part.rows.start + (fade if number else 0)
            stop = part.rows.stop + (fade if number < len(parts) - 1 else 0)
            if number and fade:
                _fade_in(target, found, part, fade)
            target[:, first:stop] = found[:, first - part.wide.start : stop - part.wide.start]
            let_go(target)
    for path, volume in zip(paths, volumes, strict=True):
        finish_volume(path, volume)
    return projections, [Volume(volume, size) for volume in volumes]


def _fade_in(target: Images, found: Images, block: Block, fade: int) -> None:
    """From the block below, which stands there already, to this one, about their border."""
    rows = slice(block.rows.start - fade, block.rows.start + fade)
    share = ((np.arange(2 * fade) + 0.5) / (2 * fade)).astype(np.float32)[:, None]
    above = found[:, rows.start - block.wide.start : rows.stop - block.wide.start]
    for below, new in zip(target[:, rows], above, strict=True):  # section by section: views of the target
        below += share * (new - below)


def block_memory(
    tilt_series: TiltSeries, grid: VolumeGrid, slices_at_once: int, *, fitted: bool
) -> tuple[TiltSeries, VolumeGrid]:
    """What is in memory at a time, for `recon.scale.memory.needed_memory`: one block of the series and of the grid."""
    rows = min(grid.height, max(slices_at_once + 2 * HALO, SETTLED_ON) if fitted else slices_at_once)
    return tilt_series.rows(slice(0, rows)), replace(grid, height=rows)
