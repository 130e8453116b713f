"""The exact law of shot noise plus read noise, in electrons: k + read_noise·n with k Poisson and n standard normal.

Two representations share the work; both are exact to about 1e-8 nats at any rate, and neither grows with the rate.

*Lattice*, where the read noise is below 1.5 electrons: the sum over k. Given an observation, k has a posterior narrower than the
read noise, so a dozen integers around its mode carry everything; neighbouring terms differ by a factor that needs no logarithm.

*Contour*, above: the inversion integral of the moment generating function exp(K(s)), K(s) = rate·(eˢ − 1) + read_noise²·s²/2,
along the vertical line through its saddle point. There its integrand is a bell without oscillation, which the trapezoidal rule
integrates to rounding with a dozen nodes or two (the integral that Lugannani & Rice 1980, doi:10.2307/1426607, expand). Tail
probabilities have a further factor 1/s; the line then keeps its distance from the pole at 0.

Everything is computed in float64, because the fraction of an electron matters at a million electrons. Where the numerical route
has free choices (window, line), they are detached: the result does not depend on them, so neither does its gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from noiseflow.distributions import log_normal_interval

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_RESOLVED = 1.5
_REACH = 6.5  # standard deviations whose complement, 1e-10, is left out
_FULL = 8.0  # standard deviations beyond which Φ is 0 or 1 to rounding
_NO_RATE = 1e-30
_STRONG = 30.0
_NODES_PER_DEVIATION = 10 / (2 * math.pi)

Factor = Callable[[Tensor], tuple[Tensor, Tensor]]


def log_density(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """Log-density, nats per electron.

    Args:
        residual: observation − rate, electrons, float64.
        rate: expected electrons, ≥ 0, float64.
        read_noise: scalar, electrons, float64.
    """
    if float(read_noise.detach()) < _RESOLVED:
        return _lattice_log_density(residual, rate, read_noise)
    line = _saddle(residual, rate, read_noise)
    one = torch.ones_like(line)
    return _contour(residual, rate, read_noise, line, one, lambda t: (one, torch.zeros_like(one)))


def log_tail(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """log P(beyond the observation), on the side away from the mean: above it for residuals > 0, else below it."""
    upper = residual.detach() > 0
    if float(read_noise.detach()) < _RESOLVED:
        return _lattice_log_tail(residual, rate, read_noise, upper)
    side = torch.where(upper, 1.0, -1.0).to(residual)
    saddle = _saddle(residual, rate, read_noise)
    least = 2 / torch.sqrt(_tilted(rate, saddle) + read_noise**2).detach()
    line = side * torch.maximum(side * saddle, least)

    def factor(t: Tensor) -> tuple[Tensor, Tensor]:
        square = side * (line**2 + t**2)
        return line / square, -t / square

    return _contour(residual, rate, read_noise, line, side / line, factor)


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
        steepness = _saddle((low + high) / 2, rate, read_noise).abs()
        narrow = width.detach() <= torch.minimum(torch.sqrt(rate + read_noise**2), 4 / steepness).detach()
        direct = _contour_log_interval
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


def log_ndtr(value: Tensor) -> Tensor:
    """log Φ(value) whose gradient, unlike that of torch's own, stays finite however far the tail."""
    tail = value < -1
    x = torch.where(tail, -value, torch.ones_like(value)) / math.sqrt(2)
    far = torch.log(torch.special.erfcx(x) / 2) - x * x
    near: Tensor = torch.special.log_ndtr(torch.where(tail, torch.zeros_like(value), value))
    return torch.where(tail, far, near)


def _log1mexp(value: Tensor) -> Tensor:
    """log(1 − exp(value)) for value < 0."""
    return torch.log1p(-torch.exp(value))


def _positive(rate: Tensor) -> tuple[Tensor, Tensor]:
    positive = rate > _NO_RATE
    return positive, torch.where(positive, rate, torch.ones_like(rate))


def _tilted(rate: Tensor, exponent: Tensor) -> Tensor:
    """rate·exp(exponent), where the product is representable though its factors need not be."""
    positive, safe = _positive(rate)
    large = torch.exp(torch.log(safe) + torch.where(positive, exponent, torch.zeros_like(exponent)))
    return torch.where(positive, large, rate * torch.exp(exponent.clamp(max=60)))


