"""Every method of reconstruction by name. A method is one function below; its docstring's first line is its description."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from noiseflow import Digitisation, Digitised, FitResult, Gaussian, fit
from noiseflow.described import described
from noiseflow.kept_memory import kept_memory
from recon.fields.fields import VoxelField
from recon.joint.joint import JointReconstructor, Reconstruction
from recon.joint.stages import Repeated, RunStage, run_stage
from recon.methods.classical import LineIntegralProblem, best_num_iterations, best_window
from recon.methods.denoise import find_denoiser
from recon.methods.kniesel2022.presets import PRESETS
from recon.methods.laplace import Laplace
from recon.projection.defocused_projector import DefocusedProjector
from recon.projection.projector import SliceProjector
from recon.projection.sirt import sirt
from recon.projection.wbp import WINDOWS, wbp
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

Progress = Callable[[int, str], None]


@described(projections="detector units")
@dataclass(frozen=True)
class Outcome:
    """What any method gives.

    Attributes:
        volume: the reconstruction.
        projections: (tilt, y, u) images the volume predicts, detector units.
        method: the method that was used.
        fit_result: of fitted methods.
        noise_model: of the joint fit.
        choices: what was chosen or estimated, by name.
        weights_tried: weight → held-out negative log-likelihood, where the weight was chosen by it.
        response: of fitted methods, intensity and offset of every tilt, see `recon.projection.image_formation`.
    """

    volume: Volume
    projections: np.ndarray[Any, np.dtype[np.float32]]
    method: str
    fit_result: FitResult | None
    noise_model: nn.Module | None
    choices: dict[str, float | str]
    weights_tried: dict[float, float] = field(default_factory=dict)
    response: dict[str, list[float]] = field(default_factory=dict)


@described()
@dataclass(frozen=True)
class Settings:
    """What a user may settle; whatever is None the method chooses by itself.

    Attributes:
        weight: of the total variation, see `TomographySignal`.
        num_steps: steps or iterations.
        noise_model: a fitted noise model to keep as it is; denoisers take the noise level from it.
        window: of the back-projection, one of `recon.projection.wbp.WINDOWS`.
        denoiser: see `recon.methods.denoise.find_denoiser`.
        defocus: blur that fitted methods model, pixels per voxel out of the plane of focus.
        seed: of every random choice.
        device: where to compute.
        progress: called with the steps done and a note.
        run_fit, run_stage: run every fit and every other long piece of work; a `Journal` keeps what each has reached.

    Raises:
        ValueError: a negative weight, no steps, a defocus outside 0 to 1, or an unknown window.
    """

    weight: float | None = None
    num_steps: int | None = None
    noise_model: nn.Module | None = None
    window: str | None = None
    denoiser: str = "nlm"
    defocus: float = 0.0
    seed: int = 0
    device: torch.device | str = "cpu"
    progress: Progress | None = None
    run_fit: Callable[..., FitResult] = fit
    run_stage: RunStage = run_stage

    def __post_init__(self) -> None:
        if self.weight is not None and not 0 <= self.weight < np.inf:
            raise ValueError(f"--weight {self.weight} must be zero or more")
        if self.num_steps is not None and self.num_steps < 1:
            raise ValueError(f"--steps {self.num_steps} must be 1 or more")
        if not 0 <= self.defocus <= 1:
            raise ValueError(f"--defocus {self.defocus:g}: give 0 to 1, pixels of blur per pixel out of focus")
        if self.window is not None and self.window not in WINDOWS:
            raise ValueError(f"--window {self.window}: choose one of {', '.join(WINDOWS)}")


Method = Callable[[TiltSeries, VolumeGrid, Settings], Outcome]
METHODS: dict[str, Method] = {}
"""Methods by name."""


def method(name: str) -> Callable[[Method], Method]:
    """Make a function a method of this name, for `reconstruct` and every command."""

    def register(function: Method) -> Method:
        METHODS[name] = function
        return function

    return register


@kept_memory()
def reconstruct(tilt_series: TiltSeries, grid: VolumeGrid, *, method: str = "auto", **settings: Any) -> Outcome:
    """Reconstruct a volume from a tilt series.

    Args:
        tilt_series: the images.
        grid: the lattice.
        method: one of `METHODS`.
        **settings: the attributes of `Settings`.

    Raises:
        ValueError: as `settings_of`, or a grid that does not match the images.
    """
    chosen = settings_of(method, **settings)
    return METHODS[method](tilt_series, grid, chosen)


def settings_of(method: str, **settings: Any) -> Settings:
    """The settings of one of `METHODS`, checked before there are data. Arguments as of `reconstruct`.

    Raises:
        ValueError: unknown method, or settings that make no sense.
    """
    if method not in METHODS:
        raise ValueError(f"--method {method}: choose one of {', '.join(METHODS)}")
    chosen = Settings(**settings)
    if chosen.defocus and (method.startswith(("sirt", "wbp")) or method in PRESETS):
        raise ValueError(f"--defocus: method {method} models none; use --method joint, l2, l1, tv or explicit")
    return chosen


@method("auto")
def _auto(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """The joint fit."""
    return _joint(tilt_series, grid, settings)


@method("joint")
def _joint(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Volume and noise model together, with everything chosen by the likelihood of held-out pixels."""
    if settings.noise_model is not None:
        return replace(_joint_supervised(tilt_series, grid, settings), method="joint")
    return _fitted("joint", tilt_series, grid, settings)


