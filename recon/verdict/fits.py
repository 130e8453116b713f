"""Checks of convergence, regulariser weight, and determination of the tilt axis."""

from __future__ import annotations

import math
from typing import Any

from recon.series.alignment import Alignment
from recon.verdict.verdict import Finding

_MARGIN = 2.0  # standard errors: a lead with a probability of 1 in 40 by chance
_JUMP = 0.1  # nats per pixel above the best evaluation; final steps normally change the likelihood by some thousandths


def axis(alignment: Alignment | None) -> tuple[dict[str, Any], list[Finding]]:
    """Lead of the tilt axis over other directions."""
    if alignment is None or alignment.margin is None:
        return {}, []
    evidence = {"axis margin": alignment.margin}
    if alignment.margin >= _MARGIN:
        return evidence, []
    words = f"another tilt axis explains the images nearly as well, {alignment.margin:.1f} standard errors behind"
    advice = "give the direction with --tilt-axis"
    return evidence, [Finding("axis", min(2.9, _MARGIN / max(alignment.margin, 0.1)), words, advice)]


def convergence(fit_result: Any) -> tuple[dict[str, Any], list[Finding]]:
    """The held-out likelihood along the fit."""
    history = [] if fit_result is None else [float(value) for value in dict(fit_result.history).values()]
    if not history:
        return {}, []
    if not all(math.isfinite(value) for value in history):
        words = "the held-out likelihood became infinite"
        return {"held-out NLL jump": None}, [Finding("fit", 5.0, words, "report this series, or use --method sirt")]
    jump = history[-1] - min(history)
    evidence = {"held-out NLL jump": jump}
    if jump < _JUMP:
        return evidence, []
    words = f"the held-out likelihood at the end was {jump:.2g} nats per pixel worse than before"
    return evidence, [Finding("fit", min(3.5, 1 + jump / (5 * _JUMP)), words, "compare with --method l2 or sirt")]


def weight(tried: dict[float, float]) -> tuple[dict[str, Any], list[Finding]]:
    """Check whether the best of the tried weights is at an end of the range, so that a better one may be outside."""
    if len(tried) < 2:
        return {}, []
    best = min(tried, key=lambda weight: tried[weight])
    if best == min(tried):  # the fit follows structure that is not noise
        words = f"held-out pixels prefer a weight of the regulariser below the lowest one tried, {best:.2g}"
        return {}, [Finding("weight", 2.0, words, "give --weight, about 0.4 to 1, and compare with --method l2")]
    if best == max(tried):  # the residuals are misfit that only the regulariser reduces, and the volume becomes blocky
        words = f"held-out pixels prefer a weight of the regulariser above the highest one tried, {best:.2g}"
        advice = "compare with --method l2, and align the series: the residuals are misfit rather than noise"
        return {}, [Finding("weight", 2.0, words, advice)]
    return {}, []
