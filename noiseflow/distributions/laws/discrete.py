"""Levels of discrete observations, and the probability of ranges of them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import constraints

_FEW = 8  # up to this number of levels, probabilities are added one by one, which is exact even if they are tiny


class DiscreteLevels(constraints.Constraint):
    """Constraint to levels: multiples of a step from an origin, between two limits, which are levels too.

    Args:
        step: spacing, detector units.
        origin: one of the levels.
        low, high: the smallest and the largest level.
    """

    is_discrete = True

    def __init__(self, step: float, origin: float, low: float, high: float) -> None:
        self.step, self.origin, self.lower_bound, self.upper_bound = step, origin, low, high

    def __repr__(self) -> str:
        return f"DiscreteLevels(step={self.step:g}, low={self.lower_bound:g}, high={self.upper_bound:g})"

    def check(self, value: Tensor) -> Tensor:
        """Which values are levels, boolean."""
        steps = (value - self.origin) / self.step
        on_level = (steps - torch.round(steps)).abs() < 1e-3
        at_limit = (value == self.lower_bound) | (value == self.upper_bound)
        return (on_level | at_limit) & (value >= self.lower_bound) & (value <= self.upper_bound)


def between(distribution: Any, low: Tensor, high: Tensor) -> Tensor:
    """log P(low < k ≤ high) for integers k; the bounds are integers or infinite.

    Args:
        distribution: has ``log_masses(count)``, and ``masses_up_to(count, beyond=…)`` for both tails.
        low, high: bounds that broadcast with the batch of the distribution.
    """
    few = (high - low <= _FEW) & torch.isfinite(low) & torch.isfinite(high)
    start = torch.where(few, low, torch.zeros_like(low))
    parts = []
    for step in range(1, _FEW + 1):
        mass = distribution.log_masses(start + step)
        parts.append(torch.where(start + step <= high, mass, torch.full_like(mass, -math.inf)))
    summed = log_sum(torch.stack(parts))
    lower, upper = ([distribution.masses_up_to(bound, beyond=b) for bound in (low, high)] for b in (False, True))
    # use the smaller tail, which is the more accurate one
    many = torch.where(lower[0] < 0.5, lower[1] - lower[0], upper[0] - upper[1]).clamp(min=0)
    positive = many > 0
    log_many = torch.where(positive, torch.log(torch.where(positive, many, torch.ones_like(many))), -math.inf)
    return torch.where(few, summed, log_many)


def log_sum(log_masses: Tensor) -> Tensor:
    """logsumexp along the first axis, with a gradient of zero where all are −inf."""
    none = torch.isneginf(log_masses).all(0)
    found = torch.logsumexp(torch.where(none, torch.zeros_like(log_masses), log_masses), 0)
    return torch.where(none, torch.full_like(found, -math.inf), found)
