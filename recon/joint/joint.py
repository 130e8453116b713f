"""The joint fit: a volume and the noise model of its images, learnt together from one noisy tilt series."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import FitResult, Gaussian, fit
from noiseflow.described import described
from noiseflow.kept_memory import kept_memory
from recon.fields.fields import Field, MultiresolutionField
from recon.fields.occupancy import Occupancy
from recon.joint.alternation import SECOND, WARM, Alternation, Progress, frozen
from recon.joint.candidates import first_noise, learns, noise_candidates, num_steps_of
from recon.joint.coarse_start import coarse_start, learning_rate
from recon.joint.signal_model import TomographySignal
from recon.joint.weight import WeightChoice, choose_weight
from recon.projection.defocused_projector import with_defocus
from recon.projection.projector import SliceProjector, from_rays
from recon.series.first_guess import attenuation_scale, contrast_slab, estimate_response
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

_FIRST_WEIGHT = 0.4
_HELD_OUT_TO_CHOOSE = 0.2  # of the pixels: those of a slab are few to tell weights apart
_TOLERATED = 0.003  # nats per pixel
_LOOK_STEPS = 60  # of each candidate: within the tolerance of where it would end
_SLAB, _SLAB_VOXELS = 24, 24 * 96**2  # slices; where they are small, as many as have so many voxels tell weights apart
_RUNG_STEPS = 60  # of the fits that tell weights apart
_WORTHWHILE = 0.4  # share of the lattice that may be occupied; skipping little costs more than it saves


@described(projections="detector units")
@dataclass(frozen=True)
class Reconstruction:
    """What a fit of a volume gives.

    Attributes:
        volume: the clean volume.
        projections: (tilt, y, u) the clean images that the volume predicts, detector units.
        noise_model: the noise model it was fitted with.
        signal_model: field, projector and image formation, as fitted.
        fit_result: held-out likelihood and its history.
        weight_choice: the weights tried and their held-out likelihoods, where the weight was chosen.
    """

    volume: Volume
    projections: NDArray[np.float32]
    noise_model: nn.Module
    signal_model: TomographySignal
    fit_result: FitResult
    weight_choice: WeightChoice | None = None


@described(weight="nats per unit of jump")
@dataclass(frozen=True)
class JointReconstructor:
    """Reconstruct a volume together with the noise model of its images; with a `Gaussian`, plain least squares.

    Everything that needs choosing is chosen by the likelihood of held-out pixels, on a slab of a few slices, before the whole
    volume is fitted once.

    Attributes:
        weight: of the total variation, see `TomographySignal`; None has it chosen.
        noise_model: a noise model to use, learning or not; None chooses a mean-preserving flow behind the detector's
            rounding and rails.
        make_field: makes the field from shape and scale.
        num_steps: steps of the fit.
        estimate_response: whether incident intensity or offset are learnt.
        skip_vacuum: whether voxels are left out where there is nothing; without defocus.
        coarse_to_fine: whether the first half of the steps is taken at half the resolution, where the field knows it and is 96
            voxels wide or more; without defocus.
        defocus: blur to model, pixels per voxel out of the plane of focus, see
            `recon.projection.defocused_projector.DefocusedProjector`.
        slab: slices used to choose; by default 24, or more where a weight is chosen and they are small.
        settled: a signal model fitted to other slices of the same series; its weight, response and scale are kept.
        seed: of every random choice.
        device: where to compute.
        run_fit: runs every fit; `Journal.fit` keeps what each has reached.
    """

    weight: float | None = None
    noise_model: Callable[[], nn.Module] | None = None
    make_field: Callable[..., Field] = MultiresolutionField
    num_steps: int = 200
    estimate_response: bool = True
    skip_vacuum: bool = True
    coarse_to_fine: bool = True
    defocus: float = 0.0
    slab: int | None = None
    settled: TomographySignal | None = None
    seed: int = 0
    device: torch.device | str = "cpu"
    run_fit: Callable[..., FitResult] = fit

    @kept_memory()
    def __call__(
        self, tilt_series: TiltSeries, grid: VolumeGrid | None = None, *, progress: Progress | None = None
    ) -> Reconstruction:
        """Reconstruct on `grid`, by default one voxel per pixel and as deep as wide.

        Raises:
            ValueError: the grid does not match the images, or the fit found no finite step.
        """
        grid = VolumeGrid.of(tilt_series) if grid is None else grid
        signal_model = self.prepare(tilt_series, grid)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            chosen = self._choose(tilt_series, signal_model)
        if chosen.weight_choice is not None:
            signal_model.weight = chosen.weight_choice.weight
        task = self._task(signal_model, tilt_series)
        result = task.begin_and_alternate(
            chosen.first_noise, chosen.noise_model, num_steps=self.num_steps, quiet=chosen.quiet, progress=progress
        )
        return _finished(signal_model, chosen, result, grid)

    def prepare(self, tilt_series: TiltSeries, grid: VolumeGrid) -> TomographySignal:
        """The signal model before any fit: an almost empty field on the scale of the data."""
        _, height, width = tilt_series.images.shape
        if grid.height != height:
            raise ValueError(
                f"the volume is {grid.height} voxels high and the images {height} pixels; they must be equal"
            )
        in_focus = SliceProjector(
            tilt_angles=tilt_series.tilt_angles,
            depth=grid.depth,
            width=grid.width,
            detector_width=width,
            device=self.device,
        )
        projector = with_defocus(in_focus, self.defocus)
        response = estimate_response(tilt_series, estimate=self.estimate_response)
        generator = torch.Generator().manual_seed(self.seed)
        rough = coarse_start(tilt_series, response, grid, generator=generator).to(self.device)
        image_formation: nn.Module = response.to(self.device)
        scale = attenuation_scale(rough)
        weight = _FIRST_WEIGHT if self.weight is None else self.weight
        if self.settled is not None:
            image_formation = copy.deepcopy(self.settled.image_formation).requires_grad_(False)
            scale, weight = float(self.settled.field.scale), self.settled.weight
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            field = self.make_field(grid.shape, scale=scale).to(self.device)
        field.start_from(rough)
        rate = learning_rate(rough, field)
        occupancy = None
        if self.skip_vacuum and projector is in_focus:
            occupancy = Occupancy(rough / field.scale, grid.shape).to(self.device)
            occupancy = occupancy if occupancy.share < _WORTHWHILE else None
        return TomographySignal(
            field, projector, image_formation, weight=weight, learning_rate=rate, occupancy=occupancy
        )

    def _task(
        self, signal_model: TomographySignal, tilt_series: TiltSeries, rows: slice = slice(None), **options: float
    ) -> Alternation:
        observation = _native(tilt_series.images[:, rows], np.float32).to(self.device)
        use = None if tilt_series.mask is None else _native(tilt_series.mask[:, rows], np.bool_).to(self.device)
        return Alternation(
            signal_model,
            observation,
            use,
            self.seed,
            self.run_fit,
            coarse_to_fine=self.coarse_to_fine,
            **options,
        )

    def _num_slices(self, field: Field) -> int:
        """Of the slab: a few cannot tell weights apart where each of them has few pixels."""
        if self.slab is not None:
            return self.slab
        return _SLAB if self.weight is not None else max(_SLAB, -(-_SLAB_VOXELS // (field.depth * field.width)))

    def _choose(self, tilt_series: TiltSeries, whole: TomographySignal) -> _Chosen:
        """Noise model and weight, found on a slab; the response learnt there is where the whole starts."""
        given = None if self.noise_model is None else self.noise_model().to(self.device)
        rows = contrast_slab(tilt_series, self._num_slices(whole.field))
        shape = (whole.field.depth, rows.stop - rows.start, whole.field.width)
        field = self.make_field(shape, scale=float(whole.field.scale)).to(self.device)
        field.start_from(whole.field.volume()[:, rows])
        part = whole.with_field(field)
        part.occupancy = None if whole.occupancy is None else whole.occupancy.rows(rows)
        rough = copy.deepcopy(part.state_dict())
        task = self._task(part, tilt_series, rows, held_out=_HELD_OUT_TO_CHOOSE)
        first = given if isinstance(given, Gaussian) else first_noise(tilt_series.images).to(self.device)
        known = given if self.weight is not None and given is not None and not learns(given) else None
        quiet = task.settle(first, final=first is given, known=known)
        if known is not None:
            return _Chosen(known, None, first, quiet)
        candidates = noise_candidates(tilt_series.images, quiet=quiet) if given is None else [given]
        noise_model = _best_noise_model(task, candidates)
        task.alternate(noise_model, num_steps=60, rate=WARM, standardise=len(candidates) == 1)
        response, choice = copy.deepcopy(part.image_formation.state_dict()), None
        if self.weight is None:
            if not quiet:  # as the whole will begin: from a signal that has settled, fits want more weight
                part.load_state_dict(rough)
                part.image_formation.load_state_dict(response)
                task.begin(first, noise_model, num_steps=self.num_steps)
            held_out = _HeldOut(task, noise_model, WARM if quiet else SECOND)
            with frozen(noise_model):
                choice = choose_weight(held_out, _FIRST_WEIGHT)
            # only now is the signal as good as that of the whole will be: a worse one bends the noise at its bright end
            part.load_state_dict(held_out.likeliest)
            task.refine(noise_model)
        whole.image_formation.load_state_dict(response)
        return _Chosen(noise_model, choice, first, quiet)


@dataclass(frozen=True)
class _Chosen:
    """What a slab tells: the noise model of choice, simple noise to begin with, and whether there is little of it."""

    noise_model: nn.Module
    weight_choice: WeightChoice | None
    first_noise: nn.Module
    quiet: bool


def _best_noise_model(task: Alternation, candidates: Sequence[nn.Module]) -> nn.Module:
    """The simplest that predicts held-out pixels nearly as well as the richest: what a richer one gains beyond may be a bias of
    the signal that it took for noise. One of which no table can be made is left out: it has a peak for every electron, far
    narrower than their distance, to which noise without such peaks was bent. A single candidate is not fitted."""
    *simpler, richest = (model.to(task.observation.device) for model in candidates)
    if not simpler:
        return richest

    def nll(model: nn.Module) -> float:
        result = task.fit(model, known=True, num_steps=num_steps_of(model, _LOOK_STEPS))
        return result.held_out_nll if model is richest or task.can_tabulate(model) else math.inf

    found: dict[nn.Module, float] = {}
    lowest = nll(richest)
    for model in simpler:
        found[model] = nll(model)
        if found[model] <= lowest + _TOLERATED:
            break
    found[richest] = lowest
    good_enough = min(found.values()) + _TOLERATED
    return next(model for model in found if found[model] <= good_enough)


class _HeldOut:
    """Held-out NLL by weight. Every fit begins where the first did: steps that another weight has taken count for none."""

    def __init__(self, task: Alternation, noise_model: nn.Module, rate: float) -> None:
        self.task, self.noise_model, self.rate = task, noise_model, rate
        self.start = self.likeliest = copy.deepcopy(task.signal_model.state_dict())
        self.lowest = math.inf

    def __call__(self, weight: float) -> float:
        signal_model = self.task.signal_model
        signal_model.load_state_dict(self.start)
        signal_model.weight = weight
        history = self.task.fit_signal(self.noise_model, num_steps=_RUNG_STEPS, rate=self.rate).history
        nll = list(history.values())[-1]
        if nll < self.lowest:
            self.lowest, self.likeliest = nll, copy.deepcopy(signal_model.state_dict())
        return nll


def _native(images: NDArray[Any], dtype: Any) -> Tensor:
    """(tilt, y, u) to the projector's order (tilt, u, y)."""
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 2, 1), dtype=dtype))


def _finished(model: TomographySignal, chosen: _Chosen, result: FitResult, grid: VolumeGrid) -> Reconstruction:
    with torch.no_grad():
        volume = Volume(model.volume().cpu().numpy(), grid.voxel_size)
        shape = (model.projector.num_tilts * model.projector.detector_width, model.field.height)
        projections = from_rays(model.signal().view(shape), model.projector.num_tilts).contiguous().cpu().numpy()
    return Reconstruction(volume, projections, chosen.noise_model, model, result, chosen.weight_choice)
