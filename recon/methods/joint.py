"""The joint fit of volume and noise model, and fits under given noise: what makes a method of any fit, at once or in blocks."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow import AtLevel, Digitisation, Digitised, Gaussian
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.fitting.contest import mean_and_error
from noiseflow.models.at_level import at_level
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.wrapper import as_noise_model
from noiseflow.progress import Progress
from recon.fields.fields import Field, field_kinds
from recon.fields.kinds.grids import VoxelField
from recon.fields.regularisers import TotalVariation
from recon.fields.regularisers.base import find_regulariser
from recon.joint.checkpoint import run_stage
from recon.joint.joint import HELD_OUT_TO_CHOOSE, OTHERS, JointReconstructor
from recon.joint.plan import FitStage
from recon.joint.run import Settled, run_fit
from recon.joint.signal_model import TomographySignal
from recon.methods._registry import Method, Settings, after_denoising
from recon.names import AUTO
from recon.projection.defocused_projector import BlurredProjector
from recon.projection.image_formation import Linear
from recon.reconstruction import Reconstruction
from recon.scale.blocks import HALO, Block, Blockwise, Images
from recon.series.first_guess import contrast_slab
from recon.series.holdout import Holdout
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from recon.series.views import level_of, lowered_by
from recon.uncertainty.posterior import Posterior

Options = Callable[[Settings], dict[str, Any]]
"""Function from user settings to further options of a `JointReconstructor`."""


def fitted(
    name: str, description: str, options: Options, *, keeps_noise_model: bool = False, refuses: tuple[str, ...] = ()
) -> Method:
    """Create a method that is a joint fit.

    Args:
        options: options of the joint fit, in addition to user settings.
        keeps_noise_model: whether it accepts a calibrated noise model.
        refuses: settings that users cannot change.
    """

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        level = _level(tilt_series, settings)
        lowered = lowered_by(tilt_series, level)
        settings, tried = _with_field(settings, options, lowered, grid)
        result = reconstructor(settings, options)(lowered, grid, progress=settings.progress)
        result = _raised(result, level, chosen="noise_model" not in options(settings))
        return replace(result, method=name, choices=_choices(result, settings, tilt_series) | tried)

    def make_plan(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> tuple[list[FitStage], int, float]:
        fit = reconstructor(settings, options)
        stages, rows, share = fit.plan(tilt_series, grid)
        return trial_stages(fit, settings.field) + stages, rows, share

    def blockwise(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Blockwise:
        level = _level(tilt_series, settings)
        lowered = lowered_by(tilt_series, level)
        settings, tried = _with_field(settings, options, lowered, grid)
        fit = reconstructor(settings, options)
        settled = fit.settle(lowered, grid, progress=settings.progress)
        shared = replace(settled, signal_model=None)  # without matrices, which every worker computes itself
        solve = FittedBlock(fit, shared, grid, level, settings, settled.signal_model)

        def finish(volume: Volume, projections: Images) -> Reconstruction:
            known = settled.noise_model, settled.fit_result, settled.signal_model, settled.weight_choice
            likelihood = settled.simple if settled.facts.quiet else None
            result = Reconstruction(volume, projections, name, *known, likelihood=likelihood)
            result = _raised(result, level, chosen="noise_model" not in options(settings))
            return replace(result, choices=_choices(result, settings, tilt_series) | tried)

        def forget(block: Block) -> None:
            if settings.forget is not None:
                settings.forget(solve.prefix_of(block))

        return Blockwise(solve, finish, HALO, forget, settings.uncertainty)

    return Method(
        name,
        description,
        run,
        fitted=True,
        keeps_noise_model=keeps_noise_model,
        learns_noise=True,
        refuses=("window", "denoiser", *refuses),
        plan=make_plan,
        blockwise=blockwise,
    )


@dataclass(frozen=True)
class FittedBlock:
    """Fits the slices of a block with the choices made for all slices.

    Attributes:
        settled: its choices for all slices.
        level: constant level that is subtracted from the images.
        settings: those of the user; remote workers report no progress, and do not save unfinished blocks.
        near: a signal model whose projector can be reused; None on a remote worker.
    """

    fit: JointReconstructor
    settled: Settled
    grid: VolumeGrid
    level: float
    settings: Settings
    near: TomographySignal | None = None

    def __call__(self, tilt_series: TiltSeries, block: Block) -> tuple[Images, ...]:
        fit, tilt_series = replace(self.fit, prefix=self.prefix_of(block)), lowered_by(tilt_series, self.level)
        grid = replace(self.grid, height=block.wide.stop - block.wide.start)
        projector, progress = None if self.near is None else self.near.projector, self.settings.progress
        found = fit.fit(tilt_series, grid, self.settled, rows=block.wide, projector=projector, progress=progress)
        arrays = found.volume.attenuation, found.projections
        if not self.settings.uncertainty:
            return arrays
        posterior = Posterior(found, tilt_series, self.settings.uncertainty, seed=fit.seed, block=block)
        self.settings.run_stage(f"{fit.prefix}error bars", posterior)
        return *arrays, *posterior.maps(), posterior.sums.powers().astype(np.float32)

    def prefix_of(self, block: Block) -> str:
        """Prefix of the names of the fits of a block."""
        return f"{self.fit.prefix}slices {block.wide.start} to {block.wide.stop - 1}: "

    def __getstate__(self) -> dict[str, Any]:
        """State without objects of this process: progress bar, journal and matrices."""
        plain = replace(self.settings, progress=None, keep=None, forget=None, run_fit=run_fit, run_stage=run_stage)
        return self.__dict__ | {"fit": replace(self.fit, run_fit=run_fit), "settings": plain, "near": None}


def reconstructor(settings: Settings, options: Options) -> JointReconstructor:
    """The joint fit of a method with user settings."""
    names = ("weight", "num_steps", "defocus", "defocus_kernel", "detector_blur", "seed", "device", "run_fit", "prefix")
    shared: dict[str, Any] = {name: getattr(settings, name) for name in names}
    if settings.regulariser is not None:
        shared["regulariser"] = find_regulariser(settings.regulariser)
    if settings.field is not None:
        shared["make_field"] = next(iter(field_kinds(settings.field).values()))
    return JointReconstructor(**(shared | options(settings)))


def _with_field(
    settings: Settings, options: Options, tilt_series: TiltSeries, grid: VolumeGrid
) -> tuple[Settings, dict[str, float | str]]:
    """The settings with the field that ``auto`` chooses, and what it is to tell of the choice."""
    if settings.field != AUTO:
        return settings, {} if settings.field is None else {"field": settings.field}
    if tilt_series.axes is not None:
        raise ValueError("--field auto compares fields on some slices, which two axes share; name a field")
    fit, kinds = reconstructor(settings, options), field_kinds(AUTO)
    name, evidence = choose_field(fit, tilt_series, grid, kinds, progress=settings.progress)
    return replace(settings, field=name), {"field": evidence}


def _level(tilt_series: TiltSeries, settings: Settings) -> float:
    """The constant level to subtract from the images before the fit: that of the darkest hundredth of the pixels of linear
    images, so that electron-counting noise models start near zero, and choices do not depend on an added constant. It is 0 with
    a calibrated noise model, which includes the level, and for saturated integers, which reach the limit of their type."""
    kind = tilt_series.images.dtype
    saturated = np.issubdtype(kind, np.integer) and tilt_series.images.max() == np.iinfo(kind).max
    return 0.0 if settings.noise_model is not None or saturated else level_of(tilt_series, quantile=0.01)


@torch.no_grad()
def _raised(result: Reconstruction, level: float, *, chosen: bool) -> Reconstruction:
    """Convert the result of images with subtracted level to the original units. Noise models that were `chosen` may depend on
    the level. Projections are changed in place."""
    if not level:
        return result
    for image in result.projections:
        image += np.float32(level)
    model, noise_model = result.signal_model, result.noise_model
    if model is not None and isinstance(model.image_formation, Linear):
        response = model.image_formation
        response.scaled_offset.add_(level / float(response.gain * response.offset_unit))
    if chosen and noise_model is not None:
        noise_model = at_level(as_noise_model(noise_model), level)
    # a different likelihood is least squares, which does not depend on the level
    return replace(result, noise_model=noise_model)


def _choices(result: Reconstruction, settings: Settings, tilt_series: TiltSeries) -> dict[str, float | str]:
    model = result.signal_model
    if model is None or result.noise_model is None:
        return {}
    learnt = "intensity" if tilt_series.mode == "transmission" else "offset"
    choices: dict[str, float | str] = {
        "weight": float(model.weight),
        "noise model": _describe(result.noise_model) + ", volume by least squares" * (result.likelihood is not None),
        learnt: float(getattr(model.image_formation, learnt).mean()),
    }
    if blur := float(model.image_formation.blur):  # type: ignore[arg-type]
        choices["detector blur"] = f"{blur:.2g} pixels"
    if bend := float(model.image_formation.bend):  # type: ignore[arg-type]
        choices["response"] = f"bent: {math.exp(-bend):.2g} times as steep at the most matter as without any"
    chosen = [name for name in OTHERS if type(find_regulariser(name)) is type(model.regulariser)]
    if settings.regulariser is not None or chosen:
        choices["regulariser"] = settings.regulariser or chosen[0]
    if settings.defocus:
        blurs = model.projector.blurs if isinstance(model.projector, BlurredProjector) else []
        what = f"blurs up to {blurs[-1]:.2g} pixels" if blurs else "below a quarter of a pixel, ignored"
        choices["defocus"] = f"{settings.defocus:g}, {what}"
    return choices


def _describe(noise_model: nn.Module) -> str:
    if isinstance(noise_model, AtLevel):
        return _describe(noise_model.model)
    if not isinstance(noise_model, Digitised):
        return type(noise_model).__name__
    limits = (noise_model.low, noise_model.high, noise_model.origin)
    found = Digitisation(noise_model.step, *limits, tuple(noise_model.levels.tolist()))
    return f"{_describe(noise_model.model)}, {found.in_words()}"


def _options(settings: Settings, *, required: bool = False) -> dict[str, Any]:
    if settings.noise_model is None:
        if required:
            raise ValueError("--method joint-supervised needs --noise-model FILE; `noiseflow calibrate` makes one")
        return {}
    fixed = settings.noise_model.requires_grad_(False)
    return {"noise_model": lambda: fixed}


class Laplace(NoiseModelBase):
    """Laplace noise with the same width at all signals.

    Args:
        scale: mean absolute deviation, detector units.
    """

    def __init__(self, scale: float = 0.1) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(scale)))

    def forward(self, signal: Tensor) -> NoiseDistribution:
        law = torch.distributions.Laplace(signal, self.log_scale.exp(), validate_args=False)
        return as_noise_distribution(law, like=signal)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the scale to the mean absolute residual of (N,) signals and observations."""
        self.log_scale.copy_(torch.log((observation.double() - signal.double()).abs().mean()))


