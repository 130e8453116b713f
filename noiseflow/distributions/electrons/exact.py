"""The exact distribution of shot plus read noise, in electrons: k + read_noise·n with k Poisson and n standard normal.

Both ways are accurate to about 1e-8 nats (tails by the contour 1e-7), at a cost that does not grow with the rate: below a read
noise of 1.5 electrons the sum over a dozen k around the mode of their posterior, above it the inversion integral of the moment
generating function (`contour`). All is in float64, because fractions of an electron matter at a million electrons. Free choices
of the method (window, line) are detached: the result does not depend on them, and neither does its gradient.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from noiseflow.distributions.electrons import contour
from noiseflow.distributions.numerics.elementwise import PIECE
from noiseflow.distributions.numerics.normal import (
    FULL,
    LOG_SQRT_2PI,
    REACH,
    log_normal_cdf,
    log_normal_interval,
    normal_cdf,
)

RESOLVED = 1.5  # electrons: read noise below which sums over electrons are used; from 1.7 on, the contour is faster


def log_density(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """Log-density, nats per electron.

    Args:
        residual: observation − rate, electrons, float64.
        rate: expected electrons, ≥ 0, float64.
        read_noise: scalar, electrons, float64.
    """
    if _most(read_noise) < RESOLVED:
        return _lattice_log_density(residual, rate, read_noise)
    line = contour.saddle_point(residual, rate, read_noise)
    one = torch.ones_like(line)
    return contour.log_contour_integral(residual, rate, read_noise, line, one, lambda t: (one, torch.zeros_like(one)))


def log_tail(residual: Tensor, rate: Tensor, read_noise: Tensor, *, twice: bool = False) -> Tensor:
    """Log-probability of the tail beyond the observation: above it for residuals > 0, otherwise below it.

    Args:
        residual: observation − rate, electrons, float64.
        rate: expected electrons, ≥ 0, float64.
        read_noise: electrons, float64.
        twice: always use the contour, because the incomplete gamma functions of the sum have no second derivative.
    """
    upper = residual.detach() > 0
    if not twice and _most(read_noise) < RESOLVED:
        return _lattice_log_tail(residual, rate, read_noise, upper)
    side = torch.where(upper, 1.0, -1.0).to(residual)
    saddle = contour.saddle_point(residual, rate, read_noise)
    least = 2 / torch.sqrt(contour.tilted_rate(rate, saddle) + read_noise**2).detach()
    line = side * torch.maximum(side * saddle, least)

    def factor(t: Tensor) -> tuple[Tensor, Tensor]:
        square = side * (line**2 + t**2)
        return line / square, -t / square

    return contour.log_contour_integral(residual, rate, read_noise, line, side / line, factor)


def log_both_tails(residual: Tensor, rate: Tensor, read_noise: Tensor, *, twice: bool = False) -> tuple[Tensor, Tensor]:
    """``(log P(≤ observation), log P(> observation))``."""
    near = log_tail(residual, rate, read_noise, twice=twice)
    far, upper = _log1mexp(near), residual > 0
    return torch.where(upper, far, near), torch.where(upper, near, far)


def below(residual: Tensor, rate: Tensor, read_noise: Tensor, *, twice: bool = False) -> Tensor:
    """P(≤ observation), in a sixth of the time of `log_both_tails` if the read noise is small; arguments as `log_tail`."""
    sigma = _most(read_noise)
    if twice or sigma >= RESOLVED:
        return log_both_tails(residual, rate, read_noise, twice=twice)[0].exp()
    positive, safe = contour.positive_rate(rate)
    near, far = math.ceil(REACH * sigma) + 1, math.ceil((REACH + FULL) * sigma) + 1
    start = (contour.lattice_mode(residual, rate, read_noise**2) - far).clamp(min=0)
    certain = torch.where(positive, torch.special.gammaincc(start.clamp(min=1), safe), 1.0)
    total, mass = torch.where(start > 0, certain, 0.0), contour.log_poisson(start, rate).exp()
    gap = residual - (start - rate)
    for step in range(near + far + 1):
        total = total + mass * normal_cdf((gap - step) / read_noise)
        mass = mass * rate / (start + (step + 1))
    return total


def log_interval(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, *, twice: bool = False) -> Tensor:
    """log P(low < residual ≤ high). The bounds are observation − rate, electrons; `twice` as in `log_tail`."""
    width = high - low
    if _most(read_noise) < RESOLVED:
        narrow = width.detach() <= 3
        direct = _lattice_log_interval
    else:
        narrow = contour.is_smooth_cell(low, high, rate, read_noise)
        direct = contour.contour_log_interval
    if bool(narrow.all()):
        return direct(low, high, rate, read_noise)
    if not bool(narrow.any()):
        return _log_difference_of_tails(low, high, rate, read_noise, twice=twice)
    wide, noise = ~narrow, (read_noise, read_noise)
    if read_noise.ndim:
        noise = read_noise[narrow], read_noise[wide]
    near = direct(low[narrow], high[narrow], rate[narrow], noise[0])
    far = _log_difference_of_tails(low[wide], high[wide], rate[wide], noise[1], twice=twice)
    return torch.zeros_like(low).masked_scatter(narrow, near).masked_scatter(wide, far)


@torch.no_grad()
def interval_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """`log_interval`, several times faster for most cells, with its derivatives with respect to all four arguments.

    Args:
        low, high, rate: (n,) or () electrons, float64.
        read_noise: scalar, electrons, float64.
        slopes: whether to return the derivatives, each shaped like the cells.
    """
    if low.ndim == 0:
        value, parts = interval_and_slopes(low[None], high[None], rate[None], read_noise, slopes=slopes)
        return value[0], tuple(part[0] for part in parts)
    suits: Callable[..., Tensor] = contour.is_smooth_cell
    fast: Callable[..., Any] = contour.contour_and_slopes
    cells = [low, high, rate]
    if float(read_noise) < RESOLVED:
        suits, fast = contour.is_near_peak, contour.peaks_and_slopes
        cells.append(contour.posterior_mode(low, high, rate, read_noise))
    here = suits(*cells, read_noise)
    found = [torch.full_like(low, math.nan) for _ in range(5 if slopes else 1)]
    if bool(here.all()):
        _put(found, slice(None), fast(*cells, read_noise, slopes=slopes))
    elif bool(here.any()):
        _put(found, here, fast(*(each[here] for each in cells), read_noise, slopes=slopes))
    left = ~torch.isfinite(found[0])  # also far from any electron, where the fast ways underflow
    if bool(left.any()):
        _put(found, left, _slowly(low[left], high[left], rate[left], read_noise, slopes=slopes))
    return found[0], tuple(found[1:])


def _put(found: list[Tensor], where: Tensor | slice, cells: tuple[Tensor, tuple[Tensor, ...]]) -> None:
    value, parts = cells
    for out, part in zip(found, (value, *parts), strict=True):
        out[where] = part


def _slowly(
    low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    if not slopes or not low.numel():
        empty = (torch.zeros_like(low),) * 4 if slopes else ()
        return log_interval(low, high, rate, read_noise), empty
    with torch.enable_grad():
        noise = read_noise.expand_as(low).clone()
        at = [each.detach().clone().requires_grad_() for each in (low, high, rate, noise)]
        # one copy of the read noise per pixel, so that each has its own derivative
        value = log_interval(*at)
        found = torch.autograd.grad(value.sum(), at)
    return value.detach(), found


def _most(read_noise: Tensor) -> float:
    """The read noise, or the largest of several."""
    return float(read_noise.detach().max())


def _log_difference_of_tails(
    low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, *, twice: bool = False
) -> Tensor:
    tails = (log_both_tails(end, rate, read_noise, twice=twice) for end in (low, high))
    (below_low, above_low), (below_high, above_high) = tails
    right = low > 0
    across = (low <= 0) & (high > 0)
    large, small = torch.where(right, above_low, below_high), torch.where(right, above_high, below_low)
    ratio = torch.where(across | torch.isneginf(small), torch.full_like(large, -1.0), small - large)
    difference = large + torch.where(torch.isneginf(small), torch.zeros_like(large), _log1mexp(ratio))
    outside = torch.where(across, below_low.exp() + above_high.exp(), torch.zeros_like(large))
    return torch.where(across, torch.log1p(-outside), difference)


def _log1mexp(value: Tensor) -> Tensor:
    """log(1 − exp(value)) for value < 0."""
    return torch.log1p(-torch.exp(value))


def _lattice_log_density(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    variance = read_noise**2
    mode = contour.lattice_mode(residual, rate, variance)
    gap = residual - (mode - rate)
    positive, safe = contour.positive_rate(rate)
    up = contour.tilted_rate(rate, (2 * gap - 1) / (2 * variance) - torch.log(mode + 1))
    inside = positive & (mode > 0)
    safe_mode = torch.where(inside, mode, torch.ones_like(mode))
    exponent = torch.log(safe_mode) - torch.log(safe) - (2 * gap + 1) / (2 * variance)
    exponent = torch.where(inside, exponent, torch.zeros_like(exponent))
    down = torch.where(inside, torch.exp(exponent), torch.zeros_like(gap))
    total = above = below = torch.ones_like(gap)
    for step in range(math.ceil(REACH * _most(read_noise))):
        decay = torch.exp(-step / variance)
        above = above * up * decay * ((mode + 1) / (mode + 1 + step))
        below = below * down * decay * ((safe_mode - step) / safe_mode)
        total = total + above + below
    at_mode = contour.log_poisson(mode, rate) - gap**2 / (2 * variance) - torch.log(read_noise) - LOG_SQRT_2PI
    return at_mode + torch.log(total)


def _lattice_log_tail(residual: Tensor, rate: Tensor, read_noise: Tensor, upper: Tensor) -> Tensor:
    sigma = _most(read_noise)
    near, far = math.ceil(REACH * sigma) + 1, math.ceil((REACH + FULL) * sigma) + 1
    mode = contour.lattice_mode(residual, rate, read_noise**2)
    start = torch.where(upper, mode - near, mode - far).clamp(min=0)
    side = torch.where(upper, 1.0, -1.0).to(residual)
    count = near + far + 1
    inside = _lattice_sum(start, count, rate, lambda k: log_normal_cdf(side * (k - rate - residual) / read_noise))
    return torch.logaddexp(inside, _log_full_mass(start, count, rate, upper))


def _lattice_log_interval(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    reach = math.ceil(REACH * _most(read_noise)) + 1
    start = (contour.lattice_mode(low, rate, read_noise**2) - reach).clamp(min=0)

    def log_part(count: Tensor) -> Tensor:
        gap = count - rate
        return log_normal_interval((low - gap) / read_noise, (high - gap) / read_noise)

    return _lattice_sum(start, 2 * reach + 5, rate, log_part)


def _lattice_sum(start: Tensor, count: int, rate: Tensor, log_part: Callable[[Tensor], Tensor]) -> Tensor:
    """log Σ P(k)·exp(log_part(k)) over `count` integers from `start` on; of few pixels, many terms are computed at once."""
    positive, safe = contour.positive_rate(rate)
    log_rate = torch.where(positive, torch.log(safe), torch.full_like(safe, -1e30))
    steps = torch.arange(count, dtype=start.dtype, device=start.device).view(-1, *(1,) * start.ndim)
    at_once = torch.split(steps, max(1, PIECE // max(1, start.numel())))
    parts = (part for some in at_once for part in log_part(start + some))
    total: Tensor = (log_mass := contour.log_poisson(start, rate)) + next(parts)
    for step, part in enumerate(parts, 1):
        log_mass = log_mass + log_rate - torch.log(start + step)
        total = torch.logaddexp(total, log_mass + part)
    return total


def _log_full_mass(start: Tensor, count: int, rate: Tensor, upper: Tensor, *, strong: float = 30.0) -> Tensor:
    """log P(k ≥ start + count) where `upper`, else log P(k < start); by the contour at strong signals."""
    positive, safe = contour.positive_rate(rate)
    edge = torch.where(upper, start + count, start.clamp(min=1))
    possible = positive & (upper | (start > 0))
    bright = torch.minimum(safe, edge).detach() > strong
    log_mass = torch.full_like(rate, -1e300)
    if not bool(bright.all()):
        log_mass = _log_gamma_mass(edge, safe, upper)
    if bool(bright.any()):
        large = contour.contour_log_mass(edge.clamp(min=strong), safe.clamp(min=strong), upper)
        log_mass = torch.where(bright, large, log_mass)
    return torch.where(possible, log_mass, torch.full_like(log_mass, -1e300))


def _log_gamma_mass(edge: Tensor, rate: Tensor, upper: Tensor) -> Tensor:
    mass = torch.where(upper, torch.special.gammainc(edge, rate), torch.special.gammaincc(edge, rate))
    shown = mass > 1e-290
    # this far out the probabilities decrease geometrically from the edge
    last = torch.where(upper, edge, edge - 1)
    ratio = torch.where(upper, rate / (edge + 1), last / rate).clamp(max=0.5)
    beyond = contour.log_poisson(last, rate) - torch.log1p(-ratio)
    return torch.where(shown, torch.log(torch.where(shown, mass, torch.ones_like(mass))), beyond)
