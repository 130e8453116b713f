"""Reading of the tilt series of `noiseflow reconstruct` according to its options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from noiseflow import io
from noiseflow.commands.console import Output
from noiseflow.progress import Progress
from recon.commands.options import parse_mode
from recon.series.alignment_files import ALIGNMENT_SUFFIXES, read_alignment, write_alignment
from recon.series.channels import prepare_channels
from recon.series.contrast import invert_contrast as inverted
from recon.series.contrast import likely_mode
from recon.series.files import read_tilt_series
from recon.series.prepare import Prepared as Prepared
from recon.series.prepare import prepare as prepare_series
from recon.series.tilt_series import TiltSeries

AUTO = "auto"
_BACKGROUND = {"transmission": "bright", "linear": "dark"}


def load_tilt_series(
    path: Path,
    *,
    output: Output,
    angles: Path | None,
    mode: str,
    invert_tilt: bool,
    invert_contrast: bool,
    mask: Path | None,
    mask_nan: bool,
    mapped: bool = False,
    channel: str | None = None,
    pixel_size: float | None = None,
    exclude_views: str = "",
) -> TiltSeries:
    """Read a tilt series according to the options of the command; the mode ``auto`` is decided by the images.

    Raises:
        FileNotFoundError, ValueError: as `read_tilt_series`, or the mask does not match.
    """
    automatic = mode.lower() == AUTO
    series = read_tilt_series(
        path,
        angles=angles,
        mode="transmission" if automatic else parse_mode(mode),
        mask=mask,
        mask_nan=mask_nan,
        mapped=mapped,
        channel=channel,
        pixel_size=pixel_size,
        exclude_views=exclude_views,
    )
    if invert_tilt:
        series = replace(series, tilt_angles=-series.tilt_angles, x_tilt=-series.x_tilt)
    if invert_contrast:
        series = inverted(series)
    if automatic:
        found = likely_mode(series)
        series = replace(series, mode=found or series.mode)
        reason = "as the images do not decide" if found is None else f"as its background is {_BACKGROUND[found]}"
        output.line(f"{path.name}: mode {series.mode}, {reason}; --mode sets it")
    return series


def files_read(tilts: Path, angles: Path | None, *others: Path | None) -> list[Path]:
    """The stack, its angle file (given or found next to it), and the other given files."""
    return [path for path in (tilts, angles or io.angle_file_of(tilts), *others) if path is not None]


def prepare(
    channels: Mapping[str, TiltSeries],
    *,
    align_on: TiltSeries | None,
    tilt_axis: float | None,
    refine_alignment: bool,
    alignment: Path | None,
    alignment_binning: float | None,
    save_alignment: Path | None,
    second_axis: TiltSeries | None,
    keep_tilts: bool,
    device: str,
    output: Output,
    report: Progress | None = None,
) -> dict[str, Prepared]:
    """As `recon.prepare`, or `recon.prepare_channels`, with files of alignments, and print what was found."""
    series = align_on or next(iter(channels.values()))
    options: dict[str, Any] = {"tilt_axis": tilt_axis, "refine_alignment": refine_alignment, "keep_tilts": keep_tilts}
    options |= {"device": device, "progress": report}
    if alignment is not None:
        options["alignment"] = read_alignment(alignment, series, binning=alignment_binning)
    if "" in channels:
        prepared = {"": prepare_series(series, second_axis=second_axis, **options)}
    else:
        prepared = prepare_channels(channels, align_on=align_on, **options)
    found = next(iter(prepared.values()))
    if refine_alignment and found.alignment is not None:
        output.line(found.alignment.in_words())
    if found.registration is not None:
        output.line(found.registration.in_words())
    if save_alignment is not None:
        if found.alignment is None:
            raise ValueError("--save-alignment: there is no alignment; find it with --refine-alignment")
        for path in write_alignment(save_alignment, found.alignment):
            output.line(f"alignment: {path}")
    return prepared


def check_alignment_file(path: Path, *inputs: Path | None, overwrite: bool) -> None:
    """Check that `--save-alignment` can be written. Raises as `noiseflow.io.check_output` and `noiseflow.io.require_other`."""
    io.check_output(path, suffixes=ALIGNMENT_SUFFIXES, overwrite=overwrite)
    io.require_other(path, *inputs)
