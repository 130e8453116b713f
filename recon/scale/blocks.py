"""Reconstruction of volumes of any height in blocks of slices, with the memory of one block, here or on a Dask cluster.

Choices for all slices are made once, on a slab and a coarse volume. A block is fitted with a halo of slices that overlaps its
neighbours; around each border the blocks are blended. A finished block is stored in a file and not computed again, independent of
where and in what order blocks are computed.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from noiseflow.installation import install_command
from noiseflow.io import atomic_path
from noiseflow.io.mapped import create_volume, finish_volume, let_go, temporary_map
from noiseflow.io.mapped import write as write_npy
from noiseflow.resources import SHARING, hand_back, waiting
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.uncertainty.measure import wedge_std
from recon.uncertainty.result import ShellBand, Uncertainty, error_bar_paths

Images = NDArray[np.float32]

HALO = 12
"""Halo: slices on each side of a block that are fitted too. For a slab of 128³ that fills the field, 32 slices in the middle lose
0.09 dB with a halo of 8 or 10 compared with the whole volume, 0.04 dB with 4 or 14, and nothing with 12, 16 or 20."""

SETTLED_ON = 32
"""Slices for the choices that all blocks share."""


@dataclass(frozen=True)
class Block:
    """Slices that are reconstructed together.

    Attributes:
        wide: slices of the block and its halo.
        overlap: slices on each side of a border that belong to exactly two blocks.
    """

    rows: slice
    wide: slice
    height: int
    overlap: int

    def shares(self) -> Images:
        """(y,) blending weight of each `wide` slice; the squared weights of all blocks sum to 1."""
        place = np.arange(self.wide.start, self.wide.stop) + 0.5
        found = np.ones(len(place), dtype=np.float32)
        for border, inward in ((self.rows.start, 1), (self.rows.stop, -1)):
            if self.overlap and 0 < border < self.height:
                found *= np.sin(np.pi / 4 * (1 + np.clip(inward * (place - border) / self.overlap, -1, 1)))
        return found


@dataclass(frozen=True)
class Blockwise:
    """A method that reconstructs blocks of slices independently.

    Attributes:
        solve: function from the images of a block's `wide` slices to their part of the volume (z, y, x) and of the projections
            (tilt, y, u), and, if `num_samples` is positive, of standard deviation and bias, and the powers of `ShellSums`.
        forget: called with every stored block, to remove the states of its fits.
        num_samples: number of posterior samples for error bars; 0 for none.
    """

    solve: Callable[[TiltSeries, Block], tuple[Images, ...]]
    finish: Callable[[Volume, Images], Reconstruction]
    halo: int = 0
    forget: Callable[[Block], None] | None = None
    num_samples: int = 0


def blocks(height: int, slices_at_once: int, halo: int) -> list[Block]:
    """Blocks of nearly equal height, with at most `slices_at_once` slices."""
    count = -(-height // slices_at_once)
    ends = [round(number * height / count) for number in range(count + 1)]
    overlap = min(halo, int(np.diff(ends).min()) // 2)
    return [
        Block(slice(start, stop), slice(max(0, start - halo), min(height, stop + halo)), height, overlap)
        for start, stop in pairwise(ends)
    ]


def fitted_slices(height: int, slices_at_once: int) -> int:
    """Total number of slices to fit for a volume in blocks, including halos and the slab for choices."""
    wide: int = sum(part.wide.stop - part.wide.start for part in blocks(height, slices_at_once, HALO))
    return wide + min(height, SETTLED_ON)


@dataclass(frozen=True)
class BlockFiles:
    """The finished blocks of one volume."""

    folder: Path
    error_bars: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the results of a block, one file each."""
        return ("volume", "projections", "std", "bias", "shells") if self.error_bars else ("volume", "projections")

    def finished(self, block: Block) -> bool:
        """Whether a block is complete."""
        return self._path("projections", block).is_file()  # written last

    def write(self, block: Block, *arrays: Images) -> None:
        """Store the results of a block, in the order of `names`; each file is written atomically."""
        for name, array in sorted(zip(self.names, arrays, strict=True), key=lambda pair: pair[0] == "projections"):
            with atomic_path(self._path(name, block)) as partial:
                write_npy(partial, np.asarray(array, dtype=np.float32))

    def read(self, block: Block) -> list[Images]:
        """The results with one value per voxel or pixel, memory-mapped."""
        return [np.load(self._path(name, block), mmap_mode="r") for name in self.names if name != "shells"]

    def powers(self, parts: list[Block]) -> NDArray[np.float64]:
        """Shell powers of the whole volume and its samples, from those of all blocks."""
        return np.asarray(sum(np.load(self._path("shells", part)).astype(np.float64) for part in parts))

    def _path(self, name: str, block: Block) -> Path:
        # named by the block's own slices; with halo, two blocks of a low volume may have the same slices
        return self.folder / f"{name}-{block.rows.start:07d}-{block.rows.stop:07d}.npy"


