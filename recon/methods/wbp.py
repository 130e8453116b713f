"""Weighted back-projection, also of denoised images."""

from torch import Tensor

from recon.joint.stages import RunStage
from recon.methods._registry import Settings, after_denoising
from recon.methods.sirt import LineIntegralProblem, Solve, best_window, classical
from recon.projection.classical import WINDOWS, wbp
from recon.series.tilt_series import TiltSeries, VolumeGrid


def _settle(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> tuple[Solve, dict[str, float | str]]:
    windows = WINDOWS if settings.window is None else (settings.window,)
    window, cutoff = best_window(tilt_series, grid, windows)

    def solve(problem: LineIntegralProblem, _: RunStage | None) -> Tensor:
        return wbp(problem.filled(), problem.projector, window=window, cutoff=cutoff)

    return solve, {"window": window, "cutoff": cutoff}


METHOD = classical(
    "wbp",
    "Weighted back-projection; window and cutoff are chosen by held-out tilts.",
    _settle,
    refuses=("steps", "denoiser", "second-axis"),
)
METHODS = {"wbp-denoised": after_denoising("wbp-denoised", "Images denoised one by one, then back-projection.", METHOD)}
