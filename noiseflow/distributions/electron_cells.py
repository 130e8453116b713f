"""The mass of narrow cells under shot plus read noise, and its derivatives, in one pass over a dozen electrons.

A cell of a converter is about as wide as the read noise or narrower. Its mass is the integral of the density by Gauss–Legendre's
rule, and the density is a sum over the electrons k near the mode of their posterior. One loop over k serves all nodes. The
derivatives follow in closed form from the same sums: with p the density, M the mass between a and b, E the posterior mean,

    ∂M/∂a = −p(a),  ∂M/∂b = p(b),  ∂log M/∂rate = E[k]/rate − 1,  ∂M/∂read_noise = read_noise·(p′(b) − p′(a)),

the last because a normal density obeys the heat equation.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from noiseflow.distributions.electron_contour import positive_rate, tilted_rate
from noiseflow.distributions.electron_terms import REACH, lattice_mode, log_poisson

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
WIDEST = 4.0  # read noises: beyond, exponents of the outer nodes would grow to e¹⁷ and the nodes to many
STEEPEST = 4.0  # log-units across a cell: beyond, the rule has too few nodes
LEAST_READ_NOISE, MOST_READ_NOISE = 0.05, 6.0  # electrons: exponents overflow below, the contour integral is cheaper above


@functools.cache
def _nodes(count: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Gauss–Legendre's nodes on [−1, 1], then both ends; the weights of the former, sum 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (*nodes.tolist(), -1.0, 1.0), tuple((weights / 2).tolist())


def posterior_mode(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """The likeliest electrons given that the residual is at the middle of a cell; 0 for unbounded cells."""
    middle = ((low + high) / 2).detach()
    return lattice_mode(torch.where(torch.isfinite(middle), middle, -rate.detach()), rate.detach(), read_noise.detach() ** 2)


def is_narrow(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, mode: Tensor) -> Tensor:
    """Where `log_cell` may be used, boolean; `mode` is that of `posterior_mode`."""
    with torch.no_grad():
        width, gap = high - low, (low + high) / 2 - (mode - rate)
        return (width <= WIDEST * read_noise) & (gap.abs() * width <= STEEPEST * read_noise**2)


def log_cell(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, mode: Tensor) -> Tensor:
    """log P(low < residual ≤ high) of narrow cells, differentiable once.

    Args:
        low, high: (n,) observation − rate, electrons, float64.
        rate: (n,) expected electrons, float64.
        read_noise: scalar, electrons, float64.
        mode: (n,) that of `posterior_mode`.
    """
    found: Tensor = _Cell.apply(low, high, rate, read_noise, mode)  # type: ignore[no-untyped-call]
    return found


class _Cell(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, mode: Tensor) -> Tensor:
        wanted = any(ctx.needs_input_grad)
        value, slopes = _mass_and_slopes(low, high, rate, read_noise, mode, slopes=wanted)
        ctx.save_for_backward(*slopes)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        low, high, rate, read_noise = ctx.saved_tensors
        return gradient * low, gradient * high, gradient * rate, (gradient * read_noise).sum(), None


def _mass_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, mode: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    variance, sigma = read_noise**2, float(read_noise)
    middle, half = (low + high) / 2, (high - low) / 2
    gap = middle - (mode - rate)
    widest = float(half.max()) if half.numel() else 0.0
    # two nodes per read noise and four to begin with keep the rule's error below 1e-8
    places, weights = _nodes(4 + math.ceil(5 * widest / sigma))
    inner = len(weights)
    ends = slice(None) if slopes else slice(inner)
    offset = half * half.new_tensor(places[ends])[:, None]
    total, first, ahead = _sums(gap + offset, mode, rate, variance, math.ceil(REACH * sigma + widest), first=slopes)
    scale = torch.exp(-offset * (2 * gap + offset) / (2 * variance))
    weight = half.new_tensor(weights)[:, None]
    mass = (weight * scale[:inner] * total[:inner]).sum(0)
    at_mode = log_poisson(mode, rate) - gap**2 / (2 * variance) - torch.log(read_noise) - _LOG_SQRT_2PI
    value = at_mode + torch.log(mass * (2 * half))
    if not slopes:
        return value, ()
    density = scale[inner:] * total[inner:] / (mass * 2 * half)
    steepness = -(scale[inner:] * ((gap + offset[inner:]) * total[inner:] - first[inner:]) / variance) / (mass * 2 * half)
    excess = (weight * scale[:inner] * first[:inner]).sum(0) / mass
    positive, safe = positive_rate(rate)
    without = (weight * scale[:inner] * ahead[:inner]).sum(0) / mass - 1
    of_rate = torch.where(positive, (mode - rate + excess) / safe, without)
    of_noise = read_noise * (steepness[1] - steepness[0])
    return value, (-density[0], density[1], of_rate + density[1] - density[0], of_noise)


def _sums(
    gap: Tensor, mode: Tensor, rate: Tensor, variance: Tensor, reach: int, *, first: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Σ of the terms of all k, over that of the mode; Σ of (k − mode) times them; and what they tend to at no rate.

    Args:
        gap: (m, n) distances of the nodes from the mode.
    """
    positive, safe = positive_rate(rate)
    growth = (2 * gap - 1) / (2 * variance)
    up = tilted_rate(rate, growth - torch.log(mode + 1))
    inside = positive & (mode > 0)
    safe_mode = torch.where(inside, mode, torch.ones_like(mode))
    down = torch.exp((torch.log(safe_mode) - torch.log(safe) - 1 / variance).masked_fill(~inside, -math.inf) - growth)
    total, moment = torch.ones_like(gap), torch.zeros_like(gap)
    above, below = total.clone(), total.clone()
    for step in range(reach):
        decay = torch.exp(-step / variance)
        above.mul_(up).mul_(decay * (mode + 1) / (mode + 1 + step))
        below.mul_(down).mul_(decay * ((safe_mode - step) / safe_mode))
        total.add_(above).add_(below)
        if first:
            moment.add_(above, alpha=step + 1).sub_(below, alpha=step + 1)
    return total, moment, torch.exp(growth.clamp(max=60))