METHOD = fitted(
    "joint",
    "Volume and noise model together, with everything chosen by the likelihood of held-out pixels.",
    _options,
    keeps_noise_model=True,
)
_L2 = fitted(
    "l2",
    "Least squares, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Gaussian},
)
METHODS = {
    "auto": replace(METHOD, name="auto", description="The joint fit."),
    "joint-supervised": fitted(
        "joint-supervised",
        "The volume of the joint fit under a calibrated noise model that stays as it is.",
        partial(_options, required=True),
        keeps_noise_model=True,
    ),
    "l2": _L2,
    "l1": fitted(
        "l1",
        "Least absolute deviations, with the field and the regulariser of the joint fit.",
        lambda settings: {"noise_model": Laplace},
    ),
    "explicit": fitted(
        "explicit",
        "Least squares on plain voxels without total variation, stopped where held-out pixels are predicted best.",
        lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "weight": 0.0, "held_out": 0.1},
        refuses=("weight", "regulariser", "field"),
    ),
    "tv": fitted(
        "tv",
        "Least squares with total variation on plain voxels.",
        lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "regulariser": TotalVariation()},
        refuses=("regulariser", "field"),
    ),
    "l2-denoised": after_denoising("l2-denoised", "Images denoised one by one, then least squares as of l2.", _L2),
}


