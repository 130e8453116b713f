"""The joint fit: a volume and the noise model of its images, learnt together from one noisy tilt series."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import FitResult, Gaussian
from noiseflow.distributions.picked import needs_image
from noiseflow.kept_memory import kept_memory
from recon.fields.fields import Field, MultiresolutionField
from recon.fields.occupancy import Occupancy
from recon.joint.candidates import first_noise, learns, noise_candidates
from recon.joint.coarse_start import coarse_start, learning_rate
from recon.joint.half_resolution import HalfResolution
from recon.joint.plan import Facts, FitStage, Schedule, plan, total_steps
from recon.joint.run import Progress, RunFit, Runner, run_fit
from recon.joint.signal_model import TomographySignal
from recon.joint.task import Task, block_mask, gap_mask, noise_share
from recon.joint.weight import WeightChoice
from recon.projection.defocused_projector import with_defocus
from recon.projection.image_formation import Linear
from recon.projection.projector import SliceProjector, from_rays
from recon.reconstruction import Reconstruction
from recon.scale.blocks import SETTLED_ON
from recon.series.first_guess import attenuation_scale, contrast_slab, estimate_response
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

_FIRST_WEIGHT = 0.4
_HELD_OUT, _HELD_OUT_TO_CHOOSE = 0.1, 0.2  # of the pixels: those of a slab are few to tell weights apart
_SLAB, _SLAB_VOXELS = 24, 24 * 96**2  # slices; where they are small, as many as have so many voxels tell weights apart
_QUIET = 0.2  # noise relative to contrast: real quiet series and clean phantoms are below 0.08, noisy ones above 0.35
_WORTHWHILE = 0.4  # share of the voxel grid that may be occupied; skipping little costs more than it saves


@dataclass(frozen=True)
class Settled:
    """What a slab has settled for all slices of a series.

    Attributes:
        simple: simple noise to begin with.
        noise_model: the noise model of choice.
        weight: of the regulariser.
        weight_choice: the evidence for it, where it was chosen.
        response: state of the image formation.
        scale: of the field.
        facts: what was known of the series.
        slices: those that it was settled on.
        signal_model: of these slices, as fitted.
        fit_result: of the last fit of them.
    """

    simple: nn.Module
    noise_model: nn.Module
    weight: float
    weight_choice: WeightChoice | None
    response: dict[str, Tensor]
    scale: float
    facts: Facts
    slices: slice
    signal_model: TomographySignal
    fit_result: FitResult


@dataclass(frozen=True)
class JointReconstructor:
    """Reconstruct a volume together with the noise model of its images; with a `Gaussian`, plain least squares.

    Everything that needs choosing is chosen by the likelihood of held-out pixels, on a slab of a few slices; then the whole
    volume is fitted once. `recon.joint.plan.plan` says in which stages.

    Attributes:
        weight: of the regulariser, see `TomographySignal`; None has it chosen.
        noise_model: a noise model to use, learning or not; None chooses a mean-preserving one behind the detector's rounding
            and clipping limits.
        make_field: makes the field from shape and scale.
        num_steps: signal steps of the whole volume; None as the schedule says.
        estimate_response: whether incident intensity or offset are learnt.
        skip_vacuum: whether voxels are left out where there is nothing; without defocus.
        coarse_to_fine: whether the first steps are taken at half the resolution, where the field knows it and is 128 voxels wide
            or more; without defocus.
        defocus: blur to model, pixels per voxel out of the plane of focus, see
            `recon.projection.defocused_projector.DefocusedProjector`.
        slab: slices used to choose; by default 24, or more where they are small.
        schedule: numbers of steps and learning rates.
        seed: of every random choice.
        device: where to compute.
        run_fit: runs every fit; `recon.joint.checkpoint.Journal.fit` keeps what each has reached.
        prefix: of the names under which it does, where one run makes several volumes.
    """

    weight: float | None = None
    noise_model: Callable[[], nn.Module] | None = None
    make_field: Callable[..., Field] = MultiresolutionField
    num_steps: int | None = None
    estimate_response: bool = True
    skip_vacuum: bool = True
    coarse_to_fine: bool = True
    defocus: float = 0.0
    slab: int | None = None
    schedule: Schedule = field(default_factory=Schedule)
    seed: int = 0
    device: torch.device | str = "cpu"
    run_fit: RunFit = field(default=run_fit, repr=False)
    prefix: str = ""

    @kept_memory()
    def __call__(
        self, tilt_series: TiltSeries, grid: VolumeGrid | None = None, *, progress: Progress | None = None
    ) -> Reconstruction:
        """Reconstruct on `grid`, by default one voxel per pixel and as deep as wide.

        Raises:
            ValueError: the grid does not match the images, or the fit found no finite step.
        """
        grid = VolumeGrid.of(tilt_series) if grid is None else grid
        whole = self.signal_model(tilt_series, grid)
        run = self._slab(tilt_series, whole, progress)
        return self._finish(run, tilt_series, grid)

    @kept_memory()
    def settle(self, tilt_series: TiltSeries, grid: VolumeGrid, *, progress: Progress | None = None) -> Settled:
        """Choose noise model, weight and response for all slices of a series, on the slab of most contrast."""
        rows = contrast_slab(tilt_series, self.slab or SETTLED_ON)
        part = tilt_series.rows(rows)
        run = self._slab(part, self.signal_model(part, replace(grid, height=rows.stop - rows.start)), progress)
        return run.settled(rows)

    @kept_memory()
    def fit(
        self, tilt_series: TiltSeries, grid: VolumeGrid, settled: Settled, *, progress: Progress | None = None
    ) -> Reconstruction:
        """Reconstruct some slices under what is settled for all of them."""
        whole = self.signal_model(tilt_series, grid, settled)
        models = {"simple": settled.simple, "chosen": settled.noise_model}
        facts = replace(settled.facts, settled=True, can_halve=settled.facts.can_halve and self._can_halve(whole))
        run = _Run(self, facts, {"whole": self._task(whole, tilt_series, share=_HELD_OUT)}, models, [], progress)
        run.weight_choice = settled.weight_choice
        return self._finish(run, tilt_series, grid)

    def plan(self, tilt_series: TiltSeries, grid: VolumeGrid | None = None) -> tuple[list[FitStage], int]:
        """The stages for a series, and the slices of the slab that choices are made on; arguments as of a call."""
        grid = VolumeGrid.of(tilt_series) if grid is None else grid
        facts, rows, _ = self._facts(tilt_series, self.signal_model(tilt_series, grid))
        return plan(facts, num_steps=self.num_steps, schedule=self.schedule), rows.stop - rows.start

    def signal_model(
        self, tilt_series: TiltSeries, grid: VolumeGrid, settled: Settled | None = None
    ) -> TomographySignal:
        """The signal model before any fit: a coarse reconstruction on the scale of the data."""
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
        scale = attenuation_scale(rough)
        weight = _FIRST_WEIGHT if self.weight is None else self.weight
        if settled is not None:
            response.load_state_dict(settled.response)
            response.requires_grad_(False)
            scale, weight = settled.scale, settled.weight
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            made = self.make_field(grid.shape, scale=scale).to(self.device)
        made.start_from(rough)
        made.check_axes(rough)
        rate = learning_rate(rough, made)
        occupancy = None
        if self.skip_vacuum and projector is in_focus:
            occupancy = Occupancy(rough / made.scale, grid.shape).to(self.device)
            occupancy = occupancy if occupancy.share < _WORTHWHILE else None
        formation = response.to(self.device)
        return TomographySignal(made, projector, formation, weight=weight, learning_rate=rate, occupancy=occupancy)

    def _facts(self, tilt_series: TiltSeries, whole: TomographySignal) -> tuple[Facts, slice, nn.Module | None]:
        """What is known before any fit, the slices that choices are made on, and the noise model that was given."""
        given = None if self.noise_model is None else self.noise_model().to(self.device)
        learning = given is None or (learns(given) and not isinstance(given, Gaussian))
        quiet = learning and noise_share(tilt_series.images) < _QUIET
        described = quiet and given is None  # by a noise model that no fit of the volume sees
        rows = contrast_slab(tilt_series, self._num_slices(whole.field))
        facts = Facts(
            choose_noise=given is None and not described,
            learn_noise=given is None or learns(given),
            simple_is_final=described or isinstance(given, Gaussian),
            quiet=quiet,
            hold_offset=quiet and isinstance(whole.image_formation, Linear),
            choose_weight=self.weight is None,
            can_halve=self._can_halve(whole) and not (given is not None and needs_image(given)),
        )
        return facts, rows, given

    def _slab(self, tilt_series: TiltSeries, whole: TomographySignal, progress: Progress | None) -> _Run:
        """A run whose choices are made."""
        facts, rows, given = self._facts(tilt_series, whole)
        simple = given if facts.simple_is_final and given else first_noise(tilt_series.images).to(self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            candidates = noise_candidates(tilt_series.images, quiet=facts.quiet) if given is None else []
        if facts.quiet and given is None:
            simple, given = Gaussian().to(self.device), candidates[0].to(self.device)
        models = {"simple": simple, "chosen": simple if given is None else given}
        part = self._part(whole, rows)
        to_choose = self._task(part, tilt_series, rows, share=_HELD_OUT_TO_CHOOSE)
        if facts.quiet:
            to_choose.held_out = gap_mask(tilt_series.tilt_angles, to_choose.held_out)
        tasks = {"slab": to_choose, "whole": self._task(whole, tilt_series, share=_HELD_OUT)}
        run = _Run(self, facts, tasks, models, candidates, progress)
        run.choose()
        return run

    def _part(self, whole: TomographySignal, rows: slice) -> TomographySignal:
        shape = (whole.field.depth, rows.stop - rows.start, whole.field.width)
        made = self.make_field(shape, scale=float(whole.field.scale)).to(self.device)
        made.start_from(whole.field.volume()[:, rows])
        part = whole.with_field(made)
        part.occupancy = None if whole.occupancy is None else whole.occupancy.rows(rows)
        return part

    def _task(
        self, model: TomographySignal, tilt_series: TiltSeries, rows: slice = slice(None), *, share: float
    ) -> Task:
        observation = _native(tilt_series.images[:, rows], np.float32).to(self.device)
        use = None if tilt_series.mask is None else _native(tilt_series.mask[:, rows], np.bool_).to(self.device)
        generator = torch.Generator().manual_seed(self.seed)
        held_out = block_mask(tuple(observation.shape), share=share, generator=generator).to(self.device)
        return Task(model, observation, use, held_out)

    def _can_halve(self, model: TomographySignal) -> bool:
        return self.coarse_to_fine and HalfResolution.possible(model)

    def _num_slices(self, made: Field) -> int:
        """Of the slab: a few cannot tell weights apart where each of them has few pixels."""
        if self.slab is not None:
            return self.slab
        return _SLAB if self.weight is not None else max(_SLAB, -(-_SLAB_VOXELS // (made.depth * made.width)))

    def _finish(self, run: _Run, tilt_series: TiltSeries, grid: VolumeGrid) -> Reconstruction:
        """The volume, under what is chosen."""
        result, model = run.fit_whole(), run.runner.tasks["whole"].signal_model
        noise_model = run.noise_model
        with torch.no_grad():
            volume = Volume(model.volume().cpu().numpy(), grid.voxel_size)
            shape = (model.projector.num_tilts * model.projector.detector_width, model.field.height)
            images = from_rays(model.signal().view(shape), model.projector.num_tilts).contiguous().cpu().numpy()
        return Reconstruction(volume, images, "joint", noise_model, result, model, run.weight_choice)


class _Run:
    """A plan with its runner: choices on the slab first, then the volume."""

    def __init__(
        self,
        settings: JointReconstructor,
        facts: Facts,
        tasks: dict[str, Task],
        models: dict[str, nn.Module],
        candidates: list[nn.Module],
        progress: Progress | None,
    ) -> None:
        self.facts = facts
        self.weight_choice: WeightChoice | None = None
        self.stages = plan(facts, num_steps=settings.num_steps, schedule=settings.schedule)
        self.runner = Runner(
            tasks,
            models,
            candidates=candidates,
            first_weight=_FIRST_WEIGHT,
            generator=torch.Generator().manual_seed(settings.seed),
            run_fit=settings.run_fit,
            prefix=settings.prefix,
            expected=total_steps(self.stages),
            progress=progress,
        )

    @property
    def noise_model(self) -> nn.Module:
        """The noise model of choice."""
        simple = self.facts.simple_is_final and not self.facts.quiet
        return self.runner.models["simple" if simple else "chosen"]

    def choose(self) -> None:
        """The stages on the slab; the whole volume starts from the response found there."""
        self.runner.run([stage for stage in self.stages if stage.where == "slab"])
        self.weight_choice = self.runner.weight_choice
        slab, whole = (self.runner.tasks[where].signal_model for where in ("slab", "whole"))
        whole.image_formation.load_state_dict(copy.deepcopy(slab.image_formation.state_dict()))

    def fit_whole(self) -> FitResult:
        """The stages on the whole volume."""
        self.runner.run([stage for stage in self.stages if stage.where == "whole"])
        return self.runner.result

    def settled(self, slices: slice) -> Settled:
        """What the slab has settled."""
        model = self.runner.tasks["slab"].signal_model
        return Settled(
            simple=self.runner.models["simple"],
            noise_model=self.noise_model,
            weight=model.weight,
            weight_choice=self.weight_choice,
            response=copy.deepcopy(model.image_formation.state_dict()),
            scale=float(model.field.scale),
            facts=self.facts,
            slices=slices,
            signal_model=model,
            fit_result=self.runner.result,
        )


def _native(images: NDArray[Any], dtype: Any) -> Tensor:
    """(tilt, y, u) to the projector's order (tilt, u, y)."""
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 2, 1), dtype=dtype))
