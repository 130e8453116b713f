"""The command `noiseflow compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from noiseflow.console import JsonOption, Output


def compare(
    volume: Annotated[Path, typer.Argument(help="Volume to judge.")],
    reference: Annotated[Path, typer.Argument(help="The truth, or another volume.")],
    json: JsonOption = False,
) -> None:
    """Compare a volume with a reference: MSE, PSNR, DSSIM (raw, affine, min-max) and Fourier shell correlation."""
    import numpy as np

    from noiseflow import io
    from recon.metrics import SCALINGS, fourier_shell_correlation
    from recon.metrics import compare as errors_of

    output = Output(json)
    first, second = io.read(volume).data, io.read(reference).data
    errors = {scaling: errors_of(first, second, scaling=scaling) for scaling in SCALINGS}
    rows = [(scaling, f"{e.mse:.3e}", f"{e.psnr:.2f}", f"{e.dssim:.4f}") for scaling, e in errors.items()]
    output.table(("scaling", "MSE", "PSNR (dB)", "DSSIM"), rows)
    frequency, correlation = fourier_shell_correlation(first, second)
    below = np.flatnonzero(correlation[1:] < 0.5)
    crossing = float(frequency[below[0] + 1]) if below.size else 0.5
    output.line(f"Fourier shell correlation stays above 0.5 up to {crossing:.3f} cycles per voxel")
    output.result({"errors": {name: vars(e) for name, e in errors.items()}, "fsc_0.5": crossing, "fsc": correlation})
