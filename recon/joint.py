"""The joint fit: a volume and the noise model of its images, learnt together from one noisy tilt series."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import FitResult, Gaussian, fit
from noiseflow.described import described
from recon.candidates import learns, noise_candidates, num_steps_of, rate_of
from recon.coarse_start import coarse_start, learning_rate
from recon.defocused_projector import with_defocus
from recon.fields import Field, MultiresolutionField
from recon.first_guess import attenuation_scale, contrast_slab, estimate_response
from recon.occupancy import Occupancy
from recon.projector import SliceProjector, from_rays
from recon.signal_model import TomographySignal
from recon.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.weight import WeightChoice, choose_weight

Progress = Callable[[int, str], None]
_FIRST_WEIGHT = 0.4
_TOLERATED = 0.003
_SETTLING, _SETTLED = (40, 80, 160, 320), 0.03  # steps of least squares; nats per pixel
_FIRST_TURN, _NEXT_TURN = 0.6, 0.5  # share of the steps; learning rate relative to the turn before
_MOST_TURNS = 6
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
        defocus: blur to model, pixels per voxel out of the plane of focus, see `recon.defocused_projector.DefocusedProjector`.
        slab: slices used to choose.
        settled: a signal model fitted to other slices of the same series; its weight, response and scale are kept.
        seed: of every random choice.
        device: where to compute.
        run_fit: runs every fit; `Journal.fit` keeps what each has reached.
    """

    weight: float | None = None
    noise_model: Callable[[], nn.Module] | None = None
    make_field: Callable[..., Field] = MultiresolutionField
    num_steps: int = 120
    estimate_response: bool = True
    skip_vacuum: bool = True
    defocus: float = 0.0
    slab: int = 24
    settled: TomographySignal | None = None
    seed: int = 0
    device: torch.device | str = "cpu"
    run_fit: Callable[..., FitResult] = fit

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
            noise_model, choice, quiet = self._choose(tilt_series, signal_model)
        if choice is not None:
            signal_model.weight = choice.weight
        task = self._task(signal_model, tilt_series)
        if quiet and not isinstance(noise_model, Gaussian):
            task.settle(thoroughly=True, progress=progress)
        result = task.alternate(noise_model, num_steps=self.num_steps, progress=progress)
        return _finished(signal_model, noise_model, result, grid, choice)

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

    def _task(self, signal_model: TomographySignal, tilt_series: TiltSeries, rows: slice = slice(None)) -> _Task:
        observation = _native(tilt_series.images[:, rows], np.float32).to(self.device)
        use = None if tilt_series.mask is None else _native(tilt_series.mask[:, rows], np.bool_).to(self.device)
        return _Task(signal_model, observation, use, self.seed, self.run_fit)

    def _choose(self, tilt_series: TiltSeries, whole: TomographySignal) -> tuple[nn.Module, WeightChoice | None, bool]:
        """Noise model and weight, found on a slab like the response at the start, and whether there is little noise."""
        given = None if self.noise_model is None else self.noise_model().to(self.device)
        rows = contrast_slab(tilt_series, self.slab)
        shape = (whole.field.depth, rows.stop - rows.start, whole.field.width)
        field = self.make_field(shape, scale=float(whole.field.scale)).to(self.device)
        field.start_from(whole.field.volume()[:, rows])
        part = whole.with_field(field)
        part.occupancy = None if whole.occupancy is None else whole.occupancy.rows(rows)
        task = self._task(part, tilt_series, rows)
        quiet = task.settle()
        if given is not None and self.weight is not None and not learns(given):
            return given, None, quiet
        noise_model = given if given is not None else _best_noise_model(task, noise_candidates(tilt_series.images))
        task.alternate(noise_model, num_steps=80, standardise=given is not None)
        task.refine(noise_model)
        choice = None
        with _frozen(noise_model):
            if self.weight is None:
                choice = choose_weight(lambda weight: _held_out_nll(task, noise_model, weight), _FIRST_WEIGHT)
            else:
                task.fit(noise_model, num_steps=80, standardise=False)
        # only now is the signal as good as the fit of the whole will begin with: a worse one bends the noise at its bright end
        task.refine(noise_model)
        whole.image_formation.load_state_dict(part.image_formation.state_dict())
        return noise_model, choice, quiet


