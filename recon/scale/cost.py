"""Estimate of the run time of a planned reconstruction on this machine."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch

from noiseflow.threads import num_threads
from recon.joint.plan import FitStage
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import TiltSeries, VolumeGrid

_SLICES = 4  # slices projected to measure the speed of this machine
_REPEATS = 5  # the fastest counts; the first one allocates memory
# time of a step in projections of a slice: a constant part (likelihood, interpolation, regulariser), and one proportional to the
# occupied voxels (shells of 256³, occupied share 0.13, take 0.7; a slab of 512³ that fills the field 1.5)
_ALWAYS, _OCCUPIED = 0.6, 0.9
_NOISE_STEP = 0.012  # s, for a batch of 4096 pixels; hardly depends on the series
_START = 2.0  # s, for the coarse reconstruction before the first stage


def expected_seconds(
    stages: Sequence[FitStage],
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    slab_height: int,
    share: float = 1.0,
    num_slices: int | None = None,
    step_cost: float = 1.0,
) -> float:
    """Expected run time of stages on an idle machine, in seconds, within about a factor of two.

    Args:
        stages: stages of a plan.
        tilt_series: the images.
        grid: grid of the volume.
        slab_height: number of slices of the slab.
        share: share of voxels that are not skipped.
        step_cost: time of a step relative to that of grids, see `recon.Field`.
        num_slices: number of fitted slices, counting slices in two blocks twice; by default those of the volume.
    """
    num_slices = grid.height if num_slices is None else num_slices
    slice_step = step_cost * (_ALWAYS + _OCCUPIED * share) * _seconds_of_a_slice(tilt_series, grid)
    total = _START
    for stage in stages:
        if stage.kind in ("noise", "candidates"):
            total += stage.num_steps * stage.fits * _NOISE_STEP
        else:
            slices = slab_height if stage.where == "slab" else num_slices
            total += stage.num_steps * stage.fits * slices * slice_step / 8**stage.halvings
    return total


def _seconds_of_a_slice(tilt_series: TiltSeries, grid: VolumeGrid) -> float:
    """Seconds for the projection of one slice to all tilts, and back."""
    projector = SliceProjector(
        tilt_angles=tilt_series.tilt_angles,
        depth=grid.depth,
        width=grid.width,
        detector_width=tilt_series.images.shape[2],
    )
    columns = torch.rand(grid.depth * grid.width, _SLICES)
    seconds = list[float]()
    with torch.no_grad(), num_threads(1):  # the CPU time of one thread does not depend on the load
        for _ in range(_REPEATS):
            started = time.thread_time()
            projector.backproject(projector.project(columns))
            seconds.append(time.thread_time() - started)
    return min(seconds) / (_SLICES * torch.get_num_threads())
