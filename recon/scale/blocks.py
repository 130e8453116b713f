"""Reconstruction by blocks of slices: memory for one block, and one model for all of them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from noiseflow import Gaussian
from noiseflow.kept_memory import kept_memory
from recon.fields.fields import MultiresolutionField, VoxelField
from recon.joint.joint import JointReconstructor
from recon.methods.classical import LineIntegralProblem, best_num_iterations, best_window, part_of
from recon.methods.laplace import Laplace
from recon.methods.methods import Outcome, Settings, describe, describe_defocus
from recon.projection.projector import SliceProjector
from recon.projection.sirt import sirt
from recon.projection.wbp import wbp
from recon.series.first_guess import contrast_slab, estimate_response
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

Block = tuple[NDArray[np.float32], NDArray[np.float32]]
Solve = Callable[[slice], Block]
_SETTLED_ON, _HALO = 32, 6
_FITTED: dict[str, dict[str, Any]] = {
    "joint": {},
    "l2": {"noise_model": Gaussian},
    "l1": {"noise_model": Laplace},
    "tv": {"noise_model": Gaussian, "make_field": VoxelField},
}


@kept_memory()
def reconstruct_in_blocks(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    scratch: Path,
    *,
    method: str = "joint",
    rows_at_once: int,
    **settings: Any,
) -> Outcome:
    """Reconstruct a volume of any height, so many slices at a time.

    The slices of back-projection and SIRT do not depend on each other: the volume is the one of a run in one go. The fitted
    methods settle noise model, weight and incident intensity on the slab of the most contrast, and keep them; blocks overlap by
    six slices on either side, which are not written, so that the regulariser sees across their borders.

    Args:
        tilt_series: the images; a memory-mapped array will do.
        grid: the lattice.
        scratch: a new file, ``.npy``, that holds the volume; the result maps it to memory. Remove it when done.
        method: joint, l2, l1, tv, sirt or wbp; ``auto`` is joint.
        rows_at_once: slices in a block, at least one.
        **settings: the attributes of `Settings`.

    Raises:
        ValueError: another method, no slices, or as `recon.methods.reconstruct`.
    """
    method = "joint" if method == "auto" else method
    if rows_at_once < 1:
        raise ValueError(f"--slices-at-once {rows_at_once} must be 1 or more")
    chosen = Settings(**settings)
    if method in _FITTED:
        solve, choices, start = _fitted(tilt_series, grid, method, chosen)
    elif method in ("sirt", "wbp"):
        if chosen.defocus:
            raise ValueError(f"--defocus: method {method} models none; use --method {', '.join(_FITTED)}")
        (solve, choices), start = _classical(tilt_series, grid, method, chosen), None
    else:
        raise ValueError(
            f"--slices-at-once does not know --method {method}: choose {', '.join([*_FITTED, 'sirt, wbp'])}"
        )
    volume = np.lib.format.open_memmap(scratch, "w+", np.float32, grid.shape)
    with tempfile.TemporaryFile(dir=scratch.parent) as file:
        projections = np.memmap(file, np.float32, "w+", shape=tilt_series.images.shape)
    for rows in _blocks(grid.height, rows_at_once):
        volume[:, rows], projections[:, rows] = solve(rows)
        volume.flush()
    result = Outcome(Volume(volume, grid.voxel_size), projections, method, None, None, choices)
    return result if start is None else replace(start, volume=result.volume, projections=projections, choices=choices)


def _blocks(height: int, rows_at_once: int) -> Iterator[slice]:
    yield from (slice(start, min(start + rows_at_once, height)) for start in range(0, height, rows_at_once))


def _classical(
    tilt_series: TiltSeries, grid: VolumeGrid, method: str, settings: Settings
) -> tuple[Solve, dict[str, float | str]]:
    response = estimate_response(tilt_series).to(settings.device)
    projector = SliceProjector(
        tilt_angles=tilt_series.tilt_angles,
        depth=grid.depth,
        width=grid.width,
        detector_width=tilt_series.images.shape[2],
        device=settings.device,
    )
    choices: dict[str, float | str]
    if method == "sirt":
        count = settings.num_steps or best_num_iterations(tilt_series, grid)
        choices = {"iterations": count}
    else:
        window, cutoff = best_window(tilt_series, grid, *([] if settings.window is None else [(settings.window,)]))
        choices = {"window": window, "cutoff": cutoff}

    def solve(rows: slice) -> Block:
        images = torch.from_numpy(np.array(tilt_series.images[:, rows], dtype=np.float32)).to(settings.device)
        problem = LineIntegralProblem(response.invert(images).contiguous().detach(), projector, response)
        if method == "sirt":
            volume = sirt(problem.line_integrals, problem.projector, num_iterations=count)
        else:
            volume = wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff)
        return volume.cpu().numpy(), problem.predict(volume)

    return solve, choices


def _fitted(
    tilt_series: TiltSeries, grid: VolumeGrid, method: str, settings: Settings
) -> tuple[Solve, dict[str, float | str], Outcome]:
    options: dict[str, Any] = {"make_field": MultiresolutionField, **_FITTED[method]}
    options |= {"seed": settings.seed, "device": settings.device, "run_fit": settings.run_fit}
    options["defocus"] = settings.defocus
    if settings.num_steps is not None:
        options["num_steps"] = settings.num_steps
    if settings.noise_model is not None:
        given = settings.noise_model.requires_grad_(False)
        options["noise_model"] = lambda: given
    slab = contrast_slab(tilt_series, _SETTLED_ON)
    part = part_of(tilt_series, slice(None), slab)
    first = JointReconstructor(weight=settings.weight, **options)(part, replace(grid, height=part.images.shape[1]))
    noise_model = first.noise_model.requires_grad_(False)
    model = first.signal_model
    options |= {"noise_model": lambda: noise_model, "settled": model, "weight": model.weight}
    choices: dict[str, float | str] = {
        "weight": model.weight,
        "noise model": describe(noise_model),
        "settled on slices": f"{slab.start} to {slab.stop - 1}",
        **describe_defocus(settings.defocus, model.projector),
    }

    def solve(rows: slice) -> Block:
        wide = slice(max(0, rows.start - _HALO), min(grid.height, rows.stop + _HALO))
        found = JointReconstructor(**options)(
            part_of(tilt_series, slice(None), wide),
            replace(grid, height=wide.stop - wide.start),
            progress=settings.progress,
        )
        inner = slice(rows.start - wide.start, rows.stop - wide.start)
        return found.volume.attenuation[:, inner], found.projections[:, inner]

    tried = first.weight_choice.tried if first.weight_choice is not None else {}
    found = first.volume, first.projections, method, first.fit_result, noise_model
    start = Outcome(*found, choices, tried, model.response())
    return solve, choices, start


def block_memory(
    tilt_series: TiltSeries, grid: VolumeGrid, rows_at_once: int, *, fitted: bool
) -> tuple[TiltSeries, VolumeGrid]:
    """What is in memory at a time, for `recon.scale.memory.needed_memory`: one block of the series and of the lattice."""
    rows = min(grid.height, max(rows_at_once + 2 * _HALO, _SETTLED_ON) if fitted else rows_at_once)
    return part_of(tilt_series, slice(None), slice(0, rows)), replace(grid, height=rows)
