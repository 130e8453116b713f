"""The joint fit of a volume and the noise model of its images to one noisy tilt series."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised, Gaussian
from noiseflow.distributions.pixels import needs_image
from noiseflow.models.wrapper import as_noise_model
from noiseflow.progress import Progress
from noiseflow.resources import kept_memory
from recon.fields.fields import Field
from recon.fields.kinds.grids import MultiresolutionField
from recon.fields.occupancy import OCCUPIED_MARGIN, Occupancy
from recon.fields.regularisers import find_regulariser
from recon.fields.regularisers.base import Regulariser
from recon.joint.candidates import PixelValues, first_noise, noise_candidates
from recon.joint.coarse_start import Start, learning_rate, start_of
from recon.joint.plan import Facts, FitStage, Schedule, plan
from recon.joint.run import RunFit, Runner, Settled, run_fit
from recon.joint.signal_model import TomographySignal
from recon.joint.task import HalfResolution, Task, block_mask, gap_mask
from recon.names import REGULARISERS
from recon.projection.base import Projector
from recon.projection.dual_axis import projector_of
from recon.reconstruction import Reconstruction
from recon.series.first_guess import attenuation_scale, calm_slab, contrast_slab
from recon.series.holdout import Holdout
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid, central

# The search divides it by the noise-to-contrast ratio, as a step of the signal has more nats the lower the noise. Voxels; the
# best weight decreases with the width: 0.3 at 128³, 0.16 at 256³, 0.1 at 512³, 0.04 at 1000³
_FIRST_WEIGHT, _WIDTH_OF_FIRST = 0.4, 128
# By gaps, misfit decides: near the result of real quiet series (10 and 11)
_QUIET_FIRST = 6.4
HELD_OUT_TO_CHOOSE = 0.2  # share of the pixels of the slab, which has few to distinguish weights
# Slices; more if they are small: this number of voxels suffices to distinguish weights. 16 in place of 24 slices: +0.05 dB in the
# mean of three volumes of 96³, +0.1 dB on shells of 128³ in blocks; 12 slices lose 0.1 dB there and miss a clipping limit
_SLAB, _SLAB_VOXELS = 16, 16 * 96**2
_QUIET = 0.2  # noise-to-contrast ratio: real quiet series and clean phantoms are below 0.08, noisy ones above 0.35
OTHERS = ("second-order",)
"""Regularisers that win by much on some scenes, and are compared with the usual one."""
_WORTHWHILE = 0.4  # largest occupied share for skipping vacuum; above it, skipping costs more than it saves


@dataclass(frozen=True)
class JointReconstructor:
    """Reconstruct a volume jointly with the noise model of its images. With a `Gaussian`, this is least squares.

    Noise model, regularisation weight and regulariser are chosen by the likelihood of held-out pixels on a slab. Then the whole
    volume is fitted once. `recon.joint.plan.plan` defines the stages.

    Attributes:
        weight: weight of the regulariser, see `TomographySignal`; None to choose it automatically.
        noise_model: function that creates the noise model, trainable or not; None to choose a mean-preserving one, wrapped in
            the detected rounding and clipping.
        make_field: function that creates the field from shape and scale.
        regulariser: regulariser of the volume; if None, directional total variation, or the second order where that predicts
            held-out pixels significantly better.
        num_steps: signal steps of the whole volume; None for the number in the schedule.
        estimate_response: whether to fit incident intensity or offset.
        detector_blur: standard deviation of the detector's point spread function, pixels; None to take it from the correlation of
            the noise between neighbours if held-out pixels support it, when the weight is chosen.
        skip_vacuum: whether to skip voxels of vacuum (only without defocus).
        coarse_to_fine: whether to take the first steps at lower resolution, see `Field.halved_from` (only without defocus).
        defocus: blur to model, pixels per voxel out of the focal plane, see
            `recon.projection.defocused_projector.DefocusedProjector`.
        defocus_kernel: ``depth``, or ``image`` for the kernel of Kniesel et al., see
            `recon.projection.defocused_projector.ImageDefocusedProjector`.
        held_out: share of the pixels that fits of the volume leave out, to report their likelihood and to detect a divergence.
        slab: number of slices of the slab; by default 16, or more if slices are small.
        schedule: numbers of steps and learning rates.
        run_fit: runs every fit; `recon.joint.checkpoint.Journal.fit` also stores states and results.
        prefix: prefix of the names of fits, if one run makes several volumes.

    Example:
        >>> import noiseflow, numpy as np, recon
        >>> series, unit = recon.clean_tilt_series(np.pad(np.ones((4, 4, 4)), 6), np.arange(-90, 90, 5.0))
        >>> noisy = recon.add_noise(series, noiseflow.Gaussian(0.02), seed=0)
        >>> fit = recon.JointReconstructor(weight=0.5, noise_model=noiseflow.Gaussian, num_steps=20)
        >>> result = fit(noisy, recon.VolumeGrid.of(noisy, 16))
        >>> result.volume.attenuation.shape, type(result.noise_model).__name__
        ((16, 16, 16), 'Gaussian')
    """

    weight: float | None = None
    noise_model: Callable[[], nn.Module] | None = None
    make_field: Callable[..., Field] = MultiresolutionField
    regulariser: Regulariser | None = None
    num_steps: int | None = None
    estimate_response: bool = True
    detector_blur: float | None = None
    skip_vacuum: bool = True
    coarse_to_fine: bool = True
    defocus: float = 0.0
    defocus_kernel: str = "depth"
    held_out: float = 0.02
    slab: int | None = None
    schedule: Schedule = field(default_factory=Schedule)
    seed: int = 0
    device: torch.device | str = "cpu"
    run_fit: RunFit = field(default=run_fit, repr=False)
    prefix: str = ""

    def __call__(
        self, tilt_series: TiltSeries, grid: VolumeGrid | None = None, *, progress: Progress | None = None
    ) -> Reconstruction:
        """Reconstruct on `grid`; by default one voxel per pixel, with a depth equal to the width. Raises ValueError if the grid
        does not match the images, or the likelihood is never finite."""
        return self.judged(tilt_series, grid, progress=progress)[0]

    @kept_memory()
    def judged(
        self,
        tilt_series: TiltSeries,
        grid: VolumeGrid | None = None,
        *,
        held_out: Holdout | None = None,
        progress: Progress | None = None,
    ) -> tuple[Reconstruction, Tensor, Tensor]:
        """The result of a call, and log-likelihood (P,) and block (P,) of each held-out pixel, for comparisons. With `held_out`,
        those are all pixels of some tilts."""
        grid = VolumeGrid.of(tilt_series) if grid is None else grid
        start = self._start(tilt_series, grid)
        dense, rows = self._slabs(start, tilt_series, grid)
        pixels, model = PixelValues.of(tilt_series.images[:, rows]), self._model(start, tilt_series, grid)
        run = self._chosen(tilt_series, model, dense, pixels, start, progress)
        task = run.tasks["whole"]
        if held_out is not None:
            task.held_out = gap_mask(held_out, task.held_out)
        return self._finish(run, grid), task.held_out_log_prob(run.noise_model), task.blocks()

    @kept_memory()
    def settle(self, tilt_series: TiltSeries, grid: VolumeGrid, *, progress: Progress | None = None) -> Settled:
        """Choose noise model, weight and response for all slices of a series.

        Noise model and weight are chosen on the slab with the highest contrast. The response is fitted to this slab and to the
        one with the lowest contrast, whose vacuum separates a weaker beam from a haze.
        """
        start = self._start(tilt_series, grid)
        dense, rows = self._slabs(start, tilt_series, grid)
        part, first = tilt_series.rows(rows), int(np.searchsorted(rows, dense.start))
        place = slice(first, first + dense.stop - dense.start)
        model = self._model(start, part, replace(grid, height=len(rows)), rows=rows)
        run = self._chosen(part, model, place, PixelValues.of(part.images), start, progress)
        run.fit_whole()
        return Settled.of(run, start)

    @kept_memory()
    def fit(
        self,
        tilt_series: TiltSeries,
        grid: VolumeGrid,
        settled: Settled,
        *,
        rows: slice,
        projector: Projector | None = None,
        progress: Progress | None = None,
    ) -> Reconstruction:
        """Reconstruct some slices with the choices made for all of them.

        Args:
            tilt_series, grid: data and grid of these slices.
            settled: result of `settle` for all slices.
            rows: position of these slices among all.
            projector: projector of the grid, if it exists already.
            progress: called with a task, completed and expected steps, and a note.
        """
        whole = self._model(settled.start, tilt_series, grid, rows=rows, settled=settled, projector=projector)
        # copies, so that a block does not change the start of the next one
        known = {"even": settled.even, "simple": settled.simple, "chosen": settled.noise_model}
        models = {name: copy.deepcopy(model) for name, model in known.items() if model is not None}
        facts = replace(settled.facts, settled=True, halvings=min(settled.facts.halvings, self._halvings(whole)))
        task = self._task(whole, tilt_series)
        run = self._run(facts, {"whole": task}, models, progress, weight_choice=settled.weight_choice)
        if task.stays_empty(run.noise_model):
            run.stages = []
        return self._finish(run, grid)

    def plan(self, tilt_series: TiltSeries, grid: VolumeGrid | None = None) -> tuple[list[FitStage], int, float]:
        """The stages for a series, the number of slices of the slab, and the share of voxels that are not skipped as vacuum.
        Arguments as for a call. Needs only the memory of a few slices."""
        grid = VolumeGrid.of(tilt_series) if grid is None else grid
        start = self._start(tilt_series, grid)
        dense, _ = self._slabs(start, tilt_series, grid)
        part, height = tilt_series.rows(dense), dense.stop - dense.start
        model = self._model(start, part, replace(grid, height=height), rows=dense)
        facts, _ = self._facts(model, start.noise, PixelValues.of(part.images))
        share = self._occupied_share(start, model, grid)
        return self._stages(facts, model.field), height, share * start.wide(grid).width / grid.width

    def signal_model(self, tilt_series: TiltSeries, grid: VolumeGrid) -> TomographySignal:
        """The initial signal model: a coarse reconstruction at the scale of the data."""
        return self._model(self._start(tilt_series, grid), tilt_series, grid)

    def projector(self, tilt_series: TiltSeries, grid: VolumeGrid) -> Projector:
        """Line integrals through any slices of the grid."""
        return projector_of(tilt_series, grid, self.device, self.defocus, self.defocus_kernel)

    def _start(self, tilt_series: TiltSeries, grid: VolumeGrid) -> Start:
        height = tilt_series.images.shape[1]
        if grid.height != height:
            raise ValueError(f"the volume is {grid.height} voxels high and the images {height}; give equal heights")
        one_axis = tilt_series.axes is None and not self.defocus
        return start_of(tilt_series, grid, estimate=self.estimate_response, seed=self.seed, widen=one_axis)

    def _slabs(self, start: Start, tilt_series: TiltSeries, grid: VolumeGrid) -> tuple[slice, NDArray[np.int64]]:
        """The slab with the highest contrast, where choices are made, and its slices with those of the lowest contrast."""
        num_slices = self.num_slices(grid, quiet=start.noise < _QUIET)
        dense = contrast_slab(tilt_series, num_slices)
        slabs = sorted([dense, calm_slab(tilt_series, num_slices, dense)], key=lambda slab: slab.start)
        return dense, np.concatenate([np.arange(slab.start, slab.stop) for slab in slabs])

    def _occupied_share(self, start: Start, model: TomographySignal, grid: VolumeGrid) -> float:
        """The share of voxels of the whole volume that are not skipped as vacuum, counted slab by slab."""
        if not (self.skip_vacuum and model.projector.has_parts):
            return 1.0
        occupied, grid = 0, start.wide(grid)
        for first in range(0, grid.height, _SLAB):
            stop = min(grid.height, first + _SLAB)
            seen = slice(max(0, first - OCCUPIED_MARGIN), min(grid.height, stop + OCCUPIED_MARGIN))
            rough, shape = start.rows(seen) / float(model.field.scale), (grid.depth, seen.stop - seen.start, grid.width)
            mask = Occupancy(rough, shape, least=start.vacuum).mask
            occupied += int(mask[..., first - seen.start : stop - seen.start].sum())
        share = occupied / (grid.depth * grid.height * grid.width)
        return share if share < _WORTHWHILE else 1.0

    def _model(
        self,
        start: Start,
        tilt_series: TiltSeries,
        grid: VolumeGrid,
        *,
        rows: slice | NDArray[np.int64] = slice(None),
        settled: Settled | None = None,
        projector: Projector | None = None,
    ) -> TomographySignal:
        """The signal model of all slices, or of some `rows` of those in `start`."""
        grid = start.wide(grid)
        projector = self.projector(tilt_series, grid) if projector is None else projector
        rough = start.rough.to(self.device)
        scale = attenuation_scale(rough)
        weight = _first_weight(grid.width) if self.weight is None else self.weight
        regulariser = find_regulariser(REGULARISERS.first) if self.regulariser is None else self.regulariser
        response = copy.deepcopy(start.response)
        response.blur.fill_(self.detector_blur or 0.0)
        if settled is not None:
            response.load_state_dict(settled.response)
            response.requires_grad_(False)
            scale, weight, regulariser = settled.scale, settled.weight, settled.regulariser
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            made = self.make_field(grid.shape, scale=scale).to(self.device)
        made.voxel_size = grid.voxel_size
        rate = learning_rate(rough, made)
        rough = start.rows(rows).to(self.device)
        made.start_from(rough)
        if rough.shape == grid.shape:
            made.check_axes(rough)
        occupancy = None
        if self.skip_vacuum and projector.has_parts:
            occupancy = Occupancy(rough / made.scale, grid.shape, least=start.vacuum).to(self.device)
            occupancy = occupancy if occupancy.share < _WORTHWHILE else None
        kept: dict[str, Any] = {"weight": weight, "regulariser": regulariser, "learning_rate": rate}
        return TomographySignal(made, projector, response.to(self.device), occupancy=occupancy, **kept)

    def _facts(self, whole: TomographySignal, noise: float, readings: PixelValues) -> tuple[Facts, nn.Module | None]:
        """The facts before any fit, and the given noise model; `noise` is that of all slices."""
        given = None if self.noise_model is None else self.noise_model().to(self.device)
        if given is not None and needs_image(given):
            raise ValueError(
                "the noise model has maps, rows or neighbours, but the fit takes single pixels; correct images by maps "
                "(WithMaps.correct) and give noise_model.without_converter(), or a model of single pixels"
            )
        quiet = noise < _QUIET and not isinstance(given, Gaussian)
        simple_is_final = quiet or isinstance(given, Gaussian)
        first = first_noise(readings.digitisation, readings.saturated)
        facts = Facts(
            choose_noise=given is None and not quiet,
            learn_noise=given is None or quiet or as_noise_model(given).learns,
            simple_is_final=simple_is_final,
            quiet=quiet,
            by_gaps=noise < _QUIET,
            clipped=isinstance(first, Digitised) and not simple_is_final,
            choose_weight=self.weight is None,
            halvings=self._halvings(whole),
        )
        return facts, given

    def _chosen(
        self,
        tilt_series: TiltSeries,
        whole: TomographySignal,
        rows: slice,
        readings: PixelValues,
        start: Start,
        progress: Progress | None,
    ) -> Runner:
        """A run that has made its choices on some `rows`."""
        facts, given = self._facts(whole, start.noise, readings)
        found, saturated = readings.digitisation, readings.saturated
        simple = given if isinstance(given, Gaussian) else first_noise(found, saturated).to(self.device)

        def candidates(task: Task, signal: Tensor) -> list[nn.Module]:
            digitisation = readings.given(task.observation, signal, task.use)
            clipped = saturated + float((task.observation <= digitisation.low).float().mean())
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self.seed)
                return noise_candidates(digitisation, clipped)

        if facts.quiet:  # the noise model is fitted after the volume
            simple = Gaussian().to(self.device)
            given = given or noise_candidates(found, saturated, quiet=True)[0].to(self.device)
        models = {"simple": simple, "chosen": simple if given is None else given}
        part = self._part(whole, rows)
        if facts.quiet or not facts.simple_is_final:
            # a noise model learnt at a weight that the data contradict would describe what that weight smooths away
            part.weight = _first_weight(whole.field.width)
        to_choose = self._task(part, tilt_series, rows, share=HELD_OUT_TO_CHOOSE)
        if facts.by_gaps:
            to_choose.held_out = gap_mask(Holdout.two_gaps(tilt_series.tilt_angles), to_choose.held_out)
        run = self._run(
            facts,
            {"slab": to_choose, "whole": self._task(whole, tilt_series)},
            models,
            progress,
            candidates=candidates,
            first_weight=_QUIET_FIRST if facts.by_gaps else _first_weight(whole.field.width) / start.noise,
            least_vacuum=start.vacuum,
            least_signal=readings.least_signal,
            find_blur=self.detector_blur is None,
            regularisers=[find_regulariser(name) for name in OTHERS] if self.regulariser is None else [],
        )
        run.choose()
        return run

    def _run(
        self,
        facts: Facts,
        tasks: dict[str, Task],
        models: dict[str, nn.Module],
        progress: Progress | None,
        **known: Any,
    ) -> Runner:
        field = tasks["whole"].signal_model.field
        return Runner(
            facts,
            self._stages(facts, field),
            tasks,
            models,
            generator=torch.Generator().manual_seed(self.seed),
            run_fit=self.run_fit,
            prefix=self.prefix,
            progress=progress,
            **known,
        )

    def _stages(self, facts: Facts, field: Field) -> list[FitStage]:
        return plan(facts, num_steps=self.num_steps, usual=field.num_steps, schedule=self.schedule)

    def _part(self, whole: TomographySignal, rows: slice) -> TomographySignal:
        shape = (whole.field.depth, rows.stop - rows.start, whole.field.width)
        # grids for every field: others cost more, and after the steps of a trial they would choose too small a weight
        made = MultiresolutionField(shape, scale=float(whole.field.scale)).to(self.device)
        made.start_from(whole.field.volume()[:, rows])
        occupancy = None if whole.occupancy is None else whole.occupancy.rows(rows)
        part = whole.like(made, whole.projector, occupancy=occupancy)
        part.image_formation = copy.deepcopy(whole.image_formation)
        return part

    def _task(
        self, model: TomographySignal, tilt_series: TiltSeries, rows: slice = slice(None), share: float | None = None
    ) -> Task:
        observation = _native(tilt_series.images[:, rows], np.float32).to(self.device)
        use = None if tilt_series.mask is None else _native(tilt_series.mask[:, rows], np.bool_).to(self.device)
        generator = torch.Generator().manual_seed(self.seed)
        share = self.held_out if share is None else share
        held_out = block_mask(tuple(observation.shape), share=share, generator=generator)
        return Task(model, observation, use, held_out.to(self.device))

    def _halvings(self, model: TomographySignal) -> int:
        return HalfResolution.times(model) if self.coarse_to_fine else 0

    def num_slices(self, grid: VolumeGrid, *, quiet: bool = False) -> int:
        """Number of slices of the slab. Small slices need more to distinguish weights, and gaps of tilts need twice as many
        voxels."""
        if self.slab is not None:
            return self.slab
        if self.weight is not None:
            return 2 * _SLAB  # from 16 slices of a needle of 64², a gain of 1 was measured as 0.92
        voxels = 2 * _SLAB_VOXELS if quiet else _SLAB_VOXELS
        return max(_SLAB, -(-voxels // (grid.depth * grid.width)))

    def _finish(self, run: Runner, grid: VolumeGrid) -> Reconstruction:
        """Fit the volume with the choices made, and return it on the grid of the user."""
        result, model, noise_model = run.fit_whole(), run.tasks["whole"].signal_model, run.noise_model
        model.field.occupied = None if model.occupancy is None else model.occupancy.mask
        model.field.margin = (model.field.width - grid.width) // 2
        volume = Volume(central(model.volume(), grid.width).cpu().numpy(), model.field.voxel_size)
        found = Reconstruction(volume, model.images(), "joint", noise_model, result, model, run.weight_choice)
        return found if run.likelihood is noise_model else replace(found, likelihood=run.likelihood)


def _first_weight(width: int) -> float:
    """Initial weight of the regulariser."""
    return _FIRST_WEIGHT * min(1.0, _WIDTH_OF_FIRST / width)


def _native(images: NDArray[Any], dtype: Any) -> Tensor:
    """Convert (tilt, y, u) to the projector's order (tilt, u, y)."""
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 2, 1), dtype=dtype))
