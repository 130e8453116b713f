"""Weighted back-projection."""

from __future__ import annotations

from recon.methods._classical import LineIntegralProblem, best_window, classical, in_blocks
from recon.methods._registry import Method, Settings
from recon.projection.wbp import WINDOWS, wbp
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Blockwise
from recon.series.tilt_series import TiltSeries, VolumeGrid


def _filter(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> tuple[str, float]:
    return best_window(tilt_series, grid, WINDOWS if settings.window is None else (settings.window,))


def _run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
    window, cutoff = _filter(tilt_series, grid, settings)
    problem = LineIntegralProblem.of(tilt_series, grid, settings.device)
    volume = wbp(problem.filled(), problem.projector, window=window, cutoff=cutoff)
    return classical("wbp", problem, volume, grid, {"window": window, "cutoff": cutoff})


def _blockwise(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Blockwise:
    window, cutoff = _filter(tilt_series, grid, settings)
    return in_blocks(
        "wbp",
        tilt_series,
        grid,
        settings.device,
        lambda problem: wbp(problem.filled(), problem.projector, window=window, cutoff=cutoff),
        {"window": window, "cutoff": cutoff},
    )


METHOD = Method(
    "wbp",
    "Weighted back-projection; window and cutoff are chosen by held-out tilts.",
    _run,
    refuses=("steps", "denoiser", "second-axis"),
    blockwise=_blockwise,
)
