"""Reconstruction methods: settings, registry, and the function `reconstruct`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from noiseflow.arguments import takes_fields_of
from noiseflow.described import described
from noiseflow.progress import Progress
from noiseflow.resources import kept_memory
from recon.denoise import find_denoiser
from recon.fields.fields import field_kinds
from recon.fields.regularisers.base import find_regulariser
from recon.joint.checkpoint import Repeated, RunStage, run_stage
from recon.joint.plan import FitStage
from recon.joint.run import RunFit, run_fit
from recon.names import METHODS
from recon.names import method_names as method_names
from recon.projection.classical import WINDOWS
from recon.projection.defocused_projector import KERNELS
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Blockwise, reconstruct_in_blocks
from recon.series.orientation import Orientation
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.series.views import HARMLESS, first_copies
from recon.uncertainty.posterior import error_bars


@described()
@dataclass(frozen=True)
class Settings:
    """User settings of a reconstruction. The method chooses the values of settings that are None.

    Attributes:
        weight: weight of the regulariser, see `recon.joint.signal_model.TomographySignal`; None to choose it by the likelihood
            of held-out pixels. Three times the chosen weight smooths visibly: a smooth object lost 5 dB. The noise model does not
            depend on it.
        regulariser: regulariser of fitted volumes, one of `recon.fields.regularisers.regulariser_names`; None for the default
            of the method.
        field: what the volume is parameterised by, one of `recon.fields.field_names`; ``auto`` chooses it by the likelihood of
            tilts left out; None for the default of the method.
        uncertainty: number of posterior samples for error bars of the volume; 0 for none.
        num_steps: number of steps or iterations.
        noise_model: a fitted noise model that is kept fixed; denoisers take the noise level from it.
        window: window of the back-projection, one of `recon.projection.classical.WINDOWS`.
        denoiser: see `recon.denoise.find_denoiser`; nlm if None.
        defocus: blur in the model of fitted methods, pixels per voxel out of the focal plane.
        detector_blur: standard deviation of the point spread function of the detector, pixels; None to find it.
        defocus_kernel: one of `recon.projection.defocused_projector.KERNELS`.
        progress: called with a task, completed and expected steps, and a note.
        prefix: prefix of the names of fits, if one run makes several volumes.
        keep: function from the prefix to the folder for finished blocks, so that a run can resume; by default they are deleted
            when the volume is complete.
        forget: function that removes the states of fits with a prefix; called when their block is stored.
        run_fit, run_stage: run every fit and every other long computation; a `recon.joint.checkpoint.Journal` saves the states
            and results.

    Raises:
        ValueError: a value is out of range: weight, number of steps, defocus (0 to 1), number of samples (0, or 2 and more); or
            window, regulariser or field is unknown.
    """

    weight: float | None = None
    regulariser: str | None = None
    field: str | None = None
    uncertainty: int = 0
    num_steps: int | None = None
    noise_model: nn.Module | None = None
    window: str | None = None
    denoiser: str | None = None
    defocus: float = 0.0
    detector_blur: float | None = None
    defocus_kernel: str = "depth"
    seed: int = 0
    device: torch.device | str = "cpu"
    progress: Progress | None = None
    prefix: str = ""
    keep: Callable[[str], Path] | None = None
    forget: Callable[[str], None] | None = None
    run_fit: RunFit = run_fit
    run_stage: RunStage = run_stage

    def __post_init__(self) -> None:
        if self.weight is not None and not 0 <= self.weight < np.inf:
            raise ValueError(f"--weight {self.weight} must be zero or more")
        if self.num_steps is not None and self.num_steps < 1:
            raise ValueError(f"--steps {self.num_steps} must be 1 or more")
        if self.detector_blur is not None and not 0 <= self.detector_blur < np.inf:
            raise ValueError(f"--detector-blur {self.detector_blur:g} must be zero or more pixels")
        if not 0 <= self.defocus <= 1:
            raise ValueError(f"--defocus {self.defocus:g}: give 0 to 1, pixels of blur per pixel out of focus")
        if self.defocus_kernel not in KERNELS:
            raise ValueError(f"--defocus-kernel {self.defocus_kernel}: choose {' or '.join(KERNELS)}")
        if self.regulariser is not None:
            find_regulariser(self.regulariser)
        field_kinds(self.field)
        if self.uncertainty < 0 or self.uncertainty == 1:
            raise ValueError(f"--uncertainty {self.uncertainty}: give at least 2 samples (typically 16)")
        if self.window is not None and self.window not in WINDOWS:
            raise ValueError(f"--window {self.window}: choose one of {', '.join(WINDOWS)}")


Run = Callable[[TiltSeries, VolumeGrid, Settings], Reconstruction]
MakePlan = Callable[[TiltSeries, VolumeGrid, Settings], tuple[list[FitStage], int, float]]
SettleBlocks = Callable[[TiltSeries, VolumeGrid, Settings], Blockwise]


_OF_FITS = ("weight", "regulariser", "defocus", "detector-blur", "uncertainty", "field")


@described()
@dataclass(frozen=True)
class Method:
    """A reconstruction method.

    Attributes:
        description: one sentence.
        run: function that reconstructs a series on a grid.
        fitted: whether it fits a volume, supports ``weight`` and ``defocus``, and needs the memory of a fit.
        keeps_noise_model: whether it accepts a calibrated noise model.
        learns_noise: whether its result has a noise model.
        refuses: settings that it does not support.
        plan: function that returns the stages of its fit, the number of slices of the slab, and the share of voxels that are not
            skipped; None if there is no plan.
        blockwise: function that makes the choices for all slices; None if blocks are not supported.
        memory: bytes that it needs besides those for the grid and the images.
        continuous: whether its volume is a field, which has values between voxels; always true of fitted methods.

    Example:
        >>> from recon.methods import find_method
        >>> sirt = find_method("sirt")
        >>> sirt.name, sirt.learns_noise
        ('sirt', False)
    """

    name: str
    description: str
    run: Run
    fitted: bool = False
    keeps_noise_model: bool = False
    learns_noise: bool = False
    refuses: tuple[str, ...] = ()
    plan: MakePlan | None = None
    blockwise: SettleBlocks | None = None
    memory: int = 0
    continuous: bool = False

    def takes(self, setting: str) -> bool:
        """Whether it supports a setting, named as its option on the command line."""
        known = {"noise-model": self.keeps_noise_model, "save-noise-model": self.learns_noise}
        known |= dict.fromkeys(("slices-at-once", "workers", "scheduler"), self.blockwise is not None)
        known |= dict.fromkeys(("voxel-size", "save-field"), self.fitted or self.continuous)
        if setting in known:
            return known[setting]
        return setting not in self.refuses and (self.fitted or setting not in _OF_FITS)

    def more_memory(self, field: str | None = None) -> int:
        """Bytes for the method and the named field besides those for the grid and the images."""
        kinds = field_kinds(field).values() if self.takes("field") else ()
        return self.memory + max((kind.more_memory for kind in kinds), default=0)


@cache
def find_method(name: str) -> Method:
    """Return the method with a given name. Raises ValueError if the name is unknown."""
    found = METHODS.find(name)
    if not isinstance(found, Method):
        raise TypeError(f"method {name} is a {type(found).__name__}; it must be a recon.methods.Method")
    return found


@takes_fields_of(Settings)
def settings_of(method: str, **settings: Any) -> Settings:
    """Check the settings of a method before data are read.

    Args:
        method: one of `method_names`.
        **settings: the attributes of `Settings`.

    Raises:
        ValueError: the method is unknown, or a setting is invalid or not supported.
    """
    chosen = Settings(**settings)
    find_method(method)
    own = ("noise_model", "num_steps", "window", "denoiser", *(name.replace("-", "_") for name in _OF_FITS))
    for name in (name for name in own if getattr(chosen, name) != getattr(Settings, name)):
        require_setting(method, name.removeprefix("num_").replace("_", "-"))
    return chosen


def require_setting(method: str, name: str) -> None:
    """Check that a method supports a setting. Raises ValueError if it does not."""
    if not find_method(method).takes(name):
        able = [other for other in method_names() if find_method(other).takes(name)]
        raise ValueError(
            f"--{name}: method {method} does not support it; use --method {', '.join(able)}, or remove --{name}"
        )


@takes_fields_of(Settings)
@kept_memory()
def reconstruct(
    tilt_series: TiltSeries,
    grid: VolumeGrid | None = None,
    *,
    method: str = "auto",
    slices_at_once: int | None = None,
    scratch: str | Path | None = None,
    client: Any = None,
    **settings: Any,
) -> Reconstruction:
    """Reconstruct a volume from a tilt series.

    Args:
        tilt_series: the images; use `recon.prepare` to align, screen and check raw series.
        grid: voxel grid; by default one voxel per pixel, with a depth equal to the width.
        method: one of `method_names`.
        slices_at_once: reconstruct in blocks of this many slices, to save memory.
        scratch: with `slices_at_once`, a new ``.npy`` or MRC file for the volume, which the result memory-maps.
        client: with `slices_at_once`, a ``dask.distributed.Client`` whose workers reconstruct the blocks; they need access to
            the folder of `scratch`.
        **settings: the attributes of `Settings`, such as ``num_steps``.

    Returns:
        The volume, projections in the order of the tilts, and the response by increasing angle.

    Raises:
        TypeError: a setting is unknown.
        ValueError: the method is unknown, a setting is invalid or not supported, or the grid does not match the images.

    Example:
        >>> import numpy as np, recon
        >>> density = np.pad(np.ones((4, 4, 4)), 6)
        >>> series, unit = recon.clean_tilt_series(density, np.arange(-90, 90, 5.0))
        >>> result = recon.reconstruct(series, recon.VolumeGrid.of(series, 16), method="sirt", num_steps=30)
        >>> bool(recon.compare(result.volume.attenuation, density * unit).psnr > 25)
        True
    """
    grid = VolumeGrid.of(tilt_series) if grid is None else grid
    _require_pixels(tilt_series, grid)
    order = tilt_series.rising
    if (np.diff(order) != 1).any():  # the result must not depend on the order of the tilts
        tilt_series = tilt_series.select(order)
    chosen, found = settings_of(method, **settings), find_method(method)
    if tilt_series.axes is not None:
        require_two_axes(method, blocks=slices_at_once is not None)
    blocks: dict[str, Any] | None = None
    if slices_at_once is not None:
        if slices_at_once < 1:
            raise ValueError(f"--slices-at-once {slices_at_once} must be 1 or more")
        require_setting(method, "slices-at-once")
        if scratch is None:
            raise ValueError("slices_at_once needs scratch, the path of a new .npy file for the volume")
        blocks = {"scratch": Path(scratch), "slices_at_once": slices_at_once, "client": client}
    # fits use duplicate images once; otherwise their noise would count as signal
    first = first_copies(tilt_series) if found.fitted else np.arange(tilt_series.num_tilts)
    kept, place = np.unique(first, return_inverse=True)
    once = tilt_series if len(kept) == len(first) else tilt_series.select(kept)
    orientation = Orientation.of(once)
    once = orientation.series(once.select(slice(None, None, -1)) if orientation.negated else once)
    result, place = _solved(found, once, grid, chosen, blocks).turned(orientation), place[np.argsort(order)]
    if not np.array_equal(place, np.arange(once.num_tilts)):
        result = replace(result, projections=result.projections[place])
    return replace(result, tilts=once.num_tilts - 1 - place if orientation.negated else place)


def _require_pixels(tilt_series: TiltSeries, grid: VolumeGrid) -> None:
    """Check that voxels are as large as pixels. Raises ValueError if they are not."""
    height, pixel = tilt_series.images.shape[1], tilt_series.pixel_size
    if grid.height != height:
        raise ValueError(
            f"the volume is {grid.height} voxels high, and the images {height} pixels; give equal heights, or use sampled() of "
            "the result for other voxels"
        )
    if pixel and grid.voxel_size and abs(grid.voxel_size / pixel - 1) > HARMLESS["pixel size"]:
        raise ValueError(
            f"the grid has voxels of {grid.voxel_size:g} Å and the images pixels of {pixel:g} Å; give a grid of pixels, or use "
            "sampled() of the result for other voxels"
        )


def require_two_axes(method: str, *, blocks: bool) -> None:
    """Raise ValueError if a method does not reconstruct from two tilt axes, or the volume is to be made in blocks of slices."""
    require_setting(method, "second-axis")
    if blocks:
        raise ValueError(
            "--second-axis: rays about the second axis cross all slices, so blocks are not possible; remove "
            "--slices-at-once, --workers and --scheduler, or bin the images if memory does not suffice"
        )


def _solved(
    method: Method, tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings, blocks: dict[str, Any] | None
) -> Reconstruction:
    """The result of a method with its error bars, at once or in blocks."""
    if blocks is not None and method.blockwise is not None:
        folder = None if settings.keep is None else settings.keep(settings.prefix)
        parts = method.blockwise(tilt_series, grid, settings)
        return reconstruct_in_blocks(parts, tilt_series, grid, folder=folder, **blocks)
    result = method.run(tilt_series, grid, settings)
    if not settings.uncertainty:
        return result
    options: dict[str, Any] = {"seed": settings.seed, "run_stage": settings.run_stage, "prefix": settings.prefix}
    return replace(result, uncertainty=error_bars(result, tilt_series, settings.uncertainty, **options))


def after_denoising(name: str, description: str, method: Method) -> Method:
    """A method that applies another one to denoised images; the denoiser takes the noise level from a calibrated model."""

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        denoiser = settings.denoiser or "nlm"
        denoise = find_denoiser(denoiser, tilt_series.images, noise_model=settings.noise_model)

        def clean_next(images: torch.Tensor, number: int) -> torch.Tensor:
            images[number] = torch.from_numpy(np.asarray(denoise(tilt_series.images[number]), dtype=np.float32))
            return images

        cleaned = Repeated(torch.zeros(tilt_series.images.shape), clean_next, tilt_series.num_tilts)
        settings.run_stage("denoising", cleaned)
        result = method.run(replace(tilt_series, images=cleaned.value.numpy()), grid, settings)
        return replace(result, method=name, choices={"denoiser": denoiser, **result.choices})

    return replace(
        method,
        name=name,
        description=description,
        run=run,
        keeps_noise_model=True,
        refuses=tuple(each for each in method.refuses if each != "denoiser"),
        plan=None,
        blockwise=None,
    )
