"""Simultaneous iterative reconstruction technique (SIRT)."""

from __future__ import annotations

from recon.joint.stages import Repeated
from recon.methods._classical import LineIntegralProblem, best_num_iterations, classical, in_blocks
from recon.methods._registry import Method, Settings
from recon.projection.sirt import sirt
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Blockwise
from recon.series.tilt_series import TiltSeries, VolumeGrid


def _run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
    count = settings.num_steps or best_num_iterations(tilt_series, grid, run_stage=settings.run_stage)
    problem = LineIntegralProblem.of(tilt_series, grid, settings.device)
    measured, projector = problem.line_integrals, problem.projector
    iterations = Repeated(
        measured.new_zeros(grid.shape),
        lambda volume, _: sirt(measured, projector, num_iterations=1, start=volume),
        count,
    )
    settings.run_stage("SIRT", iterations)
    return classical("sirt", problem, iterations.value, grid, {"iterations": count})


def _blockwise(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Blockwise:
    count = settings.num_steps or best_num_iterations(tilt_series, grid, run_stage=settings.run_stage)
    return in_blocks(
        "sirt",
        tilt_series,
        grid,
        settings.device,
        lambda problem: sirt(problem.line_integrals, problem.projector, num_iterations=count),
        {"iterations": count},
    )


METHOD = Method(
    "sirt",
    "SIRT; the number of iterations is chosen by held-out tilts.",
    _run,
    refuses=("window", "denoiser"),
    blockwise=_blockwise,
)
