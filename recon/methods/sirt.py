"""Simultaneous iterative reconstruction technique (SIRT)."""

from torch import Tensor

from recon.joint.stages import Repeated, RunStage
from recon.methods._classical import LineIntegralProblem, Solve, best_num_iterations, classical
from recon.methods._registry import Settings
from recon.series.tilt_series import TiltSeries, VolumeGrid


def _settle(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> tuple[Solve, dict[str, float | str]]:
    count = settings.num_steps or best_num_iterations(tilt_series, grid, run_stage=settings.run_stage)

    def solve(problem: LineIntegralProblem, run_stage: RunStage | None) -> Tensor:
        if run_stage is None:
            return problem.sirt(count)
        empty = problem.line_integrals.new_zeros(grid.shape)
        iterations = Repeated(empty, lambda volume, _: problem.sirt(1, volume), count)
        run_stage("SIRT", iterations)
        return iterations.value

    return solve, {"iterations": count}


METHOD = classical("sirt", "SIRT; held-out tilts choose the iterations.", _settle, refuses=("window", "denoiser"))
