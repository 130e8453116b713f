"""Probability of cells under shot plus read noise, with derivatives, where single-electron peaks are resolved.

The probability is a sum over the few electrons k near the mode of their posterior. Each term is the probability of the cell under
a normal distribution, computed with the complementary error function. This is used for cells that are too wide or too steep for
the quadrature of `electron_cells`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from noiseflow.distributions.electrons.contour import positive_rate
from noiseflow.distributions.electrons.poisson_terms import REACH, log_poisson

WIDEST = 3.0  # electrons: the sum then has at most two dozen terms
# Distance from the nearest electron, in read noises; beyond it, probabilities near e⁻⁴⁵⁰ would underflow
_FARTHEST = 30.0
_SQRT_2PI, _SQRT_HALF = math.sqrt(2 * math.pi), math.sqrt(0.5)


def is_near_peak(low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor) -> Tensor:
    """Where `peaks_and_slopes` may be used, boolean; `mode` is that of `posterior_mode`."""
    width, gap = high - low, (low + high) / 2 - (mode - rate)
    return (width > 0) & (width <= WIDEST) & (gap.abs() - width / 2 <= _FARTHEST * read_noise)


def peaks_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """As `electron_cells.cell_and_slopes`, for cells that `is_near_peak` accepts."""
    sigma = float(read_noise)
    half = (high - low) / 2
    gap = (low + high) / 2 - (mode - rate)
    reach = math.ceil(REACH * sigma + float(half.max())) + 1
    total, moment, at_low, at_high, stretch = (torch.zeros_like(gap) for _ in range(5))
    for number, weight in _weights(mode, rate, reach):
        apart = gap - number
        mass = weight * _cell(apart, half, sigma)
        total += mass
        if slopes:
            moment += number * mass
            below, above = (apart - half) / sigma, (apart + half) / sigma
            bottom, top = (weight * torch.exp(-0.5 * end * end) for end in (below, above))
            at_low += bottom
            at_high += top
            stretch += below * bottom - above * top
    value = log_poisson(mode, rate) + torch.log(total)
    if not slopes:
        return value, ()
    unit = 1 / (sigma * _SQRT_2PI * total)
    positive, safe = positive_rate(rate)
    # at rate 0 the derivative is the contribution of a first electron
    of_rate = torch.where(positive, (mode - rate + moment / total) / safe, _cell(gap - 1, half, sigma) / total - 1)
    of_low, of_high = -at_low * unit, at_high * unit
    return value, (of_low, of_high, of_rate + of_low + of_high, stretch * unit)


def _weights(mode: Tensor, rate: Tensor, reach: int) -> list[tuple[int, Tensor]]:
    """Poisson probabilities of mode − reach … mode + reach electrons relative to that of the mode, with k − mode."""
    _, safe = positive_rate(rate)
    up = down = torch.ones_like(mode)
    found = [(0, up)]
    for step in range(1, reach + 1):
        up = up * (rate / (mode + step))
        down = down * ((mode - step + 1) / safe)
        found += [(step, up), (-step, down)]
    return found


def _cell(apart: Tensor, half: Tensor, sigma: float) -> Tensor:
    """Probability of a cell under a normal distribution, from the more accurate tail; `apart` is middle − mean."""
    distance = apart.abs()
    near, far = (torch.erfc((distance + side * half) * (_SQRT_HALF / sigma)) for side in (-1, 1))
    return 0.5 * (near - far)
