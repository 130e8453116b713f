"""What methods that fit a volume share: one joint fit with options of its own, whole or in blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from torch import nn

from noiseflow import Digitisation, Digitised
from recon.fields.regularisers._names import DEFAULT
from recon.fields.regularisers._registry import find_regulariser
from recon.joint.joint import JointReconstructor
from recon.joint.plan import FitStage
from recon.joint.signal_model import TomographySignal
from recon.methods._registry import Finish, Method, Settings
from recon.projection.defocused_projector import DefocusedProjector
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Images, Solve, with_halo
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

Options = Callable[[Settings], dict[str, Any]]
"""From what a user settled to further options of a `JointReconstructor`."""


def fitted(name: str, description: str, options: Options, *, keeps_noise_model: bool = False) -> Method:
    """A method that is a joint fit.

    Args:
        name, description: of the method.
        options: of the joint fit, besides what a user settled.
        keeps_noise_model: whether it takes a calibrated noise model.
    """

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        result = reconstructor(settings, options)(tilt_series, grid, progress=settings.progress)
        return replace(result, method=name, choices=_choices(result, settings, tilt_series))

    def make_plan(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> tuple[list[FitStage], int]:
        return reconstructor(settings, options).plan(tilt_series, grid)

    def blockwise(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> tuple[Solve, Finish]:
        fit = reconstructor(settings, options)
        settled = fit.settle(tilt_series, grid, progress=settings.progress)

        def solve(rows: slice) -> tuple[Images, Images]:
            wide, inner = with_halo(rows, grid.height)
            block = replace(fit, prefix=f"{fit.prefix}slices from {rows.start}: ")
            part, part_grid = tilt_series.rows(wide), replace(grid, height=wide.stop - wide.start)
            found = block.fit(part, part_grid, settled, progress=settings.progress)
            return found.volume.attenuation[:, inner], found.projections[:, inner]

        def finish(volume: Volume, projections: Images) -> Reconstruction:
            known = settled.noise_model, settled.fit_result, settled.signal_model, settled.weight_choice
            result = Reconstruction(volume, projections, name, *known)
            where: dict[str, float | str] = {
                "settled on slices": f"{settled.slices.start} to {settled.slices.stop - 1}"
            }
            return replace(result, choices=_choices(result, settings, tilt_series) | where)

        return solve, finish

    return Method(
        name,
        description,
        run,
        fitted=True,
        keeps_noise_model=keeps_noise_model,
        learns_noise=True,
        plan=make_plan,
        blockwise=blockwise,
    )


def reconstructor(settings: Settings, options: Options) -> JointReconstructor:
    """The joint fit that a method makes of what a user settled."""
    names = ("weight", "num_steps", "defocus", "seed", "device", "run_fit", "prefix")
    shared: dict[str, Any] = {name: getattr(settings, name) for name in names}
    shared["regulariser"] = find_regulariser(settings.regulariser)
    return JointReconstructor(**(shared | options(settings)))


def _choices(result: Reconstruction, settings: Settings, tilt_series: TiltSeries) -> dict[str, float | str]:
    model = result.signal_model
    if model is None or result.noise_model is None:
        return {}
    learnt = "intensity" if tilt_series.mode == "transmission" else "offset"
    choices: dict[str, float | str] = {
        "weight": float(model.weight),
        "noise model": _describe(result.noise_model),
        learnt: float(getattr(model.image_formation, learnt).mean()),
    }
    if settings.regulariser != DEFAULT:
        choices["regulariser"] = settings.regulariser
    return choices | ({"defocus": _describe_defocus(settings.defocus, model)} if settings.defocus else {})


def _describe_defocus(defocus: float, model: TomographySignal) -> str:
    what = "below a quarter of a pixel, left out"
    if isinstance(model.projector, DefocusedProjector):
        what = f"blurs up to {model.projector.blurs[-1]:.2g} pixels"
    return f"{defocus:g}, {what}"


def _describe(noise_model: nn.Module) -> str:
    """A noise model in a few words."""
    if not isinstance(noise_model, Digitised):
        return type(noise_model).__name__
    found = Digitisation(noise_model.step, noise_model.low, noise_model.high)
    return f"{type(noise_model.model).__name__}, {found.in_words()}"
