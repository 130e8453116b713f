"""Charts of a reconstruction: its noise model, its error bars, and how each image differs from its projection."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from noiseflow.arrays import strided
from noiseflow.models.wrapper import as_noise_model
from noiseflow.report import COLOURS, Chart, Report, grey_range, new_figure, residual_histogram, show_image
from noiseflow.statistics import bulk
from recon.series.tilt_series import TiltSeries, Volume
from recon.uncertainty.measure import unseen_in_words
from recon.uncertainty.posterior import CORRELATED
from recon.uncertainty.result import ShellBand, Uncertainty
from recon.verdict.compared import Residuals, Result, expected_images
from recon.verdict.distortions import distortions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Values = NDArray[np.float32]


def noise_charts(noise_model: nn.Module, signal: Values, observation: Values) -> list[Chart]:
    """Quantiles of the noise against the signal, then histograms at a few signals: data, and exact values of the model.

    Args:
        signal, observation: (N,) predicted noise-free pixels and measured pixel values, detector units.
    """
    stride = -(-signal.size // CORRELATED)
    signal, observation = signal[::stride], observation[::stride]
    charts = [_quantile_chart(noise_model, signal, observation, _by_signal(signal, 24))]
    for number, group in enumerate(_by_signal(signal, 5)):
        parts, models = (signal[group], observation[group]), {"model": noise_model}
        charts.append(residual_histogram(*parts, models, unit="detector units", legend=number == 0))
    return charts


def _by_signal(signal: Values, count: int, *, least: int = 200) -> list[NDArray[np.intp]]:
    """Groups of pixels in equal steps of the signal, without those of fewer than `least` pixels."""
    low, high = bulk(signal)
    step = np.clip(np.searchsorted(np.linspace(low, high, count + 1), signal, side="right") - 1, 0, count - 1)
    ordered = np.split(np.argsort(step, kind="stable"), np.cumsum(np.bincount(step, minlength=count))[:-1])
    return [group for group in ordered if group.size >= min(least, signal.size // count)]


def _quantile_chart(
    noise_model: nn.Module,
    signal: Values,
    observation: Values,
    groups: list[NDArray[np.intp]],
    *,
    shares: tuple[float, ...] = (0.05, 0.25, 0.5, 0.75, 0.95),
) -> Chart:
    level = np.array([signal[group].mean() for group in groups])
    data = np.array([np.quantile(observation[group] - signal[group], shares) for group in groups])
    chart = Chart("Noise by signal", x="signal, detector units", y="pixel value − signal")
    signals = torch.as_tensor(level, dtype=torch.float32, device=as_noise_model(noise_model).device)
    with torch.no_grad():
        quantiles = [noise_model(signals).icdf(torch.full_like(signals, share)) - signals for share in shares]
    model = torch.stack(quantiles, 1).cpu().numpy()
    for number, share in enumerate(shares):
        middle = share == 0.5
        chart.plot(level, model[:, number], width=2.0 if middle else 1.1, label="model" if middle else "")
        label = "data: 5, 25, 50, 75, 95 %" if middle else ""
        chart.plot(level, data[:, number], width=0, dots=1.8, colour=COLOURS["warm"], label=label)
    return chart


def add_error_bars(report: Report, tilt_series: TiltSeries, volume: Volume, bars: Uncertainty, unit: str) -> None:
    """Add a section with slices across y and z, and the directions without tilts."""
    report.heading("Error bars")
    words = f"Middle slices; standard deviation and bias from {bars.num_samples} samples, missing wedge; on one scale, {unit}."
    report.figure(error_bar_figure(volume, bars, unit), caption=words)
    report.text(unseen_in_words(tilt_series.tilt_angles))
    if bars.shells is not None:
        _add_shells(report, bars.shells, volume.voxel_size)


def _add_shells(report: Report, band: ShellBand, voxel_size: float | None) -> None:
    chart = Chart("Expected Fourier shell correlation with the truth", x="cycles per voxel", y="correlation")
    chart.fill(band.frequency, band.low, band.high, opacity=0.3)
    chart.line(y=0.5)
    chart.limits["y"] = 0.0, 1.05
    words = "The lower edge counts the bias in full, the upper edge ignores it."
    report.charts([chart], caption=f"Stays above 0.5 up to {band.in_words(voxel_size)}. {words}")


def limits_of(volume: NDArray[np.float32]) -> tuple[float, float]:
    """Values to draw black and white: as `grey_range`, but not all white where matter is rare."""
    low, high = grey_range(strided(volume))
    return low, max(high, low + 0.05 * (float(volume.max()) - low))


def error_bar_figure(volume: Volume, bars: Uncertainty, unit: str) -> Figure:
    """Middle slices (z, x) and (y, x) of the volume and of its error bars, which share a colour scale."""
    parts = [each.attenuation for each in (volume, *bars.parts.values())]
    reach = max(grey_range(np.abs(part))[1] or float(np.abs(part).max()) for part in parts[1:]) or 1.0
    figure, axes = new_figure(4, 2, width=14, height=3.3)
    spacing = 1.0 if volume.voxel_size is None else volume.voxel_size / 10
    length = "voxels" if volume.voxel_size is None else "nm"
    limits = limits_of(parts[0])
    for row, (across, down) in zip(axes, (("y", "z"), ("z", "y")), strict=True):
        show_image(row[0], _middle(parts[0], across), f"volume, slice across {across}", limits=limits)
        for axis, part, name in zip(row[1:], parts[1:], bars.parts, strict=True):
            drawn = axis.imshow(_middle(part, across), cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="nearest")
            axis.set_title(name, fontsize=10)
        for axis in row:
            height, width = axis.images[0].get_array().shape
            axis.images[0].set_extent((0, width * spacing, height * spacing, 0))
            axis.set_xlabel(f"x, {length}", fontsize=8)
            axis.set_ylabel(f"{down}, {length}", fontsize=8)
            axis.tick_params(labelsize=7)
    figure.colorbar(drawn, ax=list(axes[:, 1:].ravel()), shrink=0.8, label=unit)
    return figure


def _middle(values: NDArray[np.float32], across: str) -> NDArray[np.float32]:
    """The middle slice of (z, y, x) across one axis."""
    axis = "zyx".index(across)
    return np.asarray(np.take(values, values.shape[axis] // 2, axis))


def add_differences(report: Report, tilt_series: TiltSeries, result: Result) -> None:
    """Add a folded section with the differences of each image from the projection of the volume."""
    report.heading("Differences of each image", folded=True)
    residuals = Residuals.of(tilt_series, lambda rows: expected_images(result, rows))
    found = distortions(residuals)
    angles = residuals.tilt_angles
    shifts = {name: found[name].values for name in ("shift across", "shift along y")}
    edges = {name: found[name].values for name in ("magnification", "rotation")}
    spread = {"residual": residuals.residual.std((1, 2))}
    charts = [
        _tilt_chart("Shift of each image", "pixels", angles, shifts),
        _tilt_chart("Magnification and rotation", "pixels at the edge", angles, edges),
        _tilt_chart("Residual of each tilt", "rms, detector units", angles, spread),
    ]
    caption = (
        "Difference of each image from the projection of the volume, by linear regression. Scatter about zero is random; "
        "waves and steps indicate shifts, wrong angles, or a changing specimen. The volume absorbs a part of each difference."
    )
    report.charts(charts, caption=caption)


def _tilt_chart(title: str, unit: str, angles: NDArray[Any], curves: dict[str, NDArray[Any]]) -> Chart:
    chart = Chart(title, x="tilt, degrees", y=unit)
    for (name, values), colour in zip(curves.items(), (COLOURS["accent"], COLOURS["warm"]), strict=False):
        chart.plot(angles, np.asarray(values), colour=colour, dots=1.5, label=name if len(curves) > 1 else "")
    return chart
