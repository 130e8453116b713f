"""The verdict at the top of a report: grade, reasons and effects; and the differences that it is made of."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Verdict
from noiseflow.report import COLOURS, Chart, Report
from recon.series.tilt_series import TiltSeries
from recon.verdict.distortions import distortions
from recon.verdict.residuals import Residuals
from recon.verdict.result import Result, expected_images

_WORDS = {
    "good": "Good: no check found a fault in this volume.",
    "doubtful": "Doubtful: parts of this volume may be wrong.",
    "bad": "Bad: do not use this volume until you have corrected the first reason.",
}

# tolerances: larger effects are drawn here
_MOST = 4.0
_SHOWN = 12
_EFFECTS = (
    "The {shown} largest of {all} effects, with two standard errors. Right of the dashed line an effect exceeds its tolerance; "
    "it gives a reason if it is also significant."
)


def add_verdict(report: Report, verdict: Verdict) -> None:
    """Add heading, grade, reasons and effects of a verdict to a report.

    Args:
        report: the page.
        verdict: the verdict.
    """
    report.heading("Verdict")
    report.text(_WORDS[verdict.grade])
    rows = [(str(number), reason) for number, reason in enumerate(verdict.reasons, 1)]
    report.table(("", "reason"), rows, prose=True)
    count = sum(bool(each.get("tolerance")) for each in verdict.evidence.values())
    report.charts([effects_chart(verdict)], caption=_EFFECTS.format(shown=min(count, _SHOWN), all=count))


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


def effect_size(effect: dict[str, Any]) -> float:
    """The size of an effect in tolerances."""
    return float(abs(effect["value"] - effect["null"]) / effect["tolerance"])


def effects_chart(verdict: Verdict) -> Chart:
    """The largest effects of a verdict with two standard errors, in their tolerances."""
    every = [(name, each) for name, each in verdict.evidence.items() if each.get("tolerance")]
    effects = sorted(every, key=lambda pair: -effect_size(pair[1]))[:_SHOWN]
    chart = Chart("Effects and their tolerances", x="size of the effect, tolerances", width=5.6, height=3.2)
    places = np.arange(len(effects))[::-1]
    sizes = np.array([effect_size(each) for _, each in effects])
    errors = np.array([each["error"] / each["tolerance"] for _, each in effects])
    fired = np.array([each["cost"] >= 1 for _, each in effects])
    for which, colour in ((~fired, COLOURS["accent"]), (fired, COLOURS["warm"])):
        size, error = (np.minimum(values, _MOST)[which] for values in (sizes, 2 * errors))
        chart.plot(size, places[which], width=0, dots=2.5, error=error, across=True, colour=colour)
    chart.line(x=1.0)
    chart.ticks["y"] = list(zip(places.astype(float), (name for name, _ in effects), strict=True))
    chart.limits["x"] = -0.1, _MOST + 0.2
    return chart


def _chart(title: str, unit: str, angles: NDArray[Any], curves: dict[str, NDArray[Any]]) -> Chart:
    chart = Chart(title, x="tilt, degrees", y=unit)
    for (name, values), colour in zip(curves.items(), (COLOURS["accent"], COLOURS["warm"]), strict=False):
        chart.plot(angles, np.asarray(values), colour=colour, dots=1.5, label=name if len(curves) > 1 else "")
    return chart
