"""Quadrature under a noise distribution: nodes on panels, and the mode."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

_NODES, _WEIGHTS = (each.tolist() for each in np.polynomial.legendre.leggauss(4))
_REFINEMENTS, _FINER = 3, 17  # for the mode: each refinement divides the interval around the best node by 16


def panels(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Gauss–Legendre nodes and weights (4·count, *shape) on equal panels between two bounds of any shape."""
    ones = (1,) * low.ndim
    start = torch.arange(count, dtype=low.dtype, device=low.device).view(-1, 1, *ones)
    places = low.new_tensor(_NODES).view(1, -1, *ones)
    fraction = ((start + (places + 1) / 2) / count).flatten(0, 1)
    weight = (low.new_tensor(_WEIGHTS) / (2 * count)).repeat(count).view(-1, *ones)
    return low + (high - low) * fraction, weight * (high - low)


@torch.no_grad()
def mode_of(distribution: Any) -> Tensor:
    """The mode: the best node of the quadrature, refined if observations are continuous."""
    nodes = torch.sort(distribution.quadrature()[0], 0).values
    best = distribution.log_prob(nodes).argmax(0, keepdim=True)
    if distribution.discrete:
        return nodes.gather(0, best)[0]
    low, high = (nodes.gather(0, (best + step).clamp(0, nodes.shape[0] - 1)) for step in (-1, 1))
    fraction = torch.linspace(0, 1, _FINER, dtype=nodes.dtype, device=nodes.device).view(-1, *(1,) * (nodes.ndim - 1))
    for _ in range(_REFINEMENTS):
        finer = low + (high - low) * fraction
        best = distribution.log_prob(finer).argmax(0, keepdim=True)
        low, high = (finer.gather(0, (best + step).clamp(0, _FINER - 1)) for step in (-1, 1))
    return ((low + high) / 2)[0]
