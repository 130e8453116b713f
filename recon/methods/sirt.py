"""Simultaneous iterative reconstruction technique (SIRT)."""

from __future__ import annotations

from recon.joint.stages import Repeated
from recon.methods._classical import LineIntegralProblem, best_num_iterations, classical, in_blocks
from recon.methods._registry import Method, Settings
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Blockwise
from recon.series.tilt_series import TiltSeries, VolumeGrid


def _run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
    count = settings.num_steps or best_num_iterations(tilt_series, grid, run_stage=settings.run_stage)
    problem = LineIntegralProblem.of(tilt_series, grid, settings.device)
    empty = problem.line_integrals.new_zeros(grid.shape)
    iterations = Repeated(empty, lambda volume, _: problem.sirt(1, volume), count)
    settings.run_stage("SIRT", iterations)
    return classical("sirt", problem, iterations.value, grid, {"iterations": count})


def _blockwise(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Blockwise:
    count = settings.num_steps or best_num_iterations(tilt_series, grid, run_stage=settings.run_stage)
    return in_blocks(
        "sirt",
        tilt_series,
        grid,
        settings.device,
        lambda problem: problem.sirt(count),
        {"iterations": count},
    )


METHOD = Method(
    "sirt",
    "SIRT; the number of iterations is chosen by held-out tilts.",
    _run,
    refuses=("window", "denoiser"),
    blockwise=_blockwise,
)
