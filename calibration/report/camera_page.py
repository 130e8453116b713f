"""HTML report of a camera calibrated from flats and darks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibration.camera import Camera, rows_of
from calibration.report.figures import correlation_figure, plain_log_ticks
from calibration.report.page import describe_verdict
from noiseflow.io import output_folder
from noiseflow.report import Report, new_figure, provenance, show_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_LISTED = 50
"""Largest number of defective pixels listed in the report."""


def write_camera_report(
    folder: str | Path, camera: Camera, *, inputs: Sequence[str | Path] = (), seed: int | None = None
) -> Path:
    """Write ``report.html`` to a folder, which is created if necessary, and return its path.

    Args:
        folder: output folder.
        camera: the calibrated camera.
        inputs: input files; the report lists their checksums.
        seed: random seed to report.
    """
    page = Report("Camera calibration (EMVA 1288)")
    page.facts(
        [("Verdict", camera.verdict.grade), *((name, text.split(" (")[0]) for name, text in rows_of(camera)[:5])]
    )
    page.heading("Verdict")
    for sentence in describe_verdict(camera.verdict):
        page.text(sentence)
    page.heading("Figures")
    page.table(("figure", "value"), rows_of(camera), prose=True)
    page.figure(
        transfer_figure(camera),
        caption="Photon transfer: variance with the fitted line; deviation from the line; signal-to-noise ratio of a pixel.",
    )
    page.figure(
        correlation_figure(camera.figures.correlation),
        caption="Correlation of the temporal noise between pixels; independent pixels have zero correlation.",
    )
    page.heading("Per-pixel maps")
    page.figure(map_figure(camera), caption="Per-pixel maps; grey range from the 0.5th to the 99.5th percentile.")
    defects = np.argwhere(camera.maps["defects"] > 0)
    if len(defects):
        caption = f"The first {min(len(defects), MOST_LISTED)} of {len(defects)} defective pixels."
        names = [name for name in ("offset", "variance", "response") if name in camera.maps]
        rows = [
            [f"{y}", f"{x}", *(f"{camera.maps[name][y, x]:.4g}" for name in names)] for y, x in defects[:MOST_LISTED]
        ]
        page.table(("y", "x", *names), rows, caption=caption)
    page.heading("Provenance", folded=True)
    page.table(("item", "value"), provenance(inputs, seed=seed), prose=True)
    with output_folder(folder) as made:
        return page.save(made / "report.html")


def transfer_figure(camera: Camera) -> Figure:
    """Draw variance against mean with the fitted line, its residual, and signal-to-noise ratio against electrons."""
    figures = camera.figures
    points = [*([figures.dark] if figures.dark else []), *figures.levels]
    mean, variance, error = (
        np.array([getattr(one, name) for one in points]) for name in ("mean", "variance", "variance_error")
    )
    slope = figures.gain.median / max(figures.correlation.factor, 1e-9)
    base = figures.dark or figures.levels[0]
    expected = base.variance + slope * (mean - base.mean)
    figure, axes = new_figure(3, width=13.0, height=3.8)
    style = {"fmt": "o", "markersize": 3, "linewidth": 1, "color": "0.3"}
    axes[0, 0].errorbar(mean, variance, error, **style)
    axes[0, 0].plot(mean, expected, linewidth=1)
    axes[0, 0].set_ylabel("temporal variance, counts²")
    axes[0, 1].errorbar(mean, 100 * (variance / expected - 1), 100 * error / expected, **style)
    axes[0, 1].axhline(0, color="0.5", linewidth=0.8)
    axes[0, 1].set_ylabel("deviation from the line, %")
    for axis in axes[0, :2]:
        axis.set_xlabel("mean, counts")
    electrons = np.maximum(mean - (figures.offset or 0.0), 1e-9) / slope
    used = (electrons > 1e-6) & (variance > 0)
    axes[0, 2].loglog(
        electrons[used], (slope * electrons / np.sqrt(np.maximum(variance, 1e-9)))[used], "o-", markersize=3
    )
    plain_log_ticks(axes[0, 2])
    axes[0, 2].set_xlabel("electrons per pixel")
    axes[0, 2].set_ylabel("signal-to-noise ratio")
    return figure


def map_figure(camera: Camera) -> Figure:
    """Draw the maps of offset, dark variance and response."""
    names = [name for name in ("offset", "variance", "response") if name in camera.maps]
    figure, axes = new_figure(len(names), width=4.2 * len(names), height=3.8)
    units = {"offset": "offset, counts", "variance": "dark variance, counts²", "response": "relative response"}
    for axis, name in zip(axes[0], names, strict=True):
        low, high = np.percentile(camera.maps[name], (0.5, 99.5))
        show_image(axis, camera.maps[name], units[name], limits=(float(low), float(max(high, low + 1e-9))))
    return figure
