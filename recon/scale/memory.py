"""Memory and time that a reconstruction takes, and available memory."""

import math
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from noiseflow.described import bytes_in_words
from noiseflow.resources import num_threads
from recon.joint.plan import FitStage
from recon.projection.projector import SliceProjector
from recon.projection.tiles import slices_of_a_tile
from recon.scale.blocks import block_memory
from recon.series.tilt_series import TiltSeries, VolumeGrid

# bytes per voxel and per pixel of methods that fit a volume, and of others
_PER_VOXEL_AND_PIXEL = {True: (80, 65), False: (20, 16)}
_BASE = 450 * 2**20  # libraries, tables of likelihoods, batches of pixels: up to 440 MiB with volumes of 48³
PLENTY = 4 * 2**30
"""Bytes: a volume that needs more is reconstructed in blocks, with equal quality and nearly equal speed (at 256³, 55 s of CPU
time in four blocks, 48 s as a whole), so that 512³ leaves memory for other programs."""


def needed_memory(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    *,
    fitted: bool = True,
    more: int = 0,
    per_ray_step: int = 32,
    tile: float = 0.3,
) -> int:
    """Peak memory of a reconstruction, bytes, within about 20 % (measured for 48³ to 1000³ voxels).

    Args:
        fitted: whether a field is fitted, with optimiser moments and best state; otherwise SIRT or back-projection.
        more: bytes of the method or field that depend neither on the grid nor on the images.
        per_ray_step: bytes of the projector matrix for each step along a ray.
        tile: share of the matrix that each tile copies (`recon.projection.tiles`): 512³, shells and a full slab.
    """
    depth, height, width = grid.shape
    ray_steps = tilt_series.num_tilts * tilt_series.images.shape[2] * max(depth, width)
    per_voxel, per_pixel = _PER_VOXEL_AND_PIXEL[fitted]
    volume = depth * height * width
    tiles = math.ceil(height / slices_of_a_tile(height, width)) if fitted else 0
    matrices = per_ray_step * ray_steps * (1 + tile * tiles)
    return int(_BASE + more + per_voxel * volume + per_pixel * tilt_series.images.size + matrices)


