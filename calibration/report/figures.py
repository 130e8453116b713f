"""Figures of the calibration report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.detector.correlation import Correlation
from calibration.detector.figures import Figures
from calibration.detector.measure import Detector
from calibration.detector.models import ModelScore, Pixels
from calibration.detector.residual import smoothed_residual
from calibration.exposures.frames import Image
from calibration.registration.aligned import AlignedPair
from noiseflow.report import new_figure, show_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARAMETERS = ("gain, counts/e⁻", "offset, counts", "read noise, e⁻ rms")

LABELS = {
    "gaussian": "Gaussian, one width",
    "poisson": "Poisson",
    "poisson-gaussian": "Poisson-Gaussian",
    "counting": "counter with dead time",
    "excess-noise": "Poisson-Gaussian with excess noise",
    "signal-gaussian": "Gaussian, width by signal",
    "mixture": "mixture of Gaussians",
    "flow": "radial flow",
    "spline": "spline flow",
    "physics-flow": "Poisson-Gaussian corrected by a flow",
}
"""Names of the models in the report."""


def registration_figure(pair: AlignedPair) -> Figure:
    """Draw the short (magenta) and long (green) exposures on top of each other, before and after registration."""
    figure, axes = new_figure(2, width=9.0, height=4.2)
    before = pair.scaling.slope * pair.long + pair.scaling.intercept
    for axis, image, title in zip(
        axes[0], (before, pair.signal), ("before registration", "after registration"), strict=True
    ):
        axis.imshow(_overlay(pair.short, image), interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    return figure


def residual_figure(pair: AlignedPair) -> Figure:
    """Draw the smoothed residual, and the row and column means of the residual with ±2 standard errors."""
    figure, axes = new_figure(3, width=12.0, height=3.8)
    spread = np.sqrt(np.maximum(pair.total_variance(pair.signal), np.finfo(float).tiny))
    residual = np.where(pair.mask, (pair.short - pair.signal) / spread, 0.0)
    show_image(
        axes[0, 0], smoothed_residual(pair)[0], "residual smoothed over 3 px,\nstandard deviations", limits=(-4.0, 4.0)
    )
    for axis, along, name in ((axes[0, 1], 1, "row"), (axes[0, 2], 0, "column")):
        number = np.maximum(pair.mask.sum(axis=along), 1)
        axis.plot(residual.sum(axis=along) / number, linewidth=0.8)
        for sign in (-1, 1):
            axis.plot(sign * 2 / np.sqrt(number), color="0.5", linewidth=0.8, linestyle="--")
        axis.set_ylim(*(5 * np.median(2 / np.sqrt(number)) * np.array([-1, 1])))
        axis.set_xlabel(f"{name}, px")
        axis.set_title(f"mean residual of each {name},\nstandard deviations (dashed: ±2 s.e.)", fontsize=10)
    return figure


def histogram_figure(pixels: Pixels, scores: Sequence[ModelScore], *, num_levels: int = 6) -> Figure:
    """Draw histograms of the residuals of held-out pixels at several signal levels, with the density of every model."""
    figure, axes = new_figure(3, -(-num_levels // 3), width=12.0, height=3.6)
    signal, observation = pixels.signal[pixels.held_out], pixels.observation[pixels.held_out]
    order = np.argsort(signal)
    for axis, group in zip(axes.flat, np.array_split(order, num_levels), strict=False):
        residual = observation[group] - signal[group]
        low, high = np.percentile(residual, (0.1, 99.9))
        edges = np.linspace(low, high, 61)
        axis.hist(residual, bins=edges, density=True, color="0.8", label="data")
        for score in scores:
            density = _mean_density(score, signal[group], edges)
            axis.plot((edges[1:] + edges[:-1]) / 2, density, label=LABELS[score.name], linewidth=1.2)
        axis.set_title(f"signal {signal[group].min():.4g} … {signal[group].max():.4g} counts", fontsize=10)
        axis.set_yscale("log")
        axis.set_ylim(bottom=2e-3 / (edges[-1] - edges[0]))
    for axis in axes[:, 0]:
        axis.set_ylabel("density, 1/counts")
    for axis in axes[-1]:
        axis.set_xlabel("residual, counts")
    _legend_below(figure, axes.flat[0])
    return figure


def pit_figure(scores: Sequence[ModelScore]) -> Figure:
    """Draw the probability integral transform of held-out pixels, which is uniform for a correct model, and its QQ plot."""
    figure, axes = new_figure(2, width=11.0, height=4.2)
    for score in scores:
        pit = np.asarray(score.evaluation.pit)
        edges = np.linspace(0, 1, len(pit) + 1)
        axes[0, 0].stairs(pit, edges, baseline=None, label=LABELS[score.name], linewidth=1.2)
        axes[0, 1].plot(edges, np.concatenate([[0], np.cumsum(pit)]) / len(pit) - edges, label=LABELS[score.name])
    error = np.sqrt(len(edges) / scores[0].evaluation.num_pixels)
    axes[0, 0].axhspan(1 - 2 * error, 1 + 2 * error, color="0.9", zorder=0)
    axes[0, 0].set_title("PIT histogram (grey: ±2 s.e.)", fontsize=10)
    axes[0, 0].set_xlabel("probability integral transform")
    axes[0, 0].set_ylabel("density")
    axes[0, 1].axhspan(-scores[0].evaluation.ks_floor, scores[0].evaluation.ks_floor, color="0.9", zorder=0)
    axes[0, 1].set_title("QQ plot (grey: 95 % of samples from the model)", fontsize=10)
    axes[0, 1].set_xlabel("expected probability")
    axes[0, 1].set_ylabel("observed − expected probability")
    _legend_below(figure, axes[0, 1])
    return figure


def photon_transfer_figure(detector: Detector) -> Figure:
    """Draw variance against signal with the posterior's 90 % band, and the deviation from the fitted line."""
    figure, axes = new_figure(2, width=11.0, height=4.2)
    axis, line = axes[0, 0], detector.line
    style = {"fmt": "o", "markersize": 3, "linewidth": 1, "color": "0.3"}
    axis.errorbar(line.signal, line.variance, line.variance_error, label="signal levels (±1 s.e.)", **style)
    signal = np.linspace(min(line.signal.min(), detector.posterior.offset.median), line.signal.max(), 100)
    gain, offset, read_noise = detector.posterior.samples[:, :, None].transpose(1, 0, 2)
    variance = gain * np.maximum(signal - offset, 0) + (gain * read_noise) ** 2
    low, middle, high = np.percentile(variance, (5, 50, 95), axis=0)
    axis.fill_between(signal, low, high, alpha=0.3, label="posterior, 90 %")
    axis.plot(signal, middle, linewidth=1)
    axis.plot(
        signal, line.gain * signal + line.intercept, linewidth=1, linestyle="--", color="0.5", label="fitted line"
    )
    axis.set_ylabel("variance, counts²")
    axis.legend(fontsize=8)
    expected = line.gain * line.signal + line.intercept
    axes[0, 1].errorbar(
        line.signal, 100 * (line.variance / expected - 1), 100 * line.variance_error / expected, **style
    )
    axes[0, 1].axhline(0, color="0.5", linewidth=0.8)
    axes[0, 1].set_ylabel("deviation from the line, %")
    for one in axes[0]:
        one.set_xlabel("signal, counts")
    return figure


