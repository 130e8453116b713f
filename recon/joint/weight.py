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
    """Find the weight of the lowest held-out NLL: a geometric ladder brackets it, then half a rung to
    the side of the lower neighbour, then the vertex of a parabola.

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
            visit(middle + math.copysign(0.5, tried[middle - 1] - tried[middle + 1]))
            break
        visit(missing[0])
    return WeightChoice(first * factor ** _vertex(tried), {first * factor**rung: nll for rung, nll in tried.items()})


def _vertex(tried: dict[float, float]) -> float:
    """Where the parabola through the lowest of the rungs and its neighbours on either side is lowest."""
    best = min(tried, key=lambda rung: tried[rung])
    below = max((rung for rung in tried if rung < best), default=None)
    above = min((rung for rung in tried if rung > best), default=None)
    if below is None or above is None or not all(math.isfinite(tried[rung]) for rung in (below, above)):
        return best
    left, right = (tried[best] - tried[below]) / (best - below), (tried[above] - tried[best]) / (above - best)
    if not right > left:
        return best
    # where the slope, left and right half-way to the neighbours, is zero
    return 0.5 * (below + best) - left * 0.5 * (above - below) / (right - left)