def solve_block(method: Blockwise, tilt_series: TiltSeries, block: Block, files: BlockFiles) -> None:
    """Reconstruct one block, unless it is complete."""
    if not files.finished(block):
        hand_back()  # earlier blocks and fits used arrays of other sizes; kept memory would accumulate
        files.write(block, *method.solve(tilt_series.rows(block.wide), block))
        if method.forget is not None:
            method.forget(block)


def assemble(
    parts: list[Block], files: BlockFiles, tilt_series: TiltSeries, grid: VolumeGrid, scratch: Path, *, fade: int = 4
) -> tuple[Images, list[Volume]]:
    """Combine the blocks. Return the projections (tilt, y, u), in a temporary file, and the volume in the file `scratch`. If
    blocks have error bars, their maps follow, in files next to it. Raises OSError if the disk does not have enough space.

    They are blended over `fade` slices on each side of a border: the outer half of the halo is affected by the end of the block.
    """
    size = grid.voxel_size
    voxel = None if size is None else (size, size, size)
    paths = [scratch, *(error_bar_paths(scratch).values() if files.error_bars else ())]
    volumes = [create_volume(path, grid.shape, voxel) for path in paths]
    projections = temporary_map(tilt_series.images.shape, np.float32, folder=scratch.parent, in_memory=0)
    fade = min(fade, parts[0].overlap)
    for number, part in enumerate(parts):
        for target, found in zip((volumes[0], projections, *volumes[1:-1]), files.read(part), strict=True):
            first = part.rows.start + (fade if number else 0)
            stop = part.rows.stop + (fade if number < len(parts) - 1 else 0)
            if number and fade:
                _fade_in(target, found, part, fade)
            target[:, first:stop] = found[:, first - part.wide.start : stop - part.wide.start]
            let_go(target)
    if files.error_bars:
        wedge_std(volumes[0], volumes[1], volumes[2], tilt_series.tilt_angles, out=volumes[3])
    for path, volume in zip(paths, volumes, strict=True):
        finish_volume(path, volume)
    return projections, [Volume(volume, size) for volume in volumes]


def _fade_in(target: Images, found: Images, block: Block, fade: int) -> None:
    """Blend this block with the previous one, which is already in `target`, around their border."""
    rows = slice(block.rows.start - fade, block.rows.start + fade)
    share = ((np.arange(2 * fade) + 0.5) / (2 * fade)).astype(np.float32)[:, None]
    above = found[:, rows.start - block.wide.start : rows.stop - block.wide.start]
    for below, new in zip(target[:, rows], above, strict=True):  # section by section: views of the target
        below += share * (new - below)


def block_memory(
    tilt_series: TiltSeries, grid: VolumeGrid, slices_at_once: int, *, fitted: bool
) -> tuple[TiltSeries, VolumeGrid]:
    """The part of series and grid in memory at a time, one block, for `recon.scale.memory.needed_memory`."""
    rows = min(grid.height, max(slices_at_once + 2 * HALO, SETTLED_ON) if fitted else slices_at_once)
    return tilt_series.rows(slice(0, rows)), replace(grid, height=rows)


def reconstruct_in_blocks(
    method: Blockwise,
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    *,
    scratch: Path,
    folder: Path | None,
    slices_at_once: int,
    client: Any = None,
) -> Reconstruction:
    """Reconstruct a volume block by block. Raises OSError if the disk does not have enough space.

    Args:
        scratch: a new ``.npy`` or MRC file for the volume, which the result memory-maps; error bars are written next to it.
        folder: folder for finished blocks, from which existing ones are used; None to keep none.
        client: a Dask client whose workers have access to `folder`; None to compute in this process.
    """
    parts = blocks(grid.height, slices_at_once, method.halo)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    own = nullcontext(folder) if folder else tempfile.TemporaryDirectory(prefix=".blocks-", dir=scratch.parent)
    with own as kept:
        files = BlockFiles(Path(kept), error_bars=method.num_samples > 0)
        if client is None:
            for part in parts:
                solve_block(method, tilt_series, part, files)
        else:
            _on_cluster(client, method, tilt_series, parts, files)
        projections, (volume, *maps) = assemble(parts, files, tilt_series, grid, scratch)
        result = replace(method.finish(volume, projections), slices_at_once=slices_at_once)
        bars = (
            Uncertainty(maps[0], maps[1], maps[2], method.num_samples, ShellBand.of(files.powers(parts)))
            if maps
            else None
        )
        return replace(result, uncertainty=bars)


