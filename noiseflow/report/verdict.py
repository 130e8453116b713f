"""The verdict at the top of a report: grade, reasons, effects and the next step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from noiseflow.report.charts import COLOURS, Chart

if TYPE_CHECKING:
    from noiseflow.checks import Verdict
    from noiseflow.report.page import Report

_WORDS = {
    "good": "Good: no check found a fault.",
    "doubtful": "Doubtful: parts of the result may be wrong.",
    "bad": "Bad: do not use the result until you have corrected the first reason.",
}
_EFFECTS = (
    "The {shown} largest of {all} effects, with two standard errors. Right of the dashed line an effect exceeds its tolerance; "
    "it gives a reason if it is also significant."
)


def add_verdict(report: Report, verdict: Verdict, *, next_step: str = "", shown: int = 12) -> None:
    """Add heading, grade, reasons, the next step and effects of a verdict to a report.

    Args:
        report: the page.
        verdict: the verdict.
        next_step: what to do with a result that is not bad.
        shown: largest number of effects in the chart.
    """
    report.heading("Verdict")
    report.text(_WORDS[verdict.grade], kind=verdict.grade)
    reasons = [f"{reason[0].upper()}{reason[1:]}." for reason in verdict.reasons]
    if len(reasons) > 1:
        report.numbered(reasons)
    elif reasons:
        report.text(reasons[0])
    if next_step and verdict.grade != "bad":
        report.text(f"Next: {next_step}")
    count = sum(bool(each.get("tolerance")) for each in verdict.evidence.values())
    if count:
        caption = _EFFECTS.format(shown=min(count, shown), all=count)
        report.charts([effects_chart(verdict, shown=shown)], caption=caption)


def effect_size(effect: dict[str, Any]) -> float:
    """The size of an effect in tolerances."""
    return float(abs(effect["value"] - effect["null"]) / effect["tolerance"])


def effects_chart(verdict: Verdict, *, shown: int = 12, most: float = 4.0) -> Chart:
    """The largest effects of a verdict with two standard errors, in their tolerances; those beyond `most` are drawn there."""
    every = [(name, each) for name, each in verdict.evidence.items() if each.get("tolerance")]
    effects = sorted(every, key=lambda pair: -effect_size(pair[1]))[:shown]
    chart = Chart("Effects and their tolerances", x="size of the effect, tolerances", width=5.6, height=3.2)
    places = np.arange(len(effects))[::-1]
    sizes = np.array([effect_size(each) for _, each in effects])
    errors = np.array([each["error"] / each["tolerance"] for _, each in effects])
    fired = np.array([each["cost"] >= 1 for _, each in effects])
    for which, colour in ((~fired, COLOURS["accent"]), (fired, COLOURS["warm"])):
        size, error = (np.minimum(values, most)[which] for values in (sizes, 2 * errors))
        chart.plot(size, places[which], width=0, dots=2.5, error=error, across=True, colour=colour)
    chart.line(x=1.0)
    chart.ticks["y"] = list(zip(places.astype(float), (name for name, _ in effects), strict=True))
    chart.limits["x"] = -0.1, most + 0.2
    return chart
