"""Choice of the regulariser weight by the likelihood of held-out pixels."""

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
        weight: the chosen weight.
        tried: weight → held-out negative log-likelihood, nats per pixel, in the order tried.
    """

    weight: float
    tried: dict[float, float]


def choose_weight(
    held_out_nll: Callable[[float], float], first: float, *, factor: float = 2.0, most: int = 8
) -> WeightChoice:
    """Find the weight with the lowest held-out NLL.

    A geometric ladder of weights brackets the minimum. Half a rung towards the lower neighbour is tried next, then the vertex of
    a parabola.

    Args:
        held_out_nll: function that fits with a weight and returns the held-out NLL.
        first: initial weight.
        factor: ratio of neighbouring rungs.
        most: largest number of fits on the ladder; if they do not bracket the minimum, the lowest rung is chosen.
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
            # the NLL rises faster above the minimum than below: a parabola through whole rungs would be biased to low weights
            visit(middle + math.copysign(0.5, tried[middle - 1] - tried[middle + 1]))
            break
        visit(missing[0])
    return WeightChoice(first * factor ** _vertex(tried), {first * factor**rung: nll for rung, nll in tried.items()})


def _vertex(tried: dict[float, float]) -> float:
    """The vertex of the parabola through the lowest rung and its neighbours."""
    best = min(tried, key=lambda rung: tried[rung])
    below = max((rung for rung in tried if rung < best), default=None)
    above = min((rung for rung in tried if rung > best), default=None)
    if below is None or above is None or not all(math.isfinite(tried[rung]) for rung in (below, above)):
        return best
    left, right = (tried[best] - tried[below]) / (best - below), (tried[above] - tried[best]) / (above - best)
    if not right > left:
        return best
    # zero of the linearly interpolated slope between the midpoints to the neighbours
    return 0.5 * (below + best) - left * 0.5 * (above - below) / (right - left)