def choose_slices(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    available: int,
    *,
    fitted: bool = True,
    more: int = 0,
    workers: int = 1,
    plenty: float = math.inf,
    most: float = 0.7,
    tallest: int = 64,
) -> int | None:
    """Number of slices per block that fits into memory, or None if the whole volume fits. Raises MemoryError if even a few
    slices do not fit.

    Args:
        plenty: largest memory of a whole volume, bytes, even if more is available.
        most: share of the free memory: the estimate is accurate within about 20 %, and mapped files need memory, too.
        tallest: higher blocks have less halo, but a step of 144 slices of 512² takes 2.1 times as long as one of 80.
    """
    room = int(most * available / workers)
    if workers == 1 and needed_memory(tilt_series, grid, fitted=fitted, more=more) <= min(room, plenty):
        return None
    tallest = min(tallest, -(-grid.height // workers))
    heights = range(tallest, 0, -1)
    blocks = {slices: block_memory(tilt_series, grid, slices, fitted=fitted) for slices in heights}
    needed = {slices: needed_memory(*block, fitted=fitted, more=more) for slices, block in blocks.items()}
    # half of the free memory, to leave some for other programs, unless blocks would be less than half as high
    for limit, fewest in ((available / workers / 2, tallest / 2), (room, 1)):
        fitting = [slices for slices in heights if needed[slices] <= limit and slices >= fewest]
        if fitting:
            return fitting[0]
    raise MemoryError(
        f"not even a few slices fit into {bytes_in_words(room)}; lower --thickness or --workers, or bin the images"
    )


def available_memory(device: Any = "cpu") -> int | None:
    """Memory available to this process on a device, bytes; None if unknown."""
    if torch.device(device).type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return int(free)
    limits = [] if (left := _group_available()) is None else [left]
    with suppress(OSError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        limits += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError, ValueError, AttributeError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(limits, default=None)


def require_memory(needed: int, device: Any = "cpu") -> str:
    """One line about required and available memory. Raises MemoryError if the memory does not suffice."""
    available = available_memory(device)
    if available is None:
        return f"memory: about {bytes_in_words(needed)} needed"
    if needed > available:
        raise MemoryError(
            f"this reconstruction needs about {bytes_in_words(needed)} of memory and {bytes_in_words(available)} are available; "
            "use --slices-at-once 32 (or fewer), or a smaller --thickness, or bin or crop the images"
        )
    return f"memory: about {bytes_in_words(needed)} needed, {bytes_in_words(available)} available"


def sampled_memory(shape: Sequence[int], voxel_size: float, own: float) -> int:
    """Bytes of a volume whose field is sampled with other voxels.

    Args:
        shape: voxels of the fit.
        voxel_size, own: edges of the new voxels, and of those of the fit, Å.

    Raises:
        ValueError: the size is not positive, or larger than the volume.
        MemoryError: the volume does not fit into memory.
    """
    extent = max(shape) * own
    if not 0 < voxel_size <= extent:
        raise ValueError(f"--voxel-size {voxel_size:g} must be positive and within the volume, {extent:g} Å")
    sizes = [max(1, math.floor(size * own / voxel_size)) for size in shape]
    # values before and after the change of their unit
    needed, available = 2 * torch.float32.itemsize * math.prod(sizes), available_memory()
    if available is not None and needed > available:
        raise MemoryError(
            f"--voxel-size {voxel_size:g}: {' x '.join(map(str, sizes))} voxels need about {bytes_in_words(needed)} of memory, "
            f"and {bytes_in_words(available)} are available; give larger voxels"
        )
    return needed


def _group_available(folder: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Memory left in the control group (for example of a container); cached file contents count as free."""
    try:
        limit, used, parts = (
            (folder / f"memory.{name}").read_text(encoding="ascii").split() for name in ("max", "current", "stat")
        )
        held = int(used[0]) - int(parts[parts.index("inactive_file") + 1])
        return None if limit[0] == "max" else int(limit[0]) - held
    except (OSError, ValueError):
        return None


def expected_seconds(
    stages: Sequence[FitStage],
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    slab_height: int,
    share: float = 1.0,
    num_slices: int | None = None,
    step_cost: float = 1.0,
    *,
    calls: float = 0.01,
    start: float = 4.0,
) -> float:
    """Expected run time of stages on an idle machine, in seconds, within about a factor of two.

    Args:
        share: share of voxels that are not skipped.
        step_cost: time of a step relative to that of grids, see `recon.Field`.
        num_slices: number of fitted slices, counting slices in two blocks twice; by default those of the volume.
        calls: seconds of each step, of the volume or of the noise (a batch of 4096 pixels), whatever the series: most of the time
            below 64³.
        start: seconds for the coarse reconstruction before the first stage, and the checks after the last.
    """
    num_slices = grid.height if num_slices is None else num_slices
    # a constant part (likelihood, interpolation, regulariser), and one for the occupied voxels, both in projections of a slice:
    # shells of 256³, occupied share 0.13, take 0.7; a slab of 512³ that fills the field 1.5
    slice_step = step_cost * (0.5 + share) * _seconds_of_a_slice(tilt_series, grid)

    def seconds(where: str, slices: int) -> float:
        own = [stage for stage in stages if stage.where == where and stage.kind != "fields"]
        fitted = [slices * (stage.kind not in ("noise", "candidates")) / 8.0**stage.halvings for stage in own]
        parts = zip(own, fitted, strict=True)
        return sum(stage.num_steps * stage.fits * (calls + count * slice_step) for stage, count in parts)

    trials = sum(stage.fits for stage in stages if stage.kind == "fields")  # on the slab, with choices for the first
    total = (1 + trials) * start + (1 + (trials > 0)) * seconds("slab", slab_height)
    return total + seconds("whole", num_slices) + trials * seconds("whole", slab_height)


def _seconds_of_a_slice(tilt_series: TiltSeries, grid: VolumeGrid, *, slices: int = 4) -> float:
    """Seconds for the projection of one slice to all tilts, and back: the fastest of so many projections of as many `slices`, of
    which the first allocates memory."""
    projector = SliceProjector(
        tilt_angles=tilt_series.tilt_angles,
        depth=grid.depth,
        width=grid.width,
        detector_width=tilt_series.images.shape[2],
    )
    columns = torch.rand(grid.depth * grid.width, slices)
    seconds = list[float]()
    with torch.no_grad(), num_threads(1):  # the CPU time of one thread does not depend on the load
        for _ in range(slices):
            started = time.thread_time()
            projector.backproject(projector.project(columns))
            seconds.append(time.thread_time() - started)
    return min(seconds) / (slices * torch.get_num_threads())
