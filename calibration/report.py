"""The calibration's page: was the pair registered, which noise model fits, and a verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.aligned import AlignedPair
from calibration.exposures import Image
from calibration.models import ModelScore, Pixels, simplest_sufficient
from noiseflow.report import Report, new_figure, show_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LABELS = {
    "gaussian": "Gaussian, one width",
    "poisson": "Poisson",
    "signal-gaussian": "Gaussian, width by signal",
    "flow": "radial flow",
    "spline": "spline flow",
}
"""How the report calls the models."""

TABLE_HEADER = (
    *("model", "held-out NLL", "± s.e.", "above best", "± s.e."),
    *("JSD", "floor", "1 − BC", "floor", "distance", "floor", "JSD by signal", "floor"),
)


def table_rows(scores: Sequence[ModelScore]) -> list[list[str]]:
    """The figures of each model as text; divergences in units of 10⁻⁴."""
    return [_row(score) for score in scores]


def _row(score: ModelScore) -> list[str]:
    judged, overall = score.evaluation, score.evaluation.overall
    likelihood = (score.nll, score.nll_error, score.excess, score.excess_error)
    pairs = (
        *(overall.jsd, overall.jsd_floor, 1 - overall.bc, 1 - overall.bc_floor, overall.bd, overall.bd_floor),
        *(judged.mean_jsd, judged.mean_jsd_floor),
    )
    return [score.name, *(f"{value:.5f}" for value in likelihood), *(f"{1e4 * value:.2f}" for value in pairs)]


def verdict(scores: Sequence[ModelScore]) -> str:
    """One or two sentences: which model suffices, and by how much the others fail."""
    chosen = simplest_sufficient(scores)
    simpler = [score for score in scores[: list(scores).index(chosen)] if np.isfinite(score.excess)]
    text = f"The {LABELS[chosen.name]} model suffices: no model predicts the pixels kept apart better beyond its error."
    if simpler:
        nearest = min(simpler, key=lambda score: score.excess)
        text += (
            f" The nearest simpler one, {LABELS[nearest.name]}, loses {nearest.excess:.4f} ± "
            f"{nearest.excess_error:.4f} nats per pixel."
        )
    overall = chosen.evaluation.overall
    if overall.jsd > 3 * overall.jsd_floor:
        text += (
            f" Yet its histogram differs from the data by {overall.jsd / overall.jsd_floor:.1f} times the "
            "finite-sample floor: look at the histograms before trusting it."
        )
    return text


def write_report(
    folder: str | Path, pairs: Sequence[AlignedPair], pixels: Pixels, scores: Sequence[ModelScore], *, title: str
) -> Path:
    """Write ``report.html`` into a folder, which is made if need be; returns its path."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    page = Report(title)
    page.text(verdict(scores))
    page.heading("Noise models")
    caption = (
        "NLL: negative log-likelihood of pixels kept apart from the fit, nats per pixel, lower is better. JSD (nats), "
        "1 − BC and Bhattacharyya distance in units of 10⁻⁴; floor: what the model's own samples would give."
    )
    page.table(TABLE_HEADER, table_rows(scores), caption=caption)
    page.figure(
        histogram_figure(pixels, scores), caption="Residuals of the pixels kept apart, by signal, and every model."
    )
    page.heading("Registration")
    for number, pair in enumerate(pairs, 1):
        page.text(f"Pair {number}: {describe_registration(pair)}")
        page.figure(
            registration_figure(pair), caption="Magenta: short, green: long; grey where they agree. Residual in σ."
        )
    return page.save(folder / "report.html")


def describe_registration(pair: AlignedPair) -> str:
    """The registration's figures in a sentence."""
    found = pair.registration
    x, y = found.shift(pair.short.shape)
    method = f"SIFT, {found.inliers} of {found.matches} matches" if found.method == "sift" else "phase correlation"
    counts = pair.counts
    return (
        f"{found.motion} motion by {method}: shift ({x:.2f}, {y:.2f}) px, rotation {found.rotation:.3f}°, scale "
        f"{found.scale:.5f}, standard error {found.error_px:.3f} px, matches' rms {found.rms_px:.2f} px. Left out: "
        f"{counts.outside} pixels outside the long exposure, {counts.saturated} saturated, {counts.hot} hot, "
        f"{counts.dead} dead."
    )


def registration_figure(pair: AlignedPair) -> Figure:
    """Overlay before and after, and the residual in standard deviations."""
    figure, axes = new_figure(3, width=12.0, height=4.0)
    before = pair.scaling.slope * pair.long + pair.scaling.intercept
    for axis, image, title in zip(axes[0], (before, pair.signal), ("before", "after registration"), strict=False):
        axis.imshow(_overlay(pair.short, image), interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    residual = (pair.short - pair.signal) / np.sqrt(np.maximum(pair.total_variance(pair.signal), np.finfo(float).tiny))
    show_image(axes[0, 2], np.where(pair.mask, residual, np.nan), "residual, σ", limits=(-4.0, 4.0))
    return figure


def histogram_figure(pixels: Pixels, scores: Sequence[ModelScore], *, num_levels: int = 6) -> Figure:
    """Residual histograms of the pixels kept apart at each of some signal levels, with every model's density on top."""
    figure, axes = new_figure(3, -(-num_levels // 3), width=12.0, height=3.2)
    signal, observation = pixels.signal[pixels.held_out], pixels.observation[pixels.held_out]
    order = np.argsort(signal)
    for axis, group in zip(axes.flat, np.array_split(order, num_levels), strict=False):
        residual = observation[group] - signal[group]
        low, high = np.percentile(residual, (0.1, 99.9))
        edges = np.linspace(low, high, 61)
        axis.hist(residual, bins=edges, density=True, color="0.8", label="data")
        for score in scores:
            axis.plot(
                (edges[1:] + edges[:-1]) / 2,
                _mean_density(score, signal[group], edges),
                label=score.name,
                linewidth=1.2,
            )
        axis.set_title(f"signal {signal[group].min():.4g} … {signal[group].max():.4g}", fontsize=10)
        axis.set_yscale("log")
        axis.set_ylim(bottom=2e-5 / (edges[1] - edges[0]))
    axes.flat[0].legend(fontsize=8)
    return figure


def _mean_density(score: ModelScore, signal: Image, edges: Image) -> Image:
    """Density of observation − signal in each bin, averaged over a sample of the level's signals."""
    import torch

    chosen = torch.from_numpy(signal[:: max(1, len(signal) // 200)]).float()
    with torch.no_grad():
        below = score.model(chosen[:, None]).cdf(chosen[:, None] + torch.from_numpy(edges).float())
    return np.asarray(below.double().diff(dim=1).mean(0).numpy() / np.diff(edges))


def _overlay(short: Image, long: Image) -> Any:
    """Short in magenta, long in green, both between the 1st and 99.5th percentiles of the long."""
    low, high = np.percentile(long, (1, 99.5))
    first, second = (np.clip((image - low) / max(high - low, np.finfo(float).tiny), 0, 1) for image in (short, long))
    return np.stack([first, second, first], -1)