def _stored(tilt_series: TiltSeries, folder: Path) -> TiltSeries:
    """The series with only two rows of pixels, whose images and mask are in files of the folder, written unless they exist."""
    for name, array in (("series", tilt_series.images), ("mask", tilt_series.mask)):
        if array is not None and not (path := folder / f"{name}.npy").exists():
            with atomic_path(path) as partial:
                write_npy(partial, array)
    few = tilt_series.rows(slice(0, 2))
    return few.with_images(np.array(few.images), few.mask)


def _opened(few: TiltSeries, folder: Path) -> TiltSeries:
    """The memory-mapped series that `_stored` wrote. Raises FileNotFoundError if this machine cannot read the files."""
    try:
        images = np.load(folder / "series.npy", mmap_mode="r")
        return few.with_images(images, None if few.mask is None else np.load(folder / "mask.npy", mmap_mode="r"))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"a worker cannot read {folder}; write to a disk that all share") from error


def _on_cluster(client: Any, method: Blockwise, tilt_series: TiltSeries, parts: list[Block], files: BlockFiles) -> None:
    """Run blocks as tasks that write their own files, so that no large data is transferred and lost tasks are repeated."""
    import dask.distributed

    files = replace(files, folder=files.folder.absolute())
    source = _stored(tilt_series, files.folder)
    left = [part for part in parts if not files.finished(part)]
    shared = client.scatter(replace(method, finish=_no_result, forget=None), broadcast=True, hash=False)
    tasks = [client.submit(_solve_stored, shared, source, part, files, pure=False) for part in left]
    try:
        for task in dask.distributed.as_completed(tasks, loop=client.loop):
            _require_done(task)
    finally:
        client.cancel(tasks)


def _require_done(task: Any) -> None:
    """Raise the error of a task; ConnectionError, with an explanation, if its workers or the scheduler are lost."""
    from dask.distributed import CancelledError, KilledWorker

    try:
        task.result()
    except KilledWorker as error:
        raise ConnectionError(
            "all workers of a block died, of memory? Give fewer workers or --slices-at-once"
        ) from error
    except CancelledError as error:
        raise ConnectionError("the Dask scheduler is lost with all unfinished blocks; restart it and resume") from error


def _no_result(*_: Any) -> Any:
    raise RuntimeError("workers compute only blocks; the client assembles the result")


def _solve_stored(method: Blockwise, source: TiltSeries, block: Block, files: BlockFiles) -> None:
    with all_threads_of_worker() as threads:
        torch.set_num_threads(threads)
        solve_block(method, _opened(source, files.folder), block, files)


_ONE_AT_A_TIME = threading.Lock()


@contextmanager
def all_threads_of_worker() -> Iterator[int]:
    """Use all threads of this Dask worker for one task, because a second task would need its own memory. Yield their number."""
    import dask.distributed

    with _ONE_AT_A_TIME:
        yield max(1, dask.distributed.get_worker().state.nthreads)


def usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def client_of(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """Yield a ``dask.distributed.Client``, closed at the end; None if neither workers nor a scheduler are given. Raises
    ModuleNotFoundError if dask.distributed is not installed, and ConnectionError if no scheduler answers at this address.

    Args:
        workers: number of local processes, which share the cores of this machine.
        scheduler: address of a scheduler, ``tcp://HOST:PORT``.
    """
    if workers is None and scheduler is None:
        yield None
        return
    try:
        import dask.distributed
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"--workers needs dask.distributed: {install_command('distributed')}") from error
    if scheduler is not None:
        try:
            client = dask.distributed.Client(scheduler, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConnectionError(
                f"no Dask scheduler at {scheduler}; run `dask scheduler` there, or correct it"
            ) from error
        with client:
            yield client
        return
    options: dict[str, Any] = {"dashboard_address": None, "processes": True, "silence_logs": 50}
    if not waiting():
        options["env"] = SHARING
    threads = max(1, usable_cores() // (workers or 1))
    with (
        dask.distributed.LocalCluster(n_workers=workers, threads_per_worker=threads, **options) as cluster,
        dask.distributed.Client(cluster, set_as_default=False) as client,
    ):
        # while this process makes the choices for all blocks
        for worker in client.scheduler_info(-1)["workers"]:
            dask.distributed.fire_and_forget(
                client.submit(exec, "import recon.joint.joint", workers=[worker], pure=False)
            )
        yield client
