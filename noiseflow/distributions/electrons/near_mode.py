"""Sums over the electrons near the mode of their posterior: Poisson probabilities, and probabilities of cells in one pass.

The probability of a narrow cell is the integral of the density by the Gauss–Legendre rule, and the density is a sum over the
electrons k. Derivatives follow from the same sums (density p, mass M between a and b, posterior mean E):

    ∂M/∂a = −p(a),  ∂M/∂b = p(b),  ∂log M/∂rate = E[k]/rate − 1,  ∂M/∂read_noise = read_noise·(p′(b) − p′(a)).

A cell that is too wide or too steep for this is a sum of its probabilities under normal distributions.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from noiseflow.distributions.electrons.contour import poisson_normal_mode, positive_rate
from noiseflow.distributions.numerics.normal import LOG_SQRT_2PI

REACH = 6.5  # half-width of the sum over electrons, in standard deviations: omits 1e-10, less than the quadrature error 3e-7


def log_poisson(count: Tensor, rate: Tensor) -> Tensor:
    """log P(k = count), with the leading terms of Stirling's formula paired with the rate to avoid cancellation."""
    positive, safe = positive_rate(rate)
    shifted = count + 0.5
    u = (shifted - safe) / safe
    at = count.clamp(max=1e7)  # above this, the remainder changes by less than 1e-8
    remainder = torch.lgamma(at + 1) - (at + 0.5) * (torch.log(at + 0.5) - 1)
    deviance = safe * ((1 + u) * torch.log1p(u) - u)
    none = torch.where(count > 0, torch.full_like(rate, -1e300), -rate)
    return torch.where(positive, -deviance - 0.5 * torch.log(safe) - remainder, none)


