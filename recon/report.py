"""The pictures of a reconstruction that a user wants first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from noiseflow.report import Report, new_figure, show_image
from recon.methods import Outcome
from recon.tilt_series import TiltSeries


def reconstruction_report(tilt_series: TiltSeries, outcome: Outcome, figures: Sequence[tuple[str, str]]) -> Report:
    """A page with three orthogonal slices, data against prediction, the fit's course and a table of figures.

    Args:
        tilt_series: the data.
        outcome: what was reconstructed from it.
        figures: rows of the table, (name, value).
    """
    report = Report(f"Reconstruction ({outcome.method})")
    report.table(("figure", "value"), figures)
    _add_slices(report, outcome)
    _add_residual(report, tilt_series, outcome)
    _add_history(report, outcome)
    return report


def _add_slices(report: Report, outcome: Outcome) -> None:
    volume = outcome.volume.attenuation
    z, y, x = (size // 2 for size in volume.shape)
    limits = float(np.percentile(volume, 0.5)), max(float(np.percentile(volume, 99.8)), float(volume.max()) * 0.05)
    figure, axes = new_figure(3)
    for axis, image, title in zip(
        axes[0],
        (volume[z], volume[:, y], volume[:, :, x]),
        (f"z = {z} (y, x)", f"y = {y} (z, x)", f"x = {x} (z, y)"),
        strict=True,
    ):
        show_image(axis, image, title, limits=limits)
    report.heading("Volume")
    report.figure(figure, caption="Attenuation per voxel in three orthogonal slices through the centre.")


def _add_residual(report: Report, tilt_series: TiltSeries, outcome: Outcome) -> None:
    images, predicted = tilt_series.images.astype(np.float32), outcome.projections
    tilt, row = int(np.argmin(np.abs(tilt_series.tilt_angles))), images.shape[1] // 2
    figure, axes = new_figure(3, 2)
    for axis, data, model, title in (
        (axes[0], images[tilt], predicted[tilt], f"tilt {tilt_series.tilt_angles[tilt]:.1f}°"),
        (axes[1], images[:, row], predicted[:, row], f"sinogram of row {row}"),
    ):
        limits = float(np.percentile(data, 0.5)), float(np.percentile(data, 99.5))
        show_image(axis[0], data, f"{title}: observed", limits=limits)
        show_image(axis[1], model, "predicted clean", limits=limits)
        show_image(axis[2], data - model, "residual")
    report.heading("Data and prediction")
    report.figure(figure, caption="A good fit leaves noise without structure in the residual.")


def _add_history(report: Report, outcome: Outcome) -> None:
    if outcome.fit_result is None or not outcome.fit_result.history:
        return
    figure, axes = new_figure(1)
    history = outcome.fit_result.history
    axes[0][0].plot(list(history), list(history.values()), marker=".")
    axes[0][0].set_xlabel("step")
    axes[0][0].set_ylabel("held-out NLL (nats per pixel)")
    report.heading("Course of the fit")
    report.figure(figure, caption="Negative log-likelihood of pixels that the fit never saw.")
    if outcome.weights_tried:
        rows = [(f"{weight:.4g}", f"{nll:.5f}") for weight, nll in sorted(outcome.weights_tried.items())]
        report.heading("Choice of the weight")
        caption = "Held-out likelihood of a slab of slices; the weight is where the parabola through the best three is lowest."
        report.table(("weight of the total variation", "held-out NLL"), rows, caption=caption)
