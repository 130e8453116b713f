"""Simultaneous iterative reconstruction technique (SIRT) and weighted back-projection; held-out tilts choose their settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.joint.checkpoint import Repeated, RunStage, run_stage
from recon.methods._registry import Method, Settings, after_denoising
from recon.projection.base import Projector
from recon.projection.classical import WINDOWS, sirt, wbp
from recon.projection.dual_axis import projector_of
from recon.projection.image_formation import Linear, Transmission
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Block, Blockwise, Images
from recon.series.first_guess import FEW_ITERATIONS, contrast_slab, estimate_response
from recon.series.holdout import Holdout
from recon.series.masks import used_values, weights_of_rays
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.series.views import AROUND, level_of, view_numbers, without_level

_ITERATIONS = sorted({round(2 ** (k / 2)) for k in range(17)})


@dataclass(frozen=True)
class LineIntegralProblem:
    """Measured line integrals and the operator that predicts them.

    Attributes:
        line_integrals: (tilt, y, u).
        response: converts line integrals to pixel values above `level`.
        level: constant level of linear images, detector units; separate to preserve float32 precision.
        used: (tilt, y, u), 1 for rays to use and 0 for others; None for all.
    """

    line_integrals: Tensor
    projector: Projector
    response: Transmission | Linear
    level: float
    used: Tensor | None = None

    @classmethod
    def of(cls, tilt_series: TiltSeries, grid: VolumeGrid, device: torch.device | str = "cpu") -> LineIntegralProblem:
        """The problem of reconstructing `tilt_series` on `grid`."""
        tilt_series, level = without_level(tilt_series)
        response = estimate_response(tilt_series).to(device)
        return cls.seen_by(response, projector_of(tilt_series, grid, device), tilt_series, level)

    @classmethod
    def seen_by(
        cls, response: Transmission | Linear, projector: Projector, tilt_series: TiltSeries, level: float
    ) -> LineIntegralProblem:
        """The problem of images in float32 above `level`, for a known response and operator."""
        images, used = torch.from_numpy(tilt_series.images).to(projector.device), weights_of_rays(tilt_series)
        with torch.no_grad():
            lines = response.invert(images).contiguous()
        return cls(lines, projector, response, level, None if used is None else torch.from_numpy(used).to(lines))

    def sirt(self, num_iterations: int, start: Tensor | None = None) -> Tensor:
        """The volume after some iterations of SIRT on the used rays."""
        return sirt(self.line_integrals, self.projector, num_iterations=num_iterations, start=start, used=self.used)

    def filled(self) -> Tensor:
        """Line integrals for methods that need all rays: those of masked pixels are projections of a volume of the others."""
        if self.used is None:
            return self.line_integrals
        return torch.where(self.used > 0, self.line_integrals, self.projector(self.sirt(FEW_ITERATIONS)))

    def predict(self, volume: Tensor) -> NDArray[np.float32]:
        """The images (tilt, y, u) that a volume (z, y, x) predicts, detector units."""
        with torch.no_grad():
            images = self.response(self.projector(volume).transpose(1, 2)).transpose(1, 2)
            return np.asarray(images.contiguous().cpu().numpy() + np.float32(self.level))


Solve = Callable[[LineIntegralProblem, RunStage | None], Tensor]
Settle = Callable[[TiltSeries, VolumeGrid, Settings], tuple[Solve, dict[str, float | str]]]


def classical(name: str, description: str, settle: Settle, *, refuses: tuple[str, ...]) -> Method:
    """A method with independent slices and without a fitted noise model.

    Args:
        name, description, refuses: as for `Method`.
        settle: makes the choices for a series; returns how to solve a problem, with stages or at once, and the choices.
    """

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        solve, choices = settle(tilt_series, grid, settings)
        problem = LineIntegralProblem.of(tilt_series, grid, settings.device)
        volume = solve(problem, settings.run_stage)
        result = Volume(volume.contiguous().cpu().numpy(), grid.voxel_size)
        return Reconstruction(result, problem.predict(volume), name, choices=choices)

    def blockwise(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Blockwise:
        """All blocks have the response of the whole series."""
        solve, choices = settle(tilt_series, grid, settings)
        level = level_of(tilt_series)
        response = estimate_response(tilt_series, level=level).to(settings.device)
        projector = projector_of(tilt_series, grid, settings.device)

        def solve_block(part: TiltSeries, block: Block) -> tuple[Images, Images]:
            lowered = part.with_images(np.asarray(part.images - np.float64(level), dtype=np.float32), part.mask)
            problem = LineIntegralProblem.seen_by(response, projector, lowered, level)
            volume = solve(problem, None)
            return volume.cpu().numpy(), problem.predict(volume)

        return Blockwise(solve_block, lambda volume, images: Reconstruction(volume, images, name, choices=choices))

    return Method(name, description, run, refuses=refuses, blockwise=blockwise)


def best_window(
    tilt_series: TiltSeries, grid: VolumeGrid, windows: Iterable[str] = tuple(WINDOWS), *, steps: int = 6
) -> tuple[str, float]:
    """Window and cutoff, in `steps` of half an octave from 1 down, of the back-projection that best predicts held-out tilts;
    the first window and 1 if tilts are few."""
    if view_numbers(tilt_series.tilt_angles).max() + 1 < AROUND:
        return next(iter(windows)), 1.0
    rest, score = _left_out(tilt_series, grid)
    lines = rest.filled()
    tried = {
        (window, cutoff): score(wbp(lines, rest.projector, window=window, cutoff=cutoff))
        for window in windows
        for cutoff in (2 ** (-k / 2) for k in range(steps))
    }
    return max(tried, key=lambda setting: tried[setting])


def best_num_iterations(tilt_series: TiltSeries, grid: VolumeGrid, *, run_stage: RunStage = run_stage) -> int:
    """The number of SIRT iterations that best predicts held-out tilts, as later ones fit the noise; 32 if tilts are few."""
    if view_numbers(tilt_series.tilt_angles).max() + 1 < AROUND:
        return 32
    choice = _IterationChoice(*_left_out(tilt_series, grid))
    run_stage("choosing the number of iterations", choice)
    return choice.best


class _IterationChoice:
    """A stage that tries increasing numbers of iterations until the last `patience` were not better than the best."""

    def __init__(self, rest: LineIntegralProblem, score: Callable[[Tensor], float], *, patience: int = 3) -> None:
        self.rest, self.score, self.patience = rest, score, patience
        self.volume: Tensor | None = None
        self.tried: dict[int, float] = {}
        self.done, self.num_steps = 0, len(_ITERATIONS)

    @property
    def best(self) -> int:
        return max(self.tried, key=lambda number: self.tried[number])

    def step(self) -> str:
        count, before = _ITERATIONS[self.done], max(self.tried, default=0)
        self.volume = self.rest.sirt(count - before, self.volume)
        self.tried[count] = self.score(self.volume)
        self.done += 1
        if len([number for number in self.tried if number > self.best]) >= self.patience:
            self.num_steps = self.done
        return f"best {self.best}"

    def state(self) -> dict[str, Any]:
        return {"volume": self.volume, "tried": self.tried, "done": self.done, "num_steps": self.num_steps}

    def load_state(self, state: dict[str, Any]) -> None:
        self.volume, self.tried = state["volume"], state["tried"]
        self.done, self.num_steps = state["done"], state["num_steps"]


def _left_out(
    tilt_series: TiltSeries, grid: VolumeGrid, *, slices: int = 24, every: int = 5
) -> tuple[LineIntegralProblem, Callable[[Tensor], float]]:
    """A slab of `slices` without one view in `every`, and a score: how a volume's projections correlate with the held-out tilts.

    Views are counted by angle and held out with all their duplicates, because a remaining duplicate would reveal the noise.
    """
    tilt_series, _ = without_level(tilt_series)
    rows = contrast_slab(tilt_series, slices)
    out = Holdout.views(tilt_series.tilt_angles, every).groups == 1
    slab = replace(grid, height=rows.stop - rows.start)
    rest = LineIntegralProblem.of(tilt_series.rows(rows).select(~out), slab)
    left = tilt_series.rows(rows).select(out)
    judge = projector_of(left, slab)
    measured = used_values(left).astype(np.float64)
    unseen = replace(rest, projector=judge, response=estimate_response(left))

    def score(volume: Tensor) -> float:
        predicted = used_values(left, unseen.predict(volume)).astype(np.float64)
        return float(np.corrcoef(predicted, measured)[0, 1]) if min(np.ptp(predicted), np.ptp(measured)) > 0 else -1.0

    return rest, score


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


def _settle_filter(
    tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings
) -> tuple[Solve, dict[str, float | str]]:
    windows = WINDOWS if settings.window is None else (settings.window,)
    window, cutoff = best_window(tilt_series, grid, windows)

    def solve(problem: LineIntegralProblem, _: RunStage | None) -> Tensor:
        return wbp(problem.filled(), problem.projector, window=window, cutoff=cutoff)

    return solve, {"window": window, "cutoff": cutoff}


METHOD = classical("sirt", "SIRT; held-out tilts choose the iterations.", _settle, refuses=("window", "denoiser"))
_WBP = classical(
    "wbp",
    "Weighted back-projection; window and cutoff are chosen by held-out tilts.",
    _settle_filter,
    refuses=("steps", "denoiser", "second-axis"),
)
METHODS = {
    "wbp": _WBP,
    "wbp-denoised": after_denoising("wbp-denoised", "Images denoised one by one, then back-projection.", _WBP),
}