class _Task:
    """A signal model with its observations, those of them to use, and the pixels that judge it."""

    def __init__(
        self,
        signal_model: TomographySignal,
        observation: Tensor,
        use: Tensor | None,
        seed: int,
        run_fit: Callable[..., FitResult],
    ) -> None:
        self.signal_model, self.observation, self.use, self.run_fit = signal_model, observation, use, run_fit
        self.generator = torch.Generator().manual_seed(seed)
        self.held_out = block_mask(observation.shape, generator=self.generator).to(observation.device)

    def fit(self, noise_model: nn.Module, *, known: bool = False, **options: Any) -> FitResult:
        """Fit volume and noise model; with `known`, the noise model alone on the signal as it is."""
        signal: Tensor | nn.Module = self.signal_model
        if known:
            with torch.no_grad():
                signal = self.signal_model.signal().view_as(self.observation)
        options = {"batch_size": 4096, "learning_rate": rate_of(noise_model)} | options
        options |= {"mask": self.use, "held_out": self.held_out, "generator": self.generator, "digitise": False}
        return self.run_fit(noise_model, signal, self.observation, **options)

    def settle(self, *, thoroughly: bool = False, progress: Progress | None = None) -> bool:
        """Least squares, longer and longer until held-out pixels gain little: what an unfinished signal misses would pass for
        noise, and be left as it is. Returns whether it took long, as it does where there is little noise; then `thoroughly`
        goes all the way, by smaller and smaller steps, as large ones may stop gaining long before the end."""
        reached, rate = math.inf, self.signal_model.learning_rate
        for num_steps in _SETTLING:
            nll = self.fit(Gaussian().to(self.observation.device), num_steps=num_steps, progress=progress).held_out_nll
            if thoroughly:
                self.signal_model.learning_rate *= _NEXT_TURN
            elif reached - nll < _SETTLED:
                break
            reached = nll
        self.signal_model.learning_rate = rate
        return num_steps > _SETTLING[1]

    def alternate(
        self, noise_model: nn.Module, *, num_steps: int, standardise: bool = False, progress: Progress | None = None
    ) -> FitResult:
        """Fit the signal to the noise model as it is, and the noise model to the signal as it is, by turns: twice, and on while
        held-out pixels gain much, as they do where there is little noise.

        Each turn ends at a small learning rate, and the next starts at a smaller one: the incident intensity would overshoot
        again, and comes back slowly. Learning both at once from a rough start lets the mean of a heavy-tailed noise
        wander with the few outliers of each batch, and drags the signal along.

        Args:
            noise_model: fitted in place.
            num_steps: of the signal, the first two turns together.
            standardise: fit the noise model from scratch first.
            progress: called with the steps done and a note.
        """
        if standardise:
            self.refine(noise_model, standardise=True)
        rate, done, reached = self.signal_model.learning_rate, 0, math.inf
        for turn in range(_MOST_TURNS):
            share = _FIRST_TURN if turn == 0 else 1 - _FIRST_TURN
            later = None if progress is None else partial(_continue, progress, done)
            self.signal_model.learning_rate = rate * _NEXT_TURN**turn
            with _frozen(noise_model):
                result = self.fit(noise_model, num_steps=round(share * num_steps), standardise=False, progress=later)
            done += result.num_steps
            if turn > 0 and reached - result.held_out_nll < _SETTLED:
                break
            reached = result.held_out_nll
            self.refine(noise_model)
        self.signal_model.learning_rate = rate
        return result

    def refine(self, noise_model: nn.Module, *, standardise: bool = False) -> None:
        """Fit a noise model that learns to the signal as it is."""
        if learns(noise_model):
            self.fit(noise_model, known=True, num_steps=num_steps_of(noise_model, 60), standardise=standardise)


def _best_noise_model(task: _Task, candidates: Sequence[nn.Module]) -> nn.Module:
    """The simplest that predicts held-out pixels nearly as well as the best: what a richer one gains beyond may be a bias of the
    signal that it took for noise."""
    device = task.observation.device
    nll = [
        task.fit(model.to(device), known=True, num_steps=num_steps_of(model, 100)).held_out_nll for model in candidates
    ]
    return next(model for model, each in zip(candidates, nll, strict=True) if each <= min(nll) + _TOLERATED)


def _continue(progress: Progress, done: int, step: int, note: str) -> None:
    progress(done + step, note)


def _held_out_nll(task: _Task, noise_model: nn.Module, weight: float) -> float:
    task.signal_model.weight = weight
    history = task.fit(noise_model, num_steps=100, standardise=False).history
    return list(history.values())[-1]


@contextmanager
def _frozen(model: nn.Module) -> Iterator[None]:
    learning = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)


def block_mask(shape: tuple[int, ...], *, share: float = 0.1, block: int = 4, generator: torch.Generator) -> Tensor:
    """Pixels (tilt, u, y) to hold out: whole blocks in every image, so that neighbours do not give them away."""
    tilts, *sides = shape
    coarse = torch.rand((tilts, *(-(-side // block) for side in sides)), generator=generator) < share
    return coarse.repeat_interleave(block, 1).repeat_interleave(block, 2)[:, : sides[0], : sides[1]]


def _native(images: NDArray[Any], dtype: Any) -> Tensor:
    """(tilt, y, u) to the projector's order (tilt, u, y)."""
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 2, 1), dtype=dtype))


def _finished(
    model: TomographySignal, noise_model: nn.Module, result: FitResult, grid: VolumeGrid, choice: WeightChoice | None
) -> Reconstruction:
    with torch.no_grad():
        volume = Volume(model.volume().cpu().numpy(), grid.voxel_size)
        shape = (model.projector.num_tilts * model.projector.detector_width, model.field.height)
        projections = from_rays(model.signal().view(shape), model.projector.num_tilts).contiguous().cpu().numpy()
    return Reconstruction(volume, projections, noise_model, model, result, choice)