def lattice_mode(residual: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    with torch.no_grad():
        return torch.round((poisson_normal_mode(rate + residual + 0.5, rate, variance) - 0.5).clamp(min=0))


MOST_ELECTRONS = 3.0  # width of a cell: the sum then has at most two dozen terms
# Distance from the nearest electron, in read noises; beyond it, probabilities near e⁻⁴⁵⁰ would underflow
_FARTHEST = 30.0
_SQRT_2PI, _SQRT_HALF = math.sqrt(2 * math.pi), math.sqrt(0.5)


def is_near_peak(low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor) -> Tensor:
    """Where `peaks_and_slopes` may be used, boolean; `mode` is that of `posterior_mode`."""
    width, gap = high - low, (low + high) / 2 - (mode - rate)
    return (width > 0) & (width <= MOST_ELECTRONS) & (gap.abs() - width / 2 <= _FARTHEST * read_noise)


def peaks_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """As `cell_and_slopes`, for cells that `is_near_peak` accepts."""
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


WIDEST = 4.0  # in units of the read noise: wider cells need many nodes, and the exponents of the outer nodes would grow to e¹⁷
STEEPEST = 2.0  # log-units across a cell: four nodes then err by 3e-7
# Electrons: exponents overflow below, the contour integral is cheaper above
LEAST_READ_NOISE, MOST_READ_NOISE = 0.05, 6.0


@functools.cache
def _nodes(count: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Gauss–Legendre nodes on [−1, 1] followed by both ends, and the weights of the former, with sum 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (*nodes.tolist(), -1.0, 1.0), tuple((weights / 2).tolist())


def posterior_mode(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """The most probable number of electrons if the residual is at the middle of a cell; 0 for unbounded cells."""
    middle = ((low + high) / 2).detach()
    return lattice_mode(
        torch.where(torch.isfinite(middle), middle, -rate.detach()), rate.detach(), read_noise.detach() ** 2
    )


def is_narrow(low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor) -> Tensor:
    """Where `cell_and_slopes` may be used, boolean; `mode` is that of `posterior_mode`."""
    with torch.no_grad():
        width, gap = high - low, (low + high) / 2 - (mode - rate)
        return (width <= WIDEST * read_noise) & (gap.abs() * width <= STEEPEST * read_noise**2)


def cell_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """log P(low < residual ≤ high) of narrow cells, and its derivatives with respect to all four arguments if requested.

    Args:
        low, high: (n,) observation − rate, electrons, float64.
        rate: (n,) expected electrons, float64.
        mode: (n,) electrons, from `posterior_mode`.
        read_noise: scalar, electrons, float64.
    """
    variance, sigma = read_noise**2, float(read_noise)
    middle, half = (low + high) / 2, (high - low) / 2
    gap = middle - (mode - rate)
    widest = float(half.max()) if half.numel() else 0.0
    # four nodes suffice for half a read noise, and four more for each one beyond: errors stay below 1e-6
    places, weights = _nodes(max(4, 2 + math.ceil(8 * widest / sigma)))
    inner = len(weights)
    ends = slice(None) if slopes else slice(inner)
    offset = half * half.new_tensor(places[ends])[:, None]
    total, first = _sums(gap, offset, mode, rate, variance, math.ceil(REACH * sigma + widest), first=slopes)
    scale = torch.exp(-offset * (2 * gap + offset) / (2 * variance))
    weight = half.new_tensor(weights)[:, None]
    mass = (weight * scale[:inner] * total[:inner]).sum(0)
    at_mode = log_poisson(mode, rate) - gap**2 / (2 * variance) - torch.log(read_noise) - LOG_SQRT_2PI
    value = at_mode + torch.log(mass * (2 * half))
    if not slopes:
        return value, ()
    density = scale[inner:] * total[inner:] / (mass * 2 * half)
    steepness = -(scale[inner:] * ((gap + offset[inner:]) * total[inner:] - first[inner:]) / variance) / (
        mass * 2 * half
    )
    excess = (weight * scale[:inner] * first[:inner]).sum(0) / mass
    positive, safe = positive_rate(rate)
    of_rate = (mode - rate + excess) / safe
    if not bool(positive.all()):  # the limit at rate 0: the contribution of a first electron
        ahead = torch.exp(((2 * (gap + offset[:inner]) - 1) / (2 * variance)).clamp(max=60))
        of_rate = torch.where(positive, of_rate, (weight * scale[:inner] * ahead).sum(0) / mass - 1)
    of_noise = read_noise * (steepness[1] - steepness[0])
    return value, (-density[0], density[1], of_rate + density[1] - density[0], of_noise)


def _sums(
    gap: Tensor, offset: Tensor, mode: Tensor, rate: Tensor, variance: Tensor, reach: int, *, first: bool
) -> tuple[Tensor, Tensor]:
    """Sum over k of the terms relative to that of the mode, and sum of (k − mode) times the terms, (m, n) each.

    Args:
        gap: (n,) distance of each cell's middle from the mode.
        offset: (m, n) distance of the nodes from the middle.
    """
    positive, safe = positive_rate(rate)
    inside = positive & (mode > 0)
    safe_mode = torch.where(inside, mode, torch.ones_like(mode))
    log_rate, growth = torch.log(safe), (2 * gap - 1) / (2 * variance)
    # filled, not multiplied by 0: far from the mode an unused ratio is infinite
    up = torch.exp(log_rate + growth - torch.log(mode + 1)).masked_fill(~positive, 0)
    down = torch.exp(torch.log(safe_mode) - log_rate - 1 / variance - growth).masked_fill(~inside, 0)
    stretch = torch.exp(offset / variance)
    above = up * stretch
    below = torch.div(down, stretch, out=stretch)
    ahead = [math.exp(-k / float(variance)) * (mode + 1) / (mode + 1 + k) for k in range(reach)]
    behind = [math.exp(-k / float(variance)) * (1 - k / safe_mode) for k in range(reach)]
    if not first:
        return _nested(above, ahead).add_(_nested(below, behind)).sub_(1), above
    total, moment = _nested_with_moment(above, ahead)
    more, less = _nested_with_moment(below, behind)
    return total.add_(more).sub_(1), moment.sub_(less)


def _nested(ratio: Tensor, factors: list[Tensor]) -> Tensor:
    """1 + r·f₀·(1 + r·f₁·(1 + …))."""
    total = torch.ones_like(ratio)
    for factor in reversed(factors):
        total.mul_(ratio).mul_(factor).add_(1)
    return total


def _nested_with_moment(ratio: Tensor, factors: list[Tensor]) -> tuple[Tensor, Tensor]:
    """The sum of `_nested`, and the sum of its terms times their indices."""
    total, moment = torch.ones_like(ratio), torch.zeros_like(ratio)
    for factor in reversed(factors):
        moment.add_(total).mul_(ratio).mul_(factor)
        total.mul_(ratio).mul_(factor).add_(1)
    return total, moment
