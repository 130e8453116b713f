"""The exact law of shot noise plus read noise, in electrons: k + read_noise·n with k Poisson and n standard normal.

Two representations share the work; both are exact to about 1e-8 nats at any rate, and neither grows with the rate.

*Lattice*, where the read noise is below 1.5 electrons: the sum over k. Given an observation, k has a posterior narrower than the
read noise, so a dozen integers around its mode carry everything; neighbouring terms differ by a factor that needs no logarithm.

*Contour*, above: the inversion integral of the moment generating function (`electron_contour`), a dozen nodes or two.

Everything is computed in float64, because the fraction of an electron matters at a million electrons. Where the numerical route
has free choices (window, line), they are detached: the result does not depend on them, so neither does its gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from noiseflow.distributions.base import log_normal_cdf, log_normal_interval
from noiseflow.distributions.electron_contour import (
    contour_log_interval,
    contour_log_mass,
    log_contour_integral,
    poisson_normal_mode,
    positive_rate,
    saddle_point,
    tilted_rate,
)

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_RESOLVED = 1.5
_REACH = 6.5  # standard deviations whose complement, 1e-10, is left out
_FULL = 8.0  # standard deviations beyond which Φ is 0 or 1 to rounding
_STRONG = 30.0


def log_density(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """Log-density, nats per electron.

    Args:
        residual: observation − rate, electrons, float64.
        rate: expected electrons, ≥ 0, float64.
        read_noise: scalar, electrons, float64.
    """
    if float(read_noise.detach()) < _RESOLVED:
        return _lattice_log_density(residual, rate, read_noise)
    line = saddle_point(residual, rate, read_noise)
    one = torch.ones_like(line)
    return log_contour_integral(residual, rate, read_noise, line, one, lambda t: (one, torch.zeros_like(one)))


def log_tail(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """log P(beyond the observation), on the side away from the mean: above it for residuals > 0, else below it."""
    upper = residual.detach() > 0
    if float(read_noise.detach()) < _RESOLVED:
        return _lattice_log_tail(residual, rate, read_noise, upper)
    side = torch.where(upper, 1.0, -1.0).to(residual)
    saddle = saddle_point(residual, rate, read_noise)
    least = 2 / torch.sqrt(tilted_rate(rate, saddle) + read_noise**2).detach()
    line = side * torch.maximum(side * saddle, least)

    def factor(t: Tensor) -> tuple[Tensor, Tensor]:
        square = side * (line**2 + t**2)
        return line / square, -t / square

    return log_contour_integral(residual, rate, read_noise, line, side / line, factor)


def log_both_tails(residual: Tensor, rate: Tensor, read_noise: Tensor) -> tuple[Tensor, Tensor]:
    """``(log P(≤ observation), log P(> observation))``; infinite residuals allowed."""
    finite = torch.isfinite(residual)
    near = log_tail(torch.where(finite, residual, torch.zeros_like(residual)), rate, read_noise)
    near = torch.where(finite, near, torch.full_like(near, -math.inf))
    far = torch.where(finite, _log1mexp(torch.where(finite, near, near.new_tensor(-1.0))), torch.zeros_like(near))
    upper = residual > 0
    return torch.where(upper, far, near), torch.where(upper, near, far)


def log_interval(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """log P(low < residual ≤ high); the bounds, observation − rate in electrons, may be infinite."""
    width = high - low
    if float(read_noise.detach()) < _RESOLVED:
        narrow = width.detach() <= 3
        direct = _lattice_log_interval
    else:
        steepness = saddle_point((low + high) / 2, rate, read_noise).abs()
        narrow = width.detach() <= torch.minimum(torch.sqrt(rate + read_noise**2), 4 / steepness).detach()
        direct = contour_log_interval
    if bool(narrow.all()):
        return direct(low, high, rate, read_noise)
    wide = _log_difference_of_tails(low, high, rate, read_noise)
    if not bool(narrow.any()):
        return wide
    a, b = torch.where(narrow, low, torch.zeros_like(low)), torch.where(narrow, high, torch.ones_like(high))
    return torch.where(narrow, direct(a, b, rate, read_noise), wide)


def _log_difference_of_tails(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    (below_low, above_low), (below_high, above_high) = (log_both_tails(x, rate, read_noise) for x in (low, high))
    right = low > 0
    across = (low <= 0) & (high > 0)
    large, small = torch.where(right, above_low, below_high), torch.where(right, above_high, below_low)
    minus_one = torch.full_like(large, -1.0)
    ratio = torch.where(across | torch.isneginf(small), minus_one, small - large)
    difference = large + torch.where(torch.isneginf(small), torch.zeros_like(large), _log1mexp(ratio))
    outside = torch.where(across, below_low.exp() + above_high.exp(), torch.zeros_like(large))
    return torch.where(across, torch.log1p(-outside), difference)


def _log1mexp(value: Tensor) -> Tensor:
    """log(1 − exp(value)) for value < 0."""
    return torch.log1p(-torch.exp(value))


def _log_poisson(count: Tensor, rate: Tensor) -> Tensor:
    """log P(k = count): Stirling's leading terms are paired with the rate so that nothing large cancels."""
    positive, safe = positive_rate(rate)
    shifted = count + 0.5
    u = (shifted - safe) / safe
    at = count.clamp(max=1e7)  # beyond, the remainder changes by less than 1e-8
    remainder = torch.lgamma(at + 1) - (at + 0.5) * (torch.log(at + 0.5) - 1)
    deviance = safe * ((1 + u) * torch.log1p(u) - u)
    none = torch.where(count > 0, torch.full_like(rate, -1e300), -rate)
    return torch.where(positive, -deviance - 0.5 * torch.log(safe) - remainder, none)


