"""The weight of a regulariser, chosen by the likelihood of pixels that the fit never saw."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from noiseflow.described import described


@described()
@dataclass(frozen=True)
class WeightChoice:
    """A weight and the evidence for it.

    Attributes:
        weight: the choice.
        tried: weight → held-out negative log-likelihood, nats per pixel, in the order tried.
    """

    weight: float
    tried: dict[float, float]


def choose_weight(
    held_out_nll: Callable[[float], float], first: float, *, factor: float = 2.0, most: int = 8
) -> WeightChoice:
    """Find the weight of the lowest held-out NLL: a geometric ladder brackets it, then half rungs, then the vertex of a parabola.

    Args:
        held_out_nll: fits with a weight and returns its held-out NLL.
        first: where to start.
        factor: between neighbouring rungs.
        most: fits to spend on the ladder; the lowest rung counts where they do not suffice to bracket.
    """
    tried: dict[float, float] = {}

    def visit(rung: float) -> None:
        nll = held_out_nll(first * factor**rung)
        tried[rung] = nll if math.isfinite(nll) else math.inf

    def lowest() -> float:
        return min(tried, key=lambda rung: tried[rung])

    visit(0.0)
    while len(tried) < most:
        middle = lowest()
        missing = [rung for rung in (middle + 1, middle - 1) if rung not in tried]
        if not missing:
            # the NLL rises faster above than below: a parabola through whole rungs would lean to weights too low
            for side in (-0.5, 0.5):
                visit(middle + side)
            break
        visit(missing[0])
    best = lowest()
    weight = first * factor ** (best + 0.5 * _vertex(*(tried.get(best + side, math.inf) for side in (-0.5, 0.0, 0.5))))
    return WeightChoice(weight, {first * factor**rung: nll for rung, nll in tried.items()})


def _vertex(left: float, middle: float, right: float) -> float:
    """Where the parabola through three equally spaced values is lowest, in steps from the middle one."""
    if not all(math.isfinite(value) for value in (left, middle, right)):
        return 0.0
    curvature = left - 2 * middle + right
    return 0.5 * (left - right) / curvature if curvature > 0 else 0.0
