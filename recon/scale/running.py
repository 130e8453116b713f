"""Execution of the blocks of a volume: sequentially in this process, or as tasks on a Dask cluster, and its client."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from noiseflow.installation import install_command
from noiseflow.io import atomic_path
from noiseflow.io.mapped import write as write_npy
from noiseflow.resources import SHARING, waiting
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Block, BlockFiles, Blockwise, assemble, blocks, solve_block
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.uncertainty.result import ShellBand, Uncertainty


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
_PATIENCE = 20  # s; a running scheduler answers within one


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
            client = dask.distributed.Client(scheduler, timeout=_PATIENCE, set_as_default=False)
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