def correlation_figure(correlation: Correlation) -> Figure:
    """Draw the correlation of residuals as a map over (x, y) distance, and along both axes with its standard error."""
    figure, axes = new_figure(2, width=9.0, height=3.6)
    reach = int(np.abs(correlation.lags).max())
    image = np.zeros((2 * reach + 1, 2 * reach + 1))
    for (dy, dx), value in zip(correlation.lags.astype(int), correlation.value, strict=True):
        image[reach + dy, reach + dx] = image[reach - dy, reach - dx] = value
    limit = max(float(np.abs(image).max()), 5 * float(correlation.error.max()))
    show_image(axes[0, 0], image, "correlation of the residuals", limits=(-limit, limit))
    ticks = range(0, 2 * reach + 1, 2)
    axes[0, 0].set_xticks(ticks, [str(tick - reach) for tick in ticks])
    axes[0, 0].set_yticks(ticks, [str(tick - reach) for tick in ticks])
    axes[0, 0].set_xlabel("x distance, px")
    axes[0, 0].set_ylabel("y distance, px")
    steps = np.arange(1, reach + 1)
    for name, values in (
        ("along x", [correlation.at(0, int(step)) for step in steps]),
        ("along y", [correlation.at(int(step), 0) for step in steps]),
    ):
        axes[0, 1].plot(steps, values, marker="o", label=name)
    error = 2 * float(correlation.error.max())
    axes[0, 1].axhspan(-error, error, color="0.9", label="±2 s.e.", zorder=0)
    axes[0, 1].set_xticks(steps)
    axes[0, 1].set_xlabel("distance, px")
    axes[0, 1].set_ylabel("correlation")
    axes[0, 1].legend(fontsize=8)
    return figure


