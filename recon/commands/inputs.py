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


def _read_mask(path: Path) -> NDArray[Any]:
    mask = io.read(path).data
    io.require_finite(mask, path)
    return np.asarray(mask != 0)
