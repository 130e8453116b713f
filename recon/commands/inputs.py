"""The tilt series that `noiseflow reconstruct` was given, checked, masked and turned the right way."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from recon.commands.options import parse_mode
from recon.contrast import check_contrast
from recon.contrast import invert_contrast as inverted
from recon.screening import Screening, screen
from recon.tilt_series import TiltSeries, read_tilt_series


def load_tilt_series(
    path: Path,
    *,
    angles: Path | None,
    transforms: Path | None,
    mode: str,
    invert_tilt: bool,
    invert_contrast: bool,
    mask: Path | None,
    mask_nan: bool,
) -> TiltSeries:
    """Read the series as the options of the command say.

    Raises:
        FileNotFoundError, ValueError: as `read_tilt_series`, or a mask that does not match.
    """
    series = read_tilt_series(
        path,
        angles=angles,
        transforms=transforms,
        mode=parse_mode(mode),
        mask=None if mask is None else _read_mask(mask),
        mask_nan=mask_nan,
    )
    if invert_tilt:
        series = replace(series, tilt_angles=-series.tilt_angles)
    if invert_contrast:
        series = inverted(series)
    check_contrast(series)
    steps = np.diff(series.tilt_angles)
    if (steps > 0).any() and (steps < 0).any():
        warnings.warn(
            "the tilt angles are not in order; each image keeps its own angle, which is all that counts", stacklevel=2
        )
    return series


def screened(tilt_series: TiltSeries, *, keep_tilts: bool) -> tuple[TiltSeries, Screening]:
    """The tilts that belong to the series, with their beam where it drifts; a warning names those left out.

    Args:
        tilt_series: the series.
        keep_tilts: only warn, and leave none out.
    """
    found = screen(tilt_series)
    if found.bad.any():
        angles = tilt_series.tilt_angles[found.bad]
        named = ", ".join(f"{angle:g}°" for angle in angles[:8]) + (", …" if len(angles) > 8 else "")
        what = f"{len(angles)} of {tilt_series.num_tilts} tilts do not fit the volume of the others: {named}"
        advice = "kept (--keep-tilts)" if keep_tilts else "left out (--keep-tilts keeps them)"
        warnings.warn(f"{what}; {advice}", stacklevel=2)
    return found.passed(tilt_series, keep=keep_tilts), found


def _read_mask(path: Path) -> NDArray[Any]:
    mask = io.read(path).data
    io.require_finite(mask, path)
    return np.asarray(mask != 0)
