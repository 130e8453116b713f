"""Error bars in the report: standard deviation and bias next to the volume, with a common colour scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from noiseflow.report.charts import COLOURS, new_chart, new_figure, show_image
from recon.series.tilt_series import TiltSeries, Volume
from recon.uncertainty.unseen import in_words, unseen_part

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from noiseflow.report import Report
    from recon.uncertainty.result import Uncertainty
    from recon.uncertainty.shell_band import ShellBand

_REACH = 99.8  # percentile: a few voxels at edges must not determine the scale


def add_error_bars(report: Report, tilt_series: TiltSeries, volume: Volume, bars: Uncertainty, unit: str) -> None:
    """Add a section with slices across y and z, and the directions without tilts."""
    report.heading("Error bars")
    words = f"Middle slices; standard deviation and bias from {bars.num_samples} samples, on one scale, {unit}."
    report.figure(error_bar_figure(volume, bars, unit), caption=words)
    report.text(in_words(tilt_series.tilt_angles))
    unseen = Volume(unseen_part(volume.attenuation, tilt_series.tilt_angles), volume.voxel_size)
    words = f"The part of the volume along these directions, {unit}, which rests on the regulariser alone."
    report.figure(unseen_figure(unseen, unit), caption=words)
    if bars.shells is not None:
        _add_shells(report, bars.shells, volume.voxel_size)


def _add_shells(report: Report, band: ShellBand, voxel_size: float | None) -> None:
    figure, axis = new_chart("Expected Fourier shell correlation with the truth", x="cycles per voxel", y="correlation")
    axis.fill_between(band.frequency, band.low, band.high, color=COLOURS["accent"], alpha=0.3)
    axis.axhline(0.5, color=COLOURS["warm"], linewidth=1, linestyle="--")
    axis.set_ylim(0, 1.05)
    words = "The lower edge counts the bias in full, the upper edge ignores it."
    report.charts([figure], caption=f"Falls to 0.5 at {band.in_words(voxel_size)}. {words}")


def error_bar_figure(volume: Volume, bars: Uncertainty, unit: str) -> Figure:
    """Middle slices (z, x) and (y, x) of volume, standard deviation and bias; the last two share a colour scale."""
    parts = [each.attenuation for each in (volume, bars.std, bars.bias)]
    reach = max(float(np.percentile(np.abs(part), _REACH)) for part in parts[1:])
    reach = reach or max(float(np.abs(part).max()) for part in parts[1:]) or 1.0
    figure, axes = new_figure(3, 2, width=10.5, height=3.3)
    spacing = 1.0 if volume.voxel_size is None else volume.voxel_size / 10
    length = "voxels" if volume.voxel_size is None else "nm"
    sections = ("slice across y", "z", _across_y), ("slice across z", "y", _across_z)
    for row, (names, down, pick) in zip(axes, sections, strict=True):
        show_image(row[0], pick(parts[0]), f"volume, {names}", limits=_limits(parts[0]))
        for axis, part, name in zip(row[1:], parts[1:], ("standard deviation", "bias"), strict=True):
            drawn = axis.imshow(pick(part), cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="nearest")
            axis.set_title(name, fontsize=10)
        for axis, part in zip(row, parts, strict=True):
            height, width = pick(part).shape
            axis.images[0].set_extent((0, width * spacing, height * spacing, 0))
            axis.set_xlabel(f"x, {length}", fontsize=8)
            axis.set_ylabel(f"{down}, {length}", fontsize=8)
            axis.tick_params(labelsize=7)
    figure.colorbar(drawn, ax=list(axes[:, 1:].ravel()), shrink=0.8, label=unit)
    return figure


def unseen_figure(unseen: Volume, unit: str) -> Figure:
    """Middle slices (z, x) and (y, x) of the part of a volume that no tilt has seen."""
    figure, axes = new_figure(1, 2, width=7, height=2.8)
    reach = float(np.percentile(np.abs(unseen.attenuation), _REACH)) or 1.0
    for axis, name, pick in zip(axes.ravel(), ("across y", "across z"), (_across_y, _across_z), strict=True):
        drawn = axis.imshow(pick(unseen.attenuation), cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="nearest")
        axis.set(title=f"unseen part, slice {name}", xlabel="x, voxels", ylabel=f"{'zy'[name == 'across z']}, voxels")
    figure.colorbar(drawn, ax=list(axes.ravel()), shrink=0.8, label=unit)
    return figure


def _limits(values: NDArray[np.float32]) -> tuple[float, float]:
    low, high = np.percentile(values, (0.5, _REACH))
    return float(low), float(max(high, low + 0.05 * (values.max() - low)))


def _across_y(values: NDArray[np.float32]) -> NDArray[np.float32]:
    across: NDArray[np.float32] = values[:, values.shape[1] // 2]
    return across


def _across_z(values: NDArray[np.float32]) -> NDArray[np.float32]:
    across: NDArray[np.float32] = values[values.shape[0] // 2]
    return across
