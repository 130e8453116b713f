"""Reading of the tilt series of `noiseflow reconstruct` according to its options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from noiseflow.commands.console import Output, StepReport
from recon.commands.options import parse_mode
from recon.series.alignment_files import ALIGNMENT_SUFFIXES, read_alignment, write_alignment
from recon.series.contrast import invert_contrast as inverted
from recon.series.prepare import Prepared as Prepared
from recon.series.prepare import prepare as prepare_series
from recon.series.tilt_series import TiltSeries, read_tilt_series


def load_tilt_series(
    path: Path,
    *,
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
    """Read a tilt series according to the options of the command.

    Raises:
        FileNotFoundError, ValueError: as `read_tilt_series`, or the mask does not match.
    """
    series = read_tilt_series(
        path,
        angles=angles,
        mode=parse_mode(mode),
        mask=None if mask is None else _read_mask(mask),
        mask_nan=mask_nan,
        mapped=mapped,
        channel=channel,
        pixel_size=pixel_size,
        exclude_views=exclude_views,
    )
    if invert_tilt:
        series = replace(series, tilt_angles=-series.tilt_angles)
    if invert_contrast:
        series = inverted(series)
    return series


def files_read(tilts: Path, angles: Path | None, *others: Path | None) -> list[Path]:
    """The stack, its angle file (given or found next to it), and the other given files."""
    return [path for path in (tilts, angles or io.angle_file_of(tilts), *others) if path is not None]


def prepare(
    tilt_series: TiltSeries,
    *,
    tilt_axis: float | None,
    refine_alignment: bool,
    alignment: Path | None,
    alignment_binning: float | None,
    save_alignment: Path | None,
    second_axis: TiltSeries | None,
    keep_tilts: bool,
    device: str,
    output: Output,
    report: StepReport | None = None,
) -> Prepared:
    """As `recon.prepare` with files of alignments, and print the alignment that was found."""
    prepared = prepare_series(
        tilt_series,
        tilt_axis=tilt_axis,
        refine_alignment=refine_alignment,
        alignment=None if alignment is None else read_alignment(alignment, tilt_series, binning=alignment_binning),
        second_axis=second_axis,
        keep_tilts=keep_tilts,
        device=device,
        progress=report,
    )
    if refine_alignment and prepared.alignment is not None:
        output.line(prepared.alignment.in_words())
    if prepared.registration is not None:
        output.line(prepared.registration.in_words())
    if save_alignment is not None:
        if prepared.alignment is None:
            raise ValueError("--save-alignment: there is no alignment; find it with --refine-alignment")
        for path in write_alignment(save_alignment, prepared.alignment):
            output.line(f"alignment: {path}")
    return prepared


def check_alignment_file(path: Path, *inputs: Path | None, overwrite: bool) -> None:
    """Check that `--save-alignment` can be written. Raises as `noiseflow.io.check_output` and `noiseflow.io.require_other`."""
    io.check_output(path, suffixes=ALIGNMENT_SUFFIXES, overwrite=overwrite)
    io.require_other(path, *inputs)


def _read_mask(path: Path) -> NDArray[Any]:
    mask = io.read(path).data
    io.require_finite(mask, path)
    return np.asarray(mask != 0)
