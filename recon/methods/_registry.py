"""What a method of reconstruction is, and how one is found by its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from noiseflow.described import described
from noiseflow.distributions.picked import needs_image
from noiseflow.kept_memory import kept_memory
from noiseflow.plugins import load_plugin, plugins
from recon.fields.regularisers._registry import find_regulariser
from recon.joint.plan import FitStage
from recon.joint.run import Progress, RunFit, run_fit
from recon.joint.stages import RunStage, run_stage
from recon.methods._names import GROUP, method_names
from recon.projection.wbp import WINDOWS
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Blockwise
from recon.scale.running import reconstruct_in_blocks
from recon.series.orientation import Orientation
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.series.views import first_copies


@described()
@dataclass(frozen=True)
class Settings:
    """What a user may settle; whatever is None the method chooses by itself.

    Attributes:
        weight: of the regulariser, see `recon.joint.signal_model.TomographySignal`.
        regulariser: what a fitted volume is expected to look like, one of `recon.fields.regularisers.regulariser_names`; None as
            the method has it.
        uncertainty: samples that error bars of the volume come from; 0 for none.
        num_steps: steps or iterations.
        noise_model: a fitted noise model to keep as it is; denoisers take the noise level from it.
        window: of the back-projection, one of `recon.projection.wbp.WINDOWS`.
        denoiser: see `recon.denoise.denoisers.find_denoiser`; nlm if None.
        defocus: blur that fitted methods model, pixels per voxel out of the plane of focus.
        seed: of every random choice.
        device: where to compute.
        progress: called with the steps done, those expected, and a note.
        prefix: of the names of fits, where one run makes several volumes.
        keep: gives the folder in which finished blocks are kept for a run that resumes; by default they are kept until the volume
            is whole. It is called with the prefix.
        forget: removes what fits of a prefix have reached, called when their block is kept.
        run_fit, run_stage: run every fit and every other long piece of work; a `recon.joint.checkpoint.Journal` keeps what each
            has reached.

    Raises:
        ValueError: a negative weight, no steps, a defocus outside 0 to 1, an unknown window or regulariser, or one sample.
    """

    weight: float | None = None
    regulariser: str | None = None
    uncertainty: int = 0
    num_steps: int | None = None
    noise_model: nn.Module | None = None
    window: str | None = None
    denoiser: str | None = None
    defocus: float = 0.0
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
        if not 0 <= self.defocus <= 1:
            raise ValueError(f"--defocus {self.defocus:g}: give 0 to 1, pixels of blur per pixel out of focus")
        if self.regulariser is not None:
            find_regulariser(self.regulariser)
        if self.uncertainty < 0 or self.uncertainty == 1:
            raise ValueError(f"--uncertainty {self.uncertainty}: a spread needs at least 2 samples; 16 are usual")
        if self.window is not None and self.window not in WINDOWS:
            raise ValueError(f"--window {self.window}: choose one of {', '.join(WINDOWS)}")


Run = Callable[[TiltSeries, VolumeGrid, Settings], Reconstruction]
MakePlan = Callable[[TiltSeries, VolumeGrid, Settings], tuple[list[FitStage], int, float]]
SettleBlocks = Callable[[TiltSeries, VolumeGrid, Settings], Blockwise]


_OF_FITS = ("weight", "regulariser", "defocus", "uncertainty")


@described()
@dataclass(frozen=True)
class Method:
    """A method of reconstruction.

    Attributes:
        name: as users give it.
        description: one sentence.
        run: reconstructs a series on a grid.
        fitted: whether it fits a volume, and so knows ``weight``, ``defocus`` and what a fit takes of memory.
        keeps_noise_model: whether it takes a calibrated noise model; another refuses one.
        learns_noise: whether its result has a noise model.
        refuses: settings that it has no use for, or that are part of it.
        plan: the stages of its fit, the slices of the slab that choices are made on, and the share of the voxels that are not
            skipped; None where nothing is planned.
        blockwise: settles what all slices share; None where slices cannot be reconstructed apart.

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

    def takes(self, setting: str) -> bool:
        """Whether it has a use for a setting."""
        return setting not in self.refuses and (self.fitted or setting not in _OF_FITS)


_Run = Callable[[TiltSeries, VolumeGrid, Settings], Reconstruction]


@cache
def find_method(name: str) -> Method:
    """The method of a name.

    Raises:
        ValueError: there is none.
    """
    if name not in method_names():
        raise ValueError(f"--method {name}: choose one of {', '.join(method_names())}")
    other = plugins(GROUP).get(name)
    found = import_module(f"recon.methods.{name.replace('-', '_')}").METHOD if other is None else load_plugin(other)
    if not isinstance(found, Method):
        raise TypeError(f"method {name} is a {type(found).__name__}; a method is a recon.methods.Method")
    return found


