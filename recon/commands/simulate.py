"""The command `noiseflow simulate`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import noiseflow
from noiseflow.commands.console import JsonOption, Output, OverwriteOption, SeedOption, completed, with_options
from noiseflow.progress import progress_shown
from recon.commands.options import parse_mode

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import nn

    from recon.simulate.simulation import Acquisition

_PHANTOMS = ("shells", "virions", "cell", "filaments", "particles", "slab", "atoms", "texture", "catalyst")


@dataclass(frozen=True)
class SimulateOptions:
    """Arguments and options of the command."""

    folder: Annotated[Path, typer.Argument(help="Folder for tilts.mrc (noisy), clean, validation, test and truth.mrc.")]
    size: Annotated[int, typer.Option(help="Voxels along each edge.")] = 64
    tilts: Annotated[str, typer.Option(help="Tilts START:STOP:STEP, degrees, both ends included.")] = "-59.5:57.5:1.5"
    phantom: Annotated[
        str, typer.Option(help=f"Volume: {', '.join(_PHANTOMS)}.", autocompletion=completed(*_PHANTOMS))
    ] = "shells"
    noise: Annotated[
        str, typer.Option(help="clipped, gaussian, skewed, outliers, 8-bit, low-dose (linear), none, or a model file.")
    ] = "clipped"
    clip: Annotated[bool, typer.Option("--clip", help="Clip values to 0 to the largest possible signal.")] = False
    defocus: Annotated[float, typer.Option(help="Blur by depth, pixels per voxel out of focus, such as 0.02.")] = 0.0
    dual_axis: Annotated[bool, typer.Option("--dual-axis", help="Add tilts_second.mrc, an axis at 90°.")] = False
    mode: Annotated[str | None, typer.Option(help="transmission or linear; by default that of the noise.")] = None
    overwrite: OverwriteOption = False
    seed: SeedOption = 0
    json: JsonOption = False

    def __post_init__(self) -> None:
        if self.size < 8:
            raise ValueError(f"--size {self.size} is too small; give at least 8 voxels")
        if not 0 <= self.defocus <= 1:
            raise ValueError(f"--defocus {self.defocus:g}: give 0 to 1, pixels of blur per voxel out of focus")
        if (self.folder / "tilts.mrc").exists() and not (self.folder / "truth.mrc").exists() and not self.overwrite:
            raise ValueError(f"{self.folder} holds a tilts.mrc not simulated; name another folder, or --overwrite")

    @property
    def noisy(self) -> tuple[str, ...]:
        """The names of the noisy series."""
        return ("tilts", "tilts_second") if self.dual_axis else ("tilts",)

    def stacks(self) -> dict[str, NDArray[np.float64]]:
        """The tilt angles of each series of clean images."""
        from recon.simulate.simulation import angles_between, tilt_range

        angles = tilt_range(self.tilts)
        if len(angles) < 2:
            raise ValueError(f"--tilts {self.tilts}: a tilt series needs at least two tilts")
        stacks = {
            "clean": angles,
            "validation": angles_between(angles, 14, share=1 / 3),
            "test": angles_between(angles, 20, share=2 / 3),
        }
        return stacks | ({"clean_second": angles} if self.dual_axis else {})


@with_options
def simulate(options: SimulateOptions) -> None:
    """Simulate a tilt series of a known volume with known noise, and clean projections at other angles for evaluation."""
    from noiseflow.runs.outputs import Outputs
    from recon.simulate.simulation import Simulation

    output, folder, size, stacks = Output(options.json), options.folder, options.size, options.stacks()
    acquisition, noise_model = _acquisition(options.noise, options.mode)
    if options.clip:
        noise_model = _clipped(noise_model, acquisition.brightest)
    num_tilts = len(stacks["clean"])
    num_images = sum(map(len, stacks.values())) + len(options.noisy) * num_tilts
    holds = [f"{name}{suffix}" for name in (*stacks, *options.noisy) for suffix in (".mrc", ".rawtlt")]
    simulation = Simulation(options.phantom, size, stacks, acquisition, noise_model, options.seed, options.defocus)
    with Outputs(overwrite=options.overwrite) as outputs, progress_shown(json_mode=options.json) as progress:
        outputs.folder(folder, holds=["truth.mrc", *holds], num_bytes=4 * size**2 * (size + num_images), creates=True)
        outputs.file(folder / "tilts.mrc")
        outputs.options(folder)
        simulation.write(folder, progress)
    what = f"{size}³ volume ({options.phantom}, {acquisition.mode}, noise: {options.noise})"
    output.line(f"{num_tilts} tilts of a {what} in {folder}")
    output.result(
        {"folder": folder, "num_tilts": num_tilts, "mode": acquisition.mode}
        | {name: folder / f"{name}.mrc" for name in (*options.noisy, *stacks, "truth")}
        | {"validation_angles": stacks["validation"], "test_angles": stacks["test"]}
    )


def _acquisition(noise: str, mode: str | None) -> tuple[Acquisition, nn.Module | None]:
    from recon.simulate.simulation import ACQUISITIONS

    acquisition = ACQUISITIONS.get(noise, ACQUISITIONS["none"])
    if mode is not None:
        own, acquisition = acquisition, replace(acquisition, mode=parse_mode(mode))
        if own.noise is not None and own != acquisition:  # which has a scale of its own
            fitting = ", ".join(
                name for name, each in ACQUISITIONS.items() if each.mode == acquisition.mode and each.noise
            )
            raise ValueError(f"--noise {noise} is for {own.mode}; with --mode {mode}, choose none, {fitting} or a file")
    if noise in ACQUISITIONS:
        return acquisition, acquisition.noise() if acquisition.noise is not None else None
    if not Path(noise).exists():
        raise ValueError(f"--noise {noise}: choose {', '.join(ACQUISITIONS)}, or give a noise-model file that exists")
    noise_model = noiseflow.load(noise)
    # the brightest pixels are in the range of the model's fit, if that is known
    known = getattr(noise_model, "fitted_range", None)
    brightest = known[1] if known is not None and known[1] > 0 else 1.0
    return replace(acquisition, intensity=brightest / acquisition.brightest), noise_model


def _clipped(noise_model: nn.Module | None, high: float) -> nn.Module:
    if noise_model is None:
        raise ValueError("--clip clips noisy pixel values; choose noise with --noise, too")
    if isinstance(noise_model, noiseflow.Digitised):
        raise ValueError("--clip: this noise model already has clipping limits; remove --clip")
    return noiseflow.Digitised(noise_model, step=0.0, low=0.0, high=high)
