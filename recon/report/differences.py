"""The differences of each image from the projection of the volume, for the report."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.report import COLOURS, Chart, Report
from recon.series.tilt_series import TiltSeries
from recon.verdict.distortions import distortions
from recon.verdict.residuals import Residuals
from recon.verdict.result import Result, expected_images


def add_differences(report: Report, tilt_series: TiltSeries, result: Result) -> None:
    """Add a folded section with the differences of each image from the projection of the volume.

    Args:
        report: the page.
        tilt_series: the data.
        result: the reconstruction, whose projections are compared with the data.
    """
    report.heading("Differences of each image", folded=True)
    residuals = Residuals.of(tilt_series, lambda rows: expected_images(result, rows))
    found = distortions(residuals)
    angles = residuals.tilt_angles
    shifts = {name: found[name].values for name in ("shift across", "shift along y")}
    edges = {name: found[name].values for name in ("magnification", "rotation")}
    charts = [
        _chart("Shift of each image", "pixels", angles, shifts),
        _chart("Magnification and rotation", "pixels at the edge", angles, edges),
        _chart("Residual of each tilt", "rms, detector units", angles, {"residual": residuals.residual.std((1, 2))}),
    ]
    caption = (
        "Difference of each image from the projection of the volume, by linear regression. Scatter about zero is random; "
        "waves and steps indicate shifts, wrong angles, or a changing specimen. The volume absorbs a part of each difference."
    )
    report.charts(charts, caption=caption)


def _chart(title: str, unit: str, angles: NDArray[Any], curves: dict[str, NDArray[Any]]) -> Chart:
    chart = Chart(title, x="tilt, degrees", y=unit)
    for (name, values), colour in zip(curves.items(), (COLOURS["accent"], COLOURS["warm"]), strict=False):
        chart.plot(angles, np.asarray(values), colour=colour, dots=1.5, label=name if len(curves) > 1 else "")
    return chart
