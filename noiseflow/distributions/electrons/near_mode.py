"""Sums over the electrons near the mode of their posterior: Poisson probabilities, and probabilities of cells.

The probability of a cell is the sum over the electrons of its probabilities under normal distributions; its derivatives follow
from the same terms.
"""

import math

import torch
from torch import Tensor

from noiseflow.distributions.electrons.contour import poisson_normal_mode, positive_rate
from noiseflow.distributions.numerics.normal import FARTHEST, REACH


def log_poisson(count: Tensor, rate: Tensor) -> Tensor:
    """log P(k = count), with the leading terms of Stirling's formula paired with the rate to avoid cancellation."""
    positive, safe = positive_rate(rate)
    u = (count + 0.5 - safe) / safe
    at = count.clamp(max=1e7)  # above this, the remainder changes by less than 1e-8
    remainder = torch.lgamma(at + 1) - (at + 0.5) * (torch.log(at + 0.5) - 1)
    deviance = safe * ((1 + u) * torch.log1p(u) - u)
    none = torch.where(count > 0, torch.full_like(rate, -1e300), -rate)
    return torch.where(positive, -deviance - 0.5 * torch.log(safe) - remainder, none)


def draw_poisson(rate: Tensor, generator: torch.Generator | None, *, many: float = 1e9) -> Tensor:
    """One number of electrons of each rate, which may be NaN. Of `many`, rounded normal draws with the skewness of a Poisson law
    (Cornish and Fisher 1938): torch's are 19 % too wide at 10¹⁶, and overflow at 10¹⁹."""
    large = rate > many
    found = torch.poisson(torch.where(large, 0, torch.nan_to_num(rate, posinf=0)), generator=generator)
    if not bool(large.any()):
        return torch.where(torch.isnan(rate), rate, found)
    normal = torch.randn(rate.shape, generator=generator, dtype=rate.dtype, device=rate.device)
    spread = torch.sqrt(rate) * normal + (normal**2 - 1) / 6
    return torch.where(rate <= many, found, torch.round(rate + spread))


def lattice_mode(residual: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    with torch.no_grad():
        return torch.round((poisson_normal_mode(rate + residual + 0.5, rate, variance) - 0.5).clamp(min=0))


def posterior_mode(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """The most probable number of electrons if the residual is at the middle of a cell; 0 for unbounded cells."""
    middle, rate = ((low + high) / 2).detach(), rate.detach()
    return lattice_mode(torch.where(torch.isfinite(middle), middle, -rate), rate, read_noise.detach() ** 2)


def is_near_peak(
    low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor, *, widest: float = 10.0
) -> Tensor:
    """Where `peaks_and_slopes` may be used, boolean; `mode` is that of `posterior_mode`. Of cells wider than `widest` electrons,
    the sum has too many terms."""
    width, gap = high - low, (low + high) / 2 - (mode - rate)
    return (width > 0) & (width <= widest) & (gap.abs() - width / 2 <= FARTHEST * read_noise)


def peaks_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, mode: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """log P(low < residual ≤ high), and its derivatives with respect to all four arguments if requested.

    Args:
        low, high: (n,) observation − rate, electrons, float64; cells that `is_near_peak` accepts.
        rate: (n,) expected electrons, float64.
        mode: (n,) electrons, from `posterior_mode`.
        read_noise: scalar, electrons, float64.
    """
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
    unit = 1 / (sigma * math.sqrt(2 * math.pi) * total)
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
    near, far = (torch.erfc((distance + side * half) * (math.sqrt(0.5) / sigma)) for side in (-1, 1))
    return 0.5 * (near - far)
