"""Statistics of the fit: its held-out likelihood, the choice of its weight, and the lead of its tilt axis."""

from __future__ import annotations

import math
from typing import Any

from noiseflow.checks import Effect
from recon.series.alignment import Alignment


def jump(fit_result: Any) -> Effect:
    """Held-out likelihood at the end minus the best before, nats per pixel."""
    history = [] if fit_result is None else [float(value) for value in dict(fit_result.history).values()]
    if not history:
        return Effect(0.0)
    return Effect(history[-1] - min(history) if all(math.isfinite(value) for value in history) else 1e3)


def weight_at_end(tried: dict[float, float]) -> Effect:
    """1 if the best of the tried weights is the largest, −1 if it is the smallest: a better one may be outside."""
    if len(tried) < 2:
        return Effect(0.0)
    best = min(tried, key=lambda weight: tried[weight])
    end = (best == max(tried)) - (best == min(tried))
    return Effect(end, what=f"{'above the highest' if end > 0 else 'below the lowest'} one tried, {best:.2g}")


def other_axis(alignment: Alignment | None) -> Effect:
    """Two standard errors over the lead of the tilt axis: a smaller lead has a probability of 1 in 40 by chance."""
    if alignment is None or alignment.margin is None:
        return Effect(0.0)
    return Effect(2 / max(alignment.margin, 0.1), what=f"{alignment.margin:.1f}")
