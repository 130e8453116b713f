"""The command `noiseflow compare`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from noiseflow.commands.console import JsonOption, Output, OverwriteOption
from noiseflow.progress import progress_shown
from recon.commands.options import parse_mode


def compare(
    volume: Annotated[Path, typer.Argument(help="Volume to evaluate, from any program: .mrc, .rec, .tif or .npy.")],
    reference: Annotated[Path, typer.Argument(help="The truth, or another volume.")],
    angles: Annotated[Path | None, typer.Option(help="Angle file; also compare projections at these angles.")] = None,
    mode: Annotated[str, typer.Option(help="Projections: linear, or transmission, exp(-line integral).")] = "linear",
    report: Annotated[Path | None, typer.Option("--report", "--plot", help="Folder for a page with pictures.")] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
) -> None:
    """Compare a volume with a reference: MSE, PSNR, DSSIM (raw, affine, min-max) and Fourier shell correlation."""
    from noiseflow import io
    from noiseflow.runs.outputs import Outputs
    from recon.commands.measure import read_shell_band
    from recon.metrics.comparison import THRESHOLDS, compare_volumes, comparison_report, error_table
    from recon.metrics.metrics import reach_in_words
    from recon.series.tilt_series import Volume

    output = Output(json)
    with Outputs(volume, reference, overwrite=overwrite) as outputs:
        outputs.folder(report, holds=["index.html"], creates=True)
        outputs.options(report)
        first, second = (Volume.read(path, mapped=True) for path in (volume, reference))
        tilt_angles = None if angles is None else io.read_tilts(angles).angles
        with progress_shown(json_mode=json) as progress:
            compared = compare_volumes(first, second, tilt_angles=tilt_angles, mode=parse_mode(mode), progress=progress)
        compared = replace(compared, expected=read_shell_band(volume))
        output.table(*error_table(compared))
        for threshold in THRESHOLDS:
            reach = reach_in_words(compared.crossings[threshold], threshold, second.voxel_size)
            output.line(f"Fourier shell correlation {reach}")
        if compared.expected is not None:
            reach = compared.expected.in_words(second.voxel_size)
            output.line(f"resolution at 0.5 expected from its error bars: {reach}")
        if compared.orientation is not None:
            output.line(compared.orientation.in_words())
        page = None
        if report is not None:
            pictures = comparison_report(
                first.attenuation, second.attenuation, compared, names=(volume.name, reference.name)
            )
            page = pictures.save(report / "index.html")
            output.line(f"report: {page}")
    found = compared.as_dict()
    output.result({"errors": found.pop("volume"), **found, "report": page})