def _lattice_mode(residual: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    with torch.no_grad():
        return torch.round((poisson_normal_mode(rate + residual + 0.5, rate, variance) - 0.5).clamp(min=0))


def _lattice_log_density(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    variance = read_noise**2
    mode = _lattice_mode(residual, rate, variance)
    gap = residual - (mode - rate)
    positive, safe = positive_rate(rate)
    up = tilted_rate(rate, (2 * gap - 1) / (2 * variance) - torch.log(mode + 1))
    inside = positive & (mode > 0)
    safe_mode = torch.where(inside, mode, torch.ones_like(mode))
    exponent = torch.log(safe_mode) - torch.log(safe) - (2 * gap + 1) / (2 * variance)
    down = torch.where(
        inside, torch.exp(torch.where(inside, exponent, torch.zeros_like(exponent))), torch.zeros_like(gap)
    )
    total = above = below = torch.ones_like(gap)
    for step in range(math.ceil(_REACH * float(read_noise.detach()))):
        decay = torch.exp(-step / variance)
        above = above * up * decay * ((mode + 1) / (mode + 1 + step))
        below = below * down * decay * ((safe_mode - step) / safe_mode)
        total = total + above + below
    at_mode = _log_poisson(mode, rate) - gap**2 / (2 * variance) - torch.log(read_noise) - _LOG_SQRT_2PI
    return at_mode + torch.log(total)


def _lattice_log_tail(residual: Tensor, rate: Tensor, read_noise: Tensor, upper: Tensor) -> Tensor:
    sigma = float(read_noise.detach())
    near, far = math.ceil(_REACH * sigma) + 1, math.ceil((_REACH + _FULL) * sigma) + 1
    mode = _lattice_mode(residual, rate, read_noise**2)
    start = torch.where(upper, mode - near, mode - far).clamp(min=0)
    side = torch.where(upper, 1.0, -1.0).to(residual)

    def log_part(count: Tensor) -> Tensor:
        return log_normal_cdf(side * (count - rate - residual) / read_noise)

    inside = _lattice_sum(start, near + far + 1, rate, log_part)
    return torch.logaddexp(inside, _log_full_mass(start, near + far + 1, rate, upper))


def _lattice_log_interval(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    reach = math.ceil(_REACH * float(read_noise.detach())) + 1
    start = (_lattice_mode(low, rate, read_noise**2) - reach).clamp(min=0)

    def log_part(count: Tensor) -> Tensor:
        gap = count - rate
        return log_normal_interval((low - gap) / read_noise, (high - gap) / read_noise)

    return _lattice_sum(start, 2 * reach + 5, rate, log_part)


def _lattice_sum(start: Tensor, count: int, rate: Tensor, log_part: Callable[[Tensor], Tensor]) -> Tensor:
    """log Σ P(k)·exp(log_part(k)) over `count` integers from `start` on."""
    positive, safe = positive_rate(rate)
    log_rate = torch.where(positive, torch.log(safe), torch.full_like(safe, -1e30))
    log_mass = _log_poisson(start, rate)
    total = log_mass + log_part(start)
    for step in range(1, count):
        log_mass = log_mass + log_rate - torch.log(start + step)
        total = torch.logaddexp(total, log_mass + log_part(start + step))
    return total


def _log_full_mass(start: Tensor, count: int, rate: Tensor, upper: Tensor) -> Tensor:
    """log P(k ≥ start + count) where `upper`, else log P(k < start)."""
    positive, safe = positive_rate(rate)
    edge = torch.where(upper, start + count, start.clamp(min=1))
    possible = positive & (upper | (start > 0))
    strong = torch.minimum(safe, edge).detach() > _STRONG
    log_mass = torch.full_like(rate, -1e300)
    if not bool(strong.all()):
        log_mass = _log_gamma_mass(edge, safe, upper)
    if bool(strong.any()):
        large = contour_log_mass(edge.clamp(min=_STRONG), safe.clamp(min=_STRONG), upper)
        log_mass = torch.where(strong, large, log_mass)
    return torch.where(possible, log_mass, torch.full_like(log_mass, -1e300))


def _log_gamma_mass(edge: Tensor, rate: Tensor, upper: Tensor) -> Tensor:
    mass = torch.where(upper, torch.special.gammainc(edge, rate), torch.special.gammaincc(edge, rate))
    shown = mass > 1e-290
    # so far out the masses fall geometrically from the edge
    last = torch.where(upper, edge, edge - 1)
    ratio = torch.where(upper, rate / (edge + 1), last / rate).clamp(max=0.5)
    beyond = _log_poisson(last, rate) - torch.log1p(-ratio)
    return torch.where(shown, torch.log(torch.where(shown, mass, torch.ones_like(mass))), beyond)