def snr_figure(figures: Figures, brightest: float) -> Figure:
    """Draw the signal-to-noise ratio of a pixel against its number of electrons."""
    figure, axes = new_figure(1, width=6.0, height=3.8)
    offset, read = figures.offset, figures.read_noise
    most = max((brightest - (offset.median if offset else 0.0)) / figures.gain.median, 10.0)
    electrons = np.geomspace(0.1, most, 200)
    noise = np.sqrt(electrons + (read.median**2 if read else 0.0))
    axes[0, 0].loglog(electrons, electrons / noise, label="this detector")
    axes[0, 0].loglog(electrons, np.sqrt(electrons), linestyle="--", color="0.5", label="shot-noise limit")
    plain_log_ticks(axes[0, 0])
    axes[0, 0].set_xlabel("electrons per pixel")
    axes[0, 0].set_ylabel("signal-to-noise ratio")
    axes[0, 0].legend(fontsize=8)
    return figure


def corner_figure(detector: Detector) -> Figure:
    """Draw the posterior of each parameter and of each pair of parameters."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = new_figure(3, 3, width=8.0, height=2.6)
    samples = detector.posterior.samples
    for row in range(3):
        for column in range(3):
            axis = axes[row, column]
            if column > row:
                axis.set_axis_off()
            elif column == row:
                axis.hist(samples[:, row], bins=50, color="0.6")
                axis.set_yticks([])
            else:
                axis.hist2d(samples[:, column], samples[:, row], bins=50, cmap="Greys")
            axis.set_xlim(samples[:, column].min(), samples[:, column].max())
            axis.xaxis.set_major_locator(MaxNLocator(4))
            axis.tick_params(labelsize=7)
            if row == 2:
                axis.set_xlabel(PARAMETERS[column], fontsize=9)
            if column == 0 and row > 0:
                axis.set_ylabel(PARAMETERS[row], fontsize=9)
    return figure


def plain_log_ticks(axis: Any) -> None:
    """Label logarithmic axes at 1, 2 and 5 times powers of ten; the default labels overlap if the range is short."""
    from matplotlib.ticker import LogLocator, NullFormatter

    for one in (axis.xaxis, axis.yaxis):
        one.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=10))
        one.set_major_formatter("{x:g}")
        one.set_minor_formatter(NullFormatter())


def _legend_below(figure: Figure, axis: Any) -> None:
    """Place the legend of an axis below the figure, where long names cover no data."""
    handles, names = axis.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(5, len(names)), fontsize=9, frameon=False)


def _mean_density(score: ModelScore, signal: Image, edges: Image) -> Image:
    """Return the density of observation − signal in each bin, averaged over a sample of the signals."""
    import torch

    chosen = torch.from_numpy(signal[:: max(1, len(signal) // 200)]).float()
    with torch.no_grad():
        below = score.model(chosen[:, None]).cdf(chosen[:, None] + torch.from_numpy(edges).float())
    return np.asarray(below.double().diff(dim=1).mean(0).numpy() / np.diff(edges))


def _overlay(short: Image, long: Image) -> Any:
    """Return an (y, x, 3) image: short in magenta, long in green, from the 1st to the 99.5th percentile of `long`."""
    low, high = np.percentile(long, (1, 99.5))
    first, second = (np.clip((image - low) / max(high - low, np.finfo(float).tiny), 0, 1) for image in (short, long))
    return np.stack([first, second, first], -1)
