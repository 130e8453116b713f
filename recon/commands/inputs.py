"""The tilt series that `noiseflow reconstruct` was given, checked, masked and turned the right way."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from noiseflow.commands.console import Output, StepReport
from recon.commands.options import parse_mode
from recon.series.alignment import Alignment
from recon.series.alignment_search import find_alignment
from recon.series.contrast import check_contrast
from recon.series.contrast import invert_contrast as inverted
from recon.series.screening import Screening, screen
from recon.series.tilt_series import TiltSeries, read_tilt_series


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
    mapped: bool = False,
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
        mapped=mapped,
    )
    if invert_tilt:
        series = replace(series, tilt_angles=-series.tilt_angles)
    if invert_contrast:
        series = inverted(series)
    _warn_of_outliers(series)
    check_contrast(series)
    steps = np.diff(series.tilt_angles)
    if (steps > 0).any() and (steps < 0).any():
        warnings.warn(
            "the tilt angles are not in order; each image keeps its own angle, which is all that counts", stacklevel=2
        )
    return series


def files_read(tilts: Path, angles: Path | None, *others: Path | None) -> list[Path]:
    """The stack, its angle file, given or found beside it, and the other files that were given."""
    return [path for path in (tilts, angles or io.angle_file_of(tilts), *others) if path is not None]


def _warn_of_outliers(series: TiltSeries) -> None:
    step = max(1, series.images.size // 100_000)
    low, high = np.quantile(np.concatenate([part[::step].copy() for part in _used(series)]), (0.02, 0.98))
    far = [part[np.abs(part - (low + high) / 2) > 100 * (high - low)] for part in _used(series)]
    found = np.abs(np.concatenate(far))
    if high > low and found.size:
        warnings.warn(
            f"{found.size} pixels are a hundred times farther out than the others (up to {found.max():.3g}) and would "
            "spoil the volume; leave them out with --mask FILE, or replace them",
            stacklevel=3,
        )


def _used(series: TiltSeries) -> Iterator[NDArray[np.float64]]:
    """The readings to use, image by image."""
    for number, image in enumerate(series.images):
        yield (image if series.mask is None else image[series.mask[number]]).astype(np.float64).ravel()


@dataclass(frozen=True)
class Prepared:
    """A tilt series ready to reconstruct, and what was found on the way.

    Attributes:
        tilt_series: aligned, without the tilts that do not belong.
        screening: how well every tilt fits the others.
        alignment: of the raw images, where they were moved.
    """

    tilt_series: TiltSeries
    screening: Screening
    alignment: Alignment | None

    @property
    def choices(self) -> dict[str, float | str]:
        """What a table of results shows."""
        return ({} if self.alignment is None else self.alignment.choices()) | self.screening.choices()

    def as_dict(self) -> dict[str, Any]:
        """All of it, tilt by tilt, for programs."""
        return {
            "screening": self.screening.as_dict(),
            "alignment": None if self.alignment is None else self.alignment.as_dict(),
        }


def prepare(
    tilt_series: TiltSeries,
    *,
    tilt_axis: float | None,
    refine_alignment: bool,
    keep_tilts: bool,
    device: str,
    output: Output,
    report: StepReport | None = None,
) -> Prepared:
    """Align the images as asked for, and judge every tilt by the others; a warning names those left out.

    Args:
        tilt_series: as read.
        tilt_axis: direction of the tilt axis in the images, degrees; None for y, or to have it found.
        refine_alignment: find axis and shifts.
        keep_tilts: only warn of tilts that do not belong.
        device: where to compute.
        output: told what was found.
        report: told of the progress.
    """
    alignment = None
    if refine_alignment:
        alignment = find_alignment(tilt_series, tilt_axis=tilt_axis, device=device, progress=report)
        output.line(alignment.in_words())
    elif tilt_axis is not None:
        if not np.isfinite(tilt_axis):
            raise ValueError(f"--tilt-axis {tilt_axis} must be a number of degrees")
        alignment = Alignment(tilt_axis, np.zeros((tilt_series.num_tilts, 2)), tilt_series.tilt_angles)
    if alignment is not None:
        tilt_series = alignment.apply(tilt_series)
    found = screen(tilt_series)
    if found.bad.any():
        angles = tilt_series.tilt_angles[found.bad]
        named = ", ".join(f"{angle:g}°" for angle in angles[:8]) + (", …" if len(angles) > 8 else "")
        what = f"{len(angles)} of {tilt_series.num_tilts} tilts do not fit the volume of the others: {named}"
        advice = "kept (--keep-tilts)" if keep_tilts else "left out (--keep-tilts keeps them)"
        warnings.warn(f"{what}; {advice}", stacklevel=2)
    return Prepared(found.passed(tilt_series, keep=keep_tilts), found, alignment)


def _read_mask(path: Path) -> NDArray[Any]:
    mask = io.read(path).data
    io.require_finite(mask, path)
    return np.asarray(mask != 0)
