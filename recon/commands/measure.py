"""The command `noiseflow measure`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from noiseflow.commands.console import JsonOption, Output

if TYPE_CHECKING:
    from recon.series.tilt_series import Volume
    from recon.uncertainty.result import ShellBand, Uncertainty


def measure(
    volume: Annotated[Path, typer.Argument(help="Volume (z, y, x): .mrc, .rec, .tif or .npy.")],
    region: Annotated[str, typer.Option(help="Voxels to measure, z0:z1,y0:y1,x0:x1; all by default.")] = ":,:,:",
    above: Annotated[float | None, typer.Option(help="Count the voxels of the region above this attenuation.")] = None,
    line: Annotated[str | None, typer.Option(help="Line profile between two voxels: z0,y0,x0:z1,y1,x1.")] = None,
    level: Annotated[float, typer.Option(help="Probability with which an interval should contain the truth.")] = 0.9,
    json: JsonOption = False,
) -> None:
    """Measure a volume: mean of a region, volume above a threshold, line profile; with intervals if it has error bars.

    Error bars are the files VOLUME_std, VOLUME_bias, VOLUME_wedge and VOLUME_fsc.csv of `noiseflow reconstruct --uncertainty 16`.
    """
    import numpy as np

    from noiseflow.io.checks import parse_region
    from recon.series.tilt_series import Volume
    from recon.uncertainty.measure import line_profile, mean_of_region, volume_above
    from recon.uncertainty.result import quantile

    output, found = Output(json), Volume.read(volume)
    quantile(level)
    values, bars = found.attenuation, read_error_bars(volume, found)
    part = parse_region(region, values.shape)
    if not np.isfinite(values[part]).all():
        raise ValueError(f"{volume} has NaN or infinite voxels in the region {region}; choose another --region")
    profile = None
    if line is not None:
        try:
            (a, b, c), (d, e, f) = ((float(number) for number in end.split(",")) for end in line.split(":"))
        except ValueError:
            raise ValueError(f"--line {line}: give z0,y0,x0:z1,y1,x1 in voxels, such as 32,32,0:32,32,63") from None
        profile = line_profile(values, (a, b, c), (d, e, f), bars, level=level)
    mean = mean_of_region(values, part, bars, level=level)
    rows, result = [("mean attenuation per voxel", mean.in_words())], dict[str, Any](mean=vars(mean))
    if above is not None:
        if not math.isfinite(above):
            raise ValueError(f"--above {above}: give a finite attenuation per voxel")
        count = volume_above(values, above, part, bars, level=level)
        rows.append((f"voxels above {above:g}", count.in_words()))
        result["voxels above"] = vars(count)
        size = found.voxel_size
        if size is not None:
            cube = (size / 10) ** 3
            ends = (None if end is None else end * cube for end in (count.low, count.high))
            cubed = type(count)(count.value * cube, *ends)
            result["volume above (nm³)"] = vars(cubed)
            rows.append((f"volume above {above:g} (nm³)", cubed.in_words()))
    band = None if bars is None else bars.shells
    if band is not None:
        rows.append(("expected resolution, correlation of 0.5 with the truth", band.in_words(found.voxel_size)))
        result["resolution (cycles per voxel)"] = band.resolution()
    output.table(("figure", "value" if bars is None else f"value ({100 * level:g} % interval)"), rows)
    along_line = None
    if profile is not None:
        distance, along, half = profile
        columns = [distance, along] if half is None else [distance, along, along - half, along + half]
        names = ("distance (voxels)", "attenuation", "low", "high")[: len(columns)]
        output.table(names, [tuple(f"{value:.4g}" for value in row) for row in zip(*columns, strict=True)])
        along_line = dict(zip(names, columns, strict=True))
    if bars is None:
        output.line(f"no error bars next to {volume}: noiseflow reconstruct --uncertainty 16 writes them")
    output.result(
        {"volume": volume, "region": region, "level": level, **result}
        | {"line": along_line, "error_bars": bars is not None}
    )


def read_error_bars(path: Path, volume: Volume) -> Uncertainty | None:
    """Read the error bars next to the file of a volume; None if there are none. Raises ValueError if one of the files is
    missing, or its shape differs from the volume."""
    from recon.series.tilt_series import Volume
    from recon.uncertainty.result import Uncertainty, error_bar_paths

    paths = error_bar_paths(path)
    missing = [each for each in paths.values() if not each.exists()]
    if len(missing) == len(paths):
        return None
    if missing:
        raise ValueError(f"{missing[0]} is missing of {len(paths)} error bars; write all again, or remove the others")
    std, bias, wedge = (Volume.read(each) for each in paths.values())
    for each, where in zip((std, bias, wedge), paths.values(), strict=True):
        if each.attenuation.shape != volume.attenuation.shape:
            raise ValueError(f"{where} is {each.attenuation.shape}, not {volume.attenuation.shape} as {path}")
    return Uncertainty(std, bias, wedge, 0, read_shell_band(path))


def read_shell_band(path: Path) -> ShellBand | None:
    """Read the expected shell correlation next to the file of a volume; None if noiseflow has written none. Raises ValueError
    if its table was modified."""
    from noiseflow.runs.ownership import is_own
    from recon.uncertainty.result import ShellBand, shell_band_path

    beside = shell_band_path(path)
    return ShellBand.read(beside) if beside.exists() and is_own(beside) else None