def settings_of(method: str, **settings: Any) -> Settings:
    """The settings of a method, checked before there are data.

    Args:
        method: one of `method_names`.
        **settings: the attributes of `Settings`.

    Raises:
        ValueError: an unknown method, or settings that make no sense.
    """
    chosen, found = Settings(**settings), find_method(method)
    if chosen.noise_model is not None and not found.keeps_noise_model:
        able = [name for name in method_names() if find_method(name).keeps_noise_model]
        raise ValueError(f"--noise-model: method {method} takes none; use --method {', '.join(able)}")
    given = {
        "defocus": bool(chosen.defocus),
        "weight": chosen.weight is not None,
        "regulariser": chosen.regulariser is not None,
        "uncertainty": bool(chosen.uncertainty),
        "steps": chosen.num_steps is not None,
        "window": chosen.window is not None,
        "denoiser": chosen.denoiser is not None,
    }
    for name in (name for name, is_given in given.items() if is_given and not found.takes(name)):
        able = [other for other in method_names() if find_method(other).takes(name)]
        raise ValueError(f"--{name}: method {method} has no use for it; use --method {', '.join(able)}")
    return chosen


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
        tilt_series: the images; `recon.prepare` aligns, screens and checks raw ones.
        grid: voxels and their size; by default one voxel per pixel and as deep as wide.
        method: one of `method_names`.
        slices_at_once: reconstruct in blocks of so many slices, where memory is short.
        scratch: with `slices_at_once`, a new ``.npy`` or MRC file that holds the volume; the result maps it to memory.
        client: with `slices_at_once`, a ``dask.distributed.Client`` whose workers reconstruct the blocks; they must see the
            folder of `scratch`.
        **settings: the attributes of `Settings`.

    Returns:
        The volume, projections in the order of the tilts, and the response by rising angle.

    Raises:
        ValueError: an unknown method, settings that make no sense, or a grid that does not match the images.

    Example:
        >>> import numpy as np, recon
        >>> density = np.zeros((16, 16, 16))
        >>> density[6:10, 6:10, 6:10] = 1.0
        >>> series, unit = recon.clean_tilt_series(density, np.arange(-90, 90, 5.0))
        >>> result = recon.reconstruct(series, recon.VolumeGrid.of(series, 16), method="sirt", num_steps=30)
        >>> bool(recon.compare(result.volume.attenuation, density * unit).psnr > 25)
        True
    """
    grid = VolumeGrid.of(tilt_series) if grid is None else grid
    order = np.argsort(tilt_series.tilt_angles, kind="stable")
    if (np.diff(order) != 1).any():  # the order of the tilts must not change the volume by a bit
        result = reconstruct(
            tilt_series.select(order),
            grid,
            method=method,
            slices_at_once=slices_at_once,
            scratch=scratch,
            client=client,
            **settings,
        )
        return replace(result, projections=result.projections[np.argsort(order)])
    chosen, found = settings_of(method, **settings), find_method(method)
    run: _Run = partial(_at_once, found)
    if slices_at_once is not None:
        if slices_at_once < 1:
            raise ValueError(f"--slices-at-once {slices_at_once} must be 1 or more")
        if found.blockwise is None:
            able = [name for name in method_names() if find_method(name).blockwise is not None]
            raise ValueError(f"--slices-at-once does not know --method {method}: choose {', '.join(able)}")
        if scratch is None:
            raise ValueError("slices_at_once needs scratch, the path of a new .npy file that holds the volume")
        blocks: dict[str, Any] = {"scratch": Path(scratch), "slices_at_once": slices_at_once, "client": client}
        run = partial(_in_blocks, found.blockwise, blocks)
    if chosen.noise_model is not None and needs_image(chosen.noise_model):
        return _of_distinct_tilts(
            run, found, tilt_series, grid, chosen
        )  # maps of the detector's pixels stay where they are
    orientation = Orientation.of(tilt_series)
    rising = tilt_series.select(slice(None, None, -1)) if orientation.negated else tilt_series
    return _of_distinct_tilts(run, found, orientation.series(rising), grid, chosen).turned(orientation)


def _of_distinct_tilts(
    run: _Run, method: Method, tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings
) -> Reconstruction:
    """Run a method on a series by rising angle; a fit sees copies once, or their noise would count as signal."""
    first = first_copies(tilt_series) if method.fitted else np.arange(tilt_series.num_tilts)
    kept, place = np.unique(first, return_inverse=True)
    seen = tilt_series if len(kept) == len(first) else tilt_series.select(kept)
    result = run(seen, grid, settings)
    return result if seen is tilt_series else replace(result, projections=result.projections[place])


def _at_once(method: Method, tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
    result = method.run(tilt_series, grid, settings)
    return _with_error_bars(result, tilt_series, settings) if settings.uncertainty else result


def _in_blocks(
    blockwise: SettleBlocks,
    blocks: dict[str, Any],
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    settings: Settings,
) -> Reconstruction:
    folder = None if settings.keep is None else settings.keep(settings.prefix)
    return reconstruct_in_blocks(blockwise(tilt_series, grid, settings), tilt_series, grid, folder=folder, **blocks)


def _with_error_bars(result: Reconstruction, tilt_series: TiltSeries, settings: Settings) -> Reconstruction:
    from recon.uncertainty.posterior import error_bars

    options: dict[str, Any] = {"seed": settings.seed, "run_stage": settings.run_stage, "prefix": settings.prefix}
    return replace(result, uncertainty=error_bars(result, tilt_series, settings.uncertainty, **options))