@method("joint-supervised")
def _joint_supervised(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """The same volume under a calibrated noise model that stays as it is."""
    if settings.noise_model is None:
        raise ValueError("--method joint-supervised needs --noise-model FILE; `noiseflow calibrate` makes one")
    fixed = settings.noise_model.requires_grad_(False)
    return _fitted("joint-supervised", tilt_series, grid, settings, noise_model=lambda: fixed)


@method("l2")
def _l2(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Least squares with total variation in the field of the joint fit."""
    return _fitted("l2", tilt_series, grid, settings, noise_model=Gaussian)


@method("l1")
def _l1(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Least absolute deviations with total variation in the field of the joint fit."""
    return _fitted("l1", tilt_series, grid, settings, noise_model=Laplace)


@method("tv")
def _tv(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Least squares with total variation on plain voxels."""
    return _fitted("tv", tilt_series, grid, settings, noise_model=Gaussian, make_field=VoxelField)


@method("explicit")
def _explicit(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Least squares on plain voxels without total variation, stopped where held-out pixels are predicted best."""
    free = replace(settings, weight=0.0)
    return _fitted("explicit", tilt_series, grid, free, noise_model=Gaussian, make_field=VoxelField)


@method("l2-denoised")
def _l2_denoised(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Images denoised one by one, then least squares with total variation."""
    return _after_denoising("l2-denoised", _l2, tilt_series, grid, settings)


@method("wbp-denoised")
def _wbp_denoised(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Images denoised one by one, then back-projection."""
    return _after_denoising("wbp-denoised", _wbp, tilt_series, grid, settings)


@method("sirt")
def _sirt(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """SIRT; the number of iterations is chosen by tilts left out."""
    count = settings.num_steps or best_num_iterations(tilt_series, grid, run_stage=settings.run_stage)
    problem = LineIntegralProblem.of(tilt_series, grid, settings.device)
    measured, projector = problem.line_integrals, problem.projector
    iterations = Repeated(
        measured.new_zeros(grid.shape),
        lambda volume, _: sirt(measured, projector, num_iterations=1, start=volume),
        count,
    )
    settings.run_stage("SIRT", iterations)
    return _classical("sirt", problem, iterations.value, grid, {"iterations": count})


@method("wbp")
def _wbp(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
    """Weighted back-projection; window and cutoff are chosen by tilts left out."""
    windows = WINDOWS if settings.window is None else (settings.window,)
    window, cutoff = best_window(tilt_series, grid, windows)
    problem = LineIntegralProblem.of(tilt_series, grid, settings.device)
    volume = wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff)
    return _classical("wbp", problem, volume, grid, {"window": window, "cutoff": cutoff})


def _of_preset(name: str) -> Method:
    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Outcome:
        preset = replace(PRESETS[name], seed=settings.seed, device=settings.device)
        state = preset.start(tilt_series, max_steps=settings.num_steps)
        settings.run_stage(name, state)
        volume = state.volume(grid)
        problem = LineIntegralProblem.of(tilt_series, grid)
        predicted = problem.predict(torch.from_numpy(volume.attenuation))
        choices: dict[str, float | str] = {"steps": state.done, "loss": state.loss}
        return Outcome(volume, predicted, name, None, state.noise_model, choices)

    return run


METHODS |= {name: _of_preset(name) for name in PRESETS}


def _classical(
    name: str, problem: LineIntegralProblem, volume: torch.Tensor, grid: VolumeGrid, choices: dict[str, float | str]
) -> Outcome:
    result = Volume(volume.contiguous().cpu().numpy(), grid.voxel_size)
    return Outcome(result, problem.predict(volume), name, None, None, choices)


def _after_denoising(
    name: str, method: Method, tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings
) -> Outcome:
    denoise = find_denoiser(settings.denoiser, tilt_series.images, noise_model=settings.noise_model)

    def clean_next(images: torch.Tensor, number: int) -> torch.Tensor:
        images[number] = torch.from_numpy(np.asarray(denoise(tilt_series.images[number]), dtype=np.float32))
        return images

    cleaned = Repeated(torch.zeros(tilt_series.images.shape), clean_next, tilt_series.num_tilts)
    settings.run_stage("denoising", cleaned)
    clean = replace(tilt_series, images=cleaned.value.numpy())
    outcome = method(clean, grid, settings)
    choices: dict[str, float | str] = {"denoiser": settings.denoiser, **outcome.choices}
    return replace(outcome, method=name, choices=choices)


def _fitted(name: str, tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings, **options: Any) -> Outcome:
    options |= {
        "seed": settings.seed,
        "device": settings.device,
        "run_fit": settings.run_fit,
        "weight": settings.weight,
        "defocus": settings.defocus,
    }
    if settings.num_steps is not None:
        options["num_steps"] = settings.num_steps
    result: Reconstruction = JointReconstructor(**options)(tilt_series, grid, progress=settings.progress)
    response = result.signal_model.image_formation
    learnt = "intensity" if tilt_series.mode == "transmission" else "offset"
    choices: dict[str, float | str] = {
        "weight": result.signal_model.weight,
        "noise model": describe(result.noise_model),
        learnt: float(getattr(response, learnt).mean()),
    }
    choices |= describe_defocus(settings.defocus, result.signal_model.projector)
    tried = result.weight_choice.tried if result.weight_choice is not None else {}
    found = result.volume, result.projections, name, result.fit_result, result.noise_model
    return Outcome(*found, choices, tried, result.signal_model.response())


def describe_defocus(defocus: float, projector: SliceProjector | DefocusedProjector) -> dict[str, str]:
    """What was modelled of a defocus, for `Outcome.choices`; nothing where none was asked for."""
    if not defocus:
        return {}
    what = "below a quarter of a pixel, left out"
    if isinstance(projector, DefocusedProjector):
        what = f"blurs up to {projector.blurs[-1]:.2g} pixels"
    return {"defocus": f"{defocus:g}, {what}"}


def describe(noise_model: nn.Module) -> str:
    """A noise model in a few words."""
    if not isinstance(noise_model, Digitised):
        return type(noise_model).__name__
    found = Digitisation(noise_model.step, noise_model.low, noise_model.high)
    return f"{type(noise_model.model).__name__}, {found.in_words()}"