def _mode(observation: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    """The m that solves m + variance·log(m/rate) = observation: Wright's omega function, by Newton's method."""
    positive, safe = _positive(rate)
    level = torch.log(safe) - torch.log(variance) + observation / variance
    level = torch.where(positive, level, torch.full_like(level, -1e3))
    small = torch.sigmoid(level)
    large = level.clamp(min=1)
    omega = torch.where(level > 1, large - torch.log(large), small).clamp(min=1e-300)
    for _ in range(4):
        omega = (omega * (1 + level - torch.log(omega)) / (1 + omega)).clamp(min=1e-300)
    return variance * omega


@torch.no_grad()
def _saddle(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """The s where the tilted law has its mean at the observation."""
    variance = read_noise**2
    mode = _mode(rate + residual, rate, variance)
    _, safe = _positive(rate)
    return torch.where(mode > variance, torch.log(mode / safe), (rate + residual - mode) / variance)


def _contour(
    residual: Tensor, rate: Tensor, read_noise: Tensor, line: Tensor, at_zero: Tensor, factor: Factor
) -> Tensor:
    """log of (1/2πi)·∫ factor(s)·exp(K(s) − s·observation) ds along Re s = line.

    `factor` takes Im s and returns its real and imaginary parts; `at_zero` is its value at Im s = 0.
    """
    variance = read_noise**2
    tilted = _tilted(rate, line)
    rise = torch.where(line.abs() < 1, rate * torch.expm1(line.clamp(-1, 1)), tilted - rate)
    exponent = rise - line * (rate + residual) + variance * line**2 / 2
    drift = rise + variance * line - residual
    with torch.no_grad():
        spacing = 1 / (_NODES_PER_DEVIATION * torch.sqrt(tilted + variance))
        reach = torch.sqrt(22 / (variance / 2 + 2 / math.pi**2 * tilted))
        reach = torch.where(reach < math.pi, reach, torch.sqrt(44 / variance))
        count = int((reach / spacing).max()) + 1 if reach.numel() else 0
    total = at_zero / 2
    for node in range(1, count + 1):
        t = node * spacing
        size = torch.exp(-2 * tilted * torch.sin(t / 2) ** 2 - variance * t**2 / 2)
        phase = tilted * (torch.sin(t) - t) + t * drift
        real, imaginary = factor(t)
        total = total + size * (real * torch.cos(phase) - imaginary * torch.sin(phase))
    return exponent + torch.log(total * spacing / math.pi)


def _contour_log_interval(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    middle, half = (low + high) / 2, (high - low) / 2
    line = _saddle(middle, rate, read_noise)
    a = line * half
    shrink = torch.exp(-2 * a.abs())  # sinh and cosh are scaled by exp(−|a|)
    sinh, cosh = -torch.sign(line) * torch.expm1(-2 * a.abs()), 1 + shrink
    tiny = a.abs() < 1e-4
    flat = 2 * half * torch.exp(-a.abs()) * (1 + a**2 / 6)
    at_zero = torch.where(tiny, flat, sinh / torch.where(tiny, torch.ones_like(line), line))

    def factor(t: Tensor) -> tuple[Tensor, Tensor]:
        real, imaginary = sinh * torch.cos(t * half), cosh * torch.sin(t * half)
        square = line**2 + t**2
        return (real * line + imaginary * t) / square, (imaginary * line - real * t) / square

    return a.abs() + _contour(middle, rate, read_noise, line, at_zero, factor)


def _log_poisson(count: Tensor, rate: Tensor) -> Tensor:
    """log P(k = count): Stirling's leading terms are paired with the rate so that nothing large cancels."""
    positive, safe = _positive(rate)
    shifted = count + 0.5
    u = (shifted - safe) / safe
    at = count.clamp(max=1e5)  # beyond, the remainder is below 1e-6 and constant over any window
    remainder = torch.lgamma(at + 1) - (at + 0.5) * (torch.log(at + 0.5) - 1)
    deviance = safe * ((1 + u) * torch.log1p(u) - u)
    none = torch.where(count > 0, torch.full_like(rate, -1e300), -rate)
    return torch.where(positive, -deviance - 0.5 * torch.log(safe) - remainder, none)


def _lattice_mode(residual: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    with torch.no_grad():
        return torch.round((_mode(rate + residual + 0.5, rate, variance) - 0.5).clamp(min=0))


def _lattice_log_density(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    variance = read_noise**2
    mode = _lattice_mode(residual, rate, variance)
    gap = residual - (mode - rate)
    positive, safe = _positive(rate)
    up = _tilted(rate, (2 * gap - 1) / (2 * variance) - torch.log(mode + 1))
    inside = positive & (mode > 0)
    safe_mode = torch.where(inside, mode, torch.ones_like(mode))
    exponent = torch.log(safe_mode) - torch.log(safe) - (2 * gap + 1) / (2 * variance)
    down = torch.where(inside, torch.exp(torch.where(inside, exponent, torch.zeros_like(exponent))), torch.zeros_like(gap))
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
        return log_ndtr(side * (count - rate - residual) / read_noise)

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
    positive, safe = _positive(rate)
    log_rate = torch.where(positive, torch.log(safe), torch.full_like(safe, -1e30))
    log_mass = _log_poisson(start, rate)
    total = log_mass + log_part(start)
    for step in range(1, count):
        log_mass = log_mass + log_rate - torch.log(start + step)
        total = torch.logaddexp(total, log_mass + log_part(start + step))
    return total


def _log_full_mass(start: Tensor, count: int, rate: Tensor, upper: Tensor) -> Tensor:
    """log P(k ≥ start + count) where `upper`, else log P(k < start)."""
    positive, safe = _positive(rate)
    edge = torch.where(upper, start + count, start.clamp(min=1))
    possible = positive & (upper | (start > 0))
    strong = torch.minimum(safe, edge).detach() > _STRONG
    log_mass = torch.full_like(rate, -1e300)
    if not bool(strong.all()):
        log_mass = _log_gamma_mass(edge, safe, upper)
    if bool(strong.any()):
        large = _log_contour_mass(edge.clamp(min=_STRONG), safe.clamp(min=_STRONG), upper)
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


def _log_contour_mass(edge: Tensor, rate: Tensor, upper: Tensor) -> Tensor:
    """Without read noise the bell still ends before Im s = π where the rate is large; the pole becomes that of a lattice."""
    side = torch.where(upper, 1.0, -1.0).to(rate)
    least = 2 / torch.sqrt(torch.maximum(rate, edge)).detach()
    line = side * torch.maximum(side * torch.log(edge / rate).detach(), least)
    shrink = torch.exp(-line)

    def factor(t: Tensor) -> tuple[Tensor, Tensor]:
        real, imaginary = 1 - shrink * torch.cos(t), shrink * torch.sin(t)  # 1 − exp(−s)
        square = side * (real**2 + imaginary**2)
        return real / square, -imaginary / square

    return _contour(edge - rate, rate, rate.new_zeros(()), line, side / (1 - shrink), factor)
