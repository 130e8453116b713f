"""The command `noiseflow simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from noiseflow.console import JsonOption, Output, SeedOption
from recon.commands.options import load_noise_model, parse_mode

if TYPE_CHECKING:
    from torch import nn

    from recon.simulation import Acquisition


def simulate(
    folder: Annotated[Path, typer.Argument(help="New folder for tilts.mrc, tilts.rawtlt, clean.mrc and truth.mrc.")],
    size: Annotated[int, typer.Option(help="Voxels along each edge.")] = 64,
    tilts: Annotated[str, typer.Option(help="START:STOP:STEP in degrees, both ends included.")] = "-59.5:57.5:1.5",
    phantom: Annotated[str, typer.Option(help="shells, virions, filaments, particles or slab.")] = "shells",
    noise: Annotated[
        str, typer.Option(help="clipped, skewed, outliers, low-dose (linear mode), 8-bit, none, or a noise-model file.")
    ] = "clipped",
    mode: Annotated[str | None, typer.Option(help="transmission or linear; by default the noise's own.")] = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
) -> None:
    """Simulate a tilt series of a known volume, with known noise."""
    import numpy as np

    from recon.phantoms import make_phantom
    from recon.simulation import add_noise, clean_tilt_series, tilt_range
    from recon.tilt_series import Volume, write_tilt_series

    output = Output(json)
    angles = tilt_range(tilts)
    acquisition, noise_model = _acquisition(noise, mode)
    volume = make_phantom(phantom, size, generator=np.random.default_rng(seed))
    clean, unit = clean_tilt_series(volume, angles, acquisition=acquisition)
    noisy = clean if noise_model is None else add_noise(clean, noise_model, seed=seed)
    folder.mkdir(parents=True, exist_ok=True)
    write_tilt_series(folder / "tilts.mrc", noisy)
    write_tilt_series(folder / "clean.mrc", clean)
    Volume(volume * np.float32(unit)).write(folder / "truth.mrc")
    output.line(f"{len(angles)} tilts of a {size}³ volume ({phantom}, {acquisition.mode}, noise: {noise}) in {folder}")
    output.result(
        {"folder": folder, "tilts": folder / "tilts.mrc", "truth": folder / "truth.mrc", "num_tilts": len(angles)}
    )


def _acquisition(noise: str, mode: str | None) -> tuple[Acquisition, nn.Module | None]:
    from dataclasses import replace

    from recon.simulation import ACQUISITIONS

    acquisition = ACQUISITIONS.get(noise, ACQUISITIONS["none"])
    noise_model = acquisition.noise() if acquisition.noise is not None else None
    if noise not in ACQUISITIONS:
        noise_model = load_noise_model(Path(noise))
    return acquisition if mode is None else replace(acquisition, mode=parse_mode(mode)), noise_model