def choose_field(
    fit: JointReconstructor,
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    kinds: Mapping[str, type[Field]],
    *,
    progress: Progress | None = None,
) -> tuple[str, str]:
    """Reconstruct the slab with each field, and choose one that predicts left-out tilts best; return it with the evidence.

    Fields differ most in directions that no tilt shows, so the tilts beside the missing wedge are left out; see
    `Holdout.as_missing`. Held-out pixels of all tilts distinguish fields less. Noise model and
    weight are chosen with the first field, grids, and kept for the others, so that only the field differs. Of fields within one
    standard error of the best, the last is chosen, which has the fewest parameters.

    Args:
        tilt_series, grid: data and grid of the whole volume.
        kinds: the fields by name.
    """
    rows = contrast_slab(tilt_series, fit.num_slices(grid))
    slab, slab_grid = tilt_series.rows(rows), replace(grid, height=rows.stop - rows.start)
    tried: dict[str, Tensor] = {}
    # on a slab of 48³ whose volumes have 18.5 (grids), 18.9 (network) and 19.3 dB (Gaussians), the first two are 7 and 2.5
    # standard errors behind by the outermost tilts; by pixels of all tilts, Gaussians are 0.6 behind the network
    left_out, searched = Holdout.as_missing(tilt_series.tilt_angles, HELD_OUT_TO_CHOOSE), fit.weight is None
    for name, kind in kinds.items():
        prefix = f"{fit.prefix}field {name}: "
        weight = fit.weight * kind.relative_weight if searched and fit.weight is not None else fit.weight
        one = replace(fit, make_field=kind, prefix=prefix, weight=weight)
        result, scores, blocks = one.judged(slab, slab_grid, held_out=left_out, progress=progress)
        if not tried:
            fixed = result.likelihood or result.noise_model
            if fixed is not None:
                fit = replace(fit, weight=result.weight, noise_model=partial(fixed.requires_grad_, False))
        tried[name] = scores
    best = max(tried, key=lambda name: float(tried[name].mean()))
    behind = {name: mean_and_error(tried[best] - scores, blocks) for name, scores in tried.items()}
    *_, chosen = (name for name, (excess, error) in behind.items() if name == best or excess <= error < math.inf)
    pairs = {name: mean_and_error(tried[chosen] - scores, blocks) for name, scores in tried.items() if name != chosen}
    others = ", ".join(f"{name} {excess:+.4f} ± {error:.4f}" for name, (excess, error) in pairs.items())
    return chosen, f"{chosen} ({others} nats per pixel of left-out tilts, {slab_grid.height} slices)"


def trial_stages(fit: JointReconstructor, field: str | None) -> list[FitStage]:
    """The stages of the choice, for the plan; none if the field is given."""
    if field != AUTO:
        return []
    steps, count = fit.schedule.whole if fit.num_steps is None else fit.num_steps, len(field_kinds(field))
    return [FitStage("choose field", "fields", "slab", "chosen", steps, rate=fit.schedule.rate, fits=count)]
