"""One door to every method of reconstruction, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import nn

from noiseflow import Digitised, FitResult, Gaussian, fit
from recon.fields import VoxelField
from recon.first_guess import estimate_response
from recon.joint import JointReconstructor, Reconstruction
from recon.projector import SliceProjector
from recon.sirt import sirt
from recon.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.wbp import wbp

Method = Literal["auto", "joint", "l2", "tv", "sirt", "wbp"]
METHODS: tuple[str, ...] = get_args(Method)
Progress = Callable[[int, str], None]


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
    """

    volume: Volume
    projections: np.ndarray[Any, np.dtype[np.float32]]
    method: str
    fit_result: FitResult | None
    noise_model: nn.Module | None
    choices: dict[str, float | str]
    weights_tried: dict[float, float] = field(default_factory=dict)


def reconstruct(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    *,
    method: str = "auto",
    weight: float | None = None,
    num_steps: int | None = None,
    noise_model: nn.Module | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    run_fit: Callable[..., FitResult] = fit,
) -> Outcome:
    """Reconstruct a volume from a tilt series.

    Args:
        tilt_series: the images.
        grid: the lattice.
        method: ``joint`` learns volume and noise together (``auto`` takes it); ``l2`` is least squares with total
            variation in the same field, ``tv`` the same on plain voxels; ``sirt`` and ``wbp`` are the classical ones.
        weight: of the total variation; see `TomographySignal`.
        num_steps: steps or iterations.
        noise_model: a fitted noise model to keep as it is, for ``joint``.
        seed: of every random choice.
        device: where to compute.
        progress: called with the steps done and a note.
        run_fit: runs every fit; `Journal.fit` keeps what each has reached.

    Raises:
        ValueError: unknown method, a negative weight, or a grid that does not match the images.
    """
    if method not in METHODS:
        raise ValueError(f"--method {method}: choose one of {', '.join(METHODS)}")
    if weight is not None and not 0 <= weight < np.inf:
        raise ValueError(f"--weight {weight} must be zero or more")
    method = "joint" if method == "auto" else method
    if method in ("sirt", "wbp"):
        return _classical(tilt_series, grid, method, num_steps or 100, device)
    options: dict[str, Any] = {"seed": seed, "device": device, "run_fit": run_fit}
    if weight is not None:
        options["weight"] = weight
    if num_steps is not None:
        options["num_steps"] = num_steps
    if method in ("l2", "tv"):
        options["noise_model"] = Gaussian
    elif noise_model is not None:
        fixed = noise_model.requires_grad_(False)
        options["noise_model"] = lambda: fixed
    if method == "tv":
        options["make_field"] = VoxelField
    return _fitted(JointReconstructor(**options), tilt_series, grid, method, progress)


def _fitted(
    reconstructor: JointReconstructor, tilt_series: TiltSeries, grid: VolumeGrid, method: str, progress: Progress | None
) -> Outcome:
    result: Reconstruction = reconstructor(tilt_series, grid, progress=progress)
    response = result.signal_model.image_formation
    learnt = "intensity" if tilt_series.mode == "transmission" else "offset"
    choices: dict[str, float | str] = {
        "weight": result.signal_model.weight,
        "noise model": _describe(result.noise_model),
        learnt: float(getattr(response, learnt).mean()),
    }
    tried = result.weight_choice.tried if result.weight_choice is not None else {}
    return Outcome(result.volume, result.projections, method, result.fit_result, result.noise_model, choices, tried)


def _describe(noise_model: nn.Module) -> str:
    if not isinstance(noise_model, Digitised):
        return type(noise_model).__name__
    rounding = f"rounded to {noise_model.step:g}, " if noise_model.step else ""
    return f"{type(noise_model.model).__name__}, {rounding}clipped to [{noise_model.low:g}, {noise_model.high:g}]"


def _classical(
    tilt_series: TiltSeries, grid: VolumeGrid, method: str, num_iterations: int, device: torch.device | str
) -> Outcome:
    response = estimate_response(tilt_series).to(device)
    width = tilt_series.images.shape[2]
    projector = SliceProjector(
        tilt_angles=tilt_series.tilt_angles, depth=grid.depth, width=grid.width, detector_width=width, device=device
    )
    images = torch.from_numpy(np.asarray(tilt_series.images, dtype=np.float32)).to(device)
    with torch.no_grad():
        line_integrals = response.invert(images).contiguous()
        volume = (
            sirt(line_integrals, projector, num_iterations=num_iterations)
            if method == "sirt"
            else wbp(line_integrals, projector)
        )
        predicted = response(projector(volume).transpose(1, 2)).transpose(1, 2)
    choices: dict[str, float | str] = {"iterations": num_iterations} if method == "sirt" else {}
    result = Volume(volume.contiguous().cpu().numpy(), grid.voxel_size)
    return Outcome(result, predicted.contiguous().cpu().numpy(), method, None, None, choices)
