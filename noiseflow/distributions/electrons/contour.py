"""The distribution of electrons plus read noise by one short integral at any rate, or by sums over a few electrons.

The density is the inversion integral of the moment generating function exp(K(s)), K(s) = rate·(eˢ − 1) + read_noise²·s²/2,
along the vertical line through its saddle point. There the integrand is bell-shaped and does not oscillate, so the trapezoidal
rule integrates it to rounding error with 11 to 17 nodes (Lugannani & Rice 1980, doi:10.2307/1426607, expand the same integral).
Tail probabilities have a further factor 1/s; the line then avoids the pole at 0. For distributions smooth on the scale of one
electron, and Poisson probabilities at large rates.

Otherwise the probability of a cell is the sum over the electrons near the mode of their posterior of its probabilities under
normal distributions; its derivatives follow from the same terms.
"""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from noiseflow.distributions.numerics.normal import FARTHEST, REACH
from noiseflow.distributions.pixels import is_traced

Factor = Callable[[Tensor], tuple[Tensor, Tensor]]


def positive_rate(rate: Tensor) -> tuple[Tensor, Tensor]:
    positive = rate > 1e-30
    return positive, torch.where(positive, rate, torch.ones_like(rate))


def tilted_rate(rate: Tensor, exponent: Tensor) -> Tensor:
    """rate·exp(exponent), computed so that only the product must be representable."""
    positive, safe = positive_rate(rate)
    large = torch.exp(torch.log(safe) + torch.where(positive, exponent, torch.zeros_like(exponent)))
    return torch.where(positive, large, rate * torch.exp(exponent.clamp(max=60)))


def poisson_normal_mode(observation: Tensor, rate: Tensor, variance: Tensor) -> Tensor:
    """The solution m of m + variance·log(m/rate) = observation: the Wright omega function, by Newton's method."""
    positive, safe = positive_rate(rate)
    level = torch.log(safe) - torch.log(variance) + observation / variance
    level = torch.where(positive, level, torch.full_like(level, -1e3))
    small = torch.sigmoid(level)
    large = level.clamp(min=1)
    omega = torch.where(level > 1, large - torch.log(large), small).clamp(min=1e-300)
    for _ in range(4):
        omega = (omega * (1 + level - torch.log(omega)) / (1 + omega)).clamp(min=1e-300)
    return variance * omega


@torch.no_grad()
def saddle_point(residual: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """The s at which the mean of the exponentially tilted distribution is the observation."""
    variance = read_noise**2
    mode = poisson_normal_mode(rate + residual, rate, variance)
    _, safe = positive_rate(rate)
    return torch.where(mode > variance, torch.log(mode / safe), (rate + residual - mode) / variance)


def log_contour_integral(
    residual: Tensor, rate: Tensor, read_noise: Tensor, line: Tensor, at_zero: Tensor, factor: Factor
) -> Tensor:
    """log of (1/2πi)·∫ factor(s)·exp(K(s) − s·observation) ds along Re s = line. `factor` takes Im s and returns its real and
    imaginary parts; `at_zero` is its value at Im s = 0."""
    path = _Path(residual, rate, read_noise, line)
    total = at_zero / 2
    for t, real, imaginary in path.nodes():
        along, across = factor(t)
        total = total + along * real - across * imaginary
    return path.exponent + torch.log(total * path.spacing / math.pi)


class _Path:
    """exp(K(s) − s·observation) along Re s = line: its logarithm on the real axis, and its ratio to that at the nodes."""

    def __init__(self, residual: Tensor, rate: Tensor, read_noise: Tensor, line: Tensor) -> None:
        self._variance = variance = read_noise**2
        self._tilted = tilted = tilted_rate(rate, line)
        rise = torch.where(line.abs() < 1, rate * torch.expm1(line.clamp(-1, 1)), tilted - rate)
        self.exponent = rise - line * (rate + residual) + variance * line**2 / 2
        self._drift = rise + variance * line - residual
        with torch.no_grad():
            self.spacing = math.tau / (10 * torch.sqrt(tilted + variance))
            reach = torch.sqrt(22 / (variance / 2 + 2 / math.pi**2 * tilted))
            # up to π, the exponent grows more slowly than the square of the reach, which is thus too far; beyond, it is periodic
            shot = torch.where(reach < math.pi, 2 * tilted * torch.sin(reach / 2) ** 2, 0.0)
            reach = reach * torch.sqrt(22 / (variance / 2 * reach**2 + shot))
            self._count = int((reach / self.spacing).max()) + 1 if reach.numel() else 0

    def nodes(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Im s of each node, for all pixels, with the real and imaginary part there, relative to the value on the real axis."""
        for node in range(1, self._count + 1):
            t = node * self.spacing
            size = torch.exp(-2 * self._tilted * torch.sin(t / 2) ** 2 - self._variance * t**2 / 2)
            phase = self._tilted * (torch.sin(t) - t) + t * self._drift
            yield t, size * torch.cos(phase), size * torch.sin(phase)


def is_smooth_cell(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """Where a short contour integrates a cell accurately, boolean: cells not wider than the noise and not too steep."""
    steepness = saddle_point((low + high) / 2, rate, read_noise).abs()
    return (high - low).detach() <= torch.minimum(torch.sqrt(rate + read_noise**2), 4 / steepness).detach()


def contour_log_interval(low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    return contour_and_slopes(low, high, rate, read_noise, slopes=False)[0]


def contour_and_slopes(
    low: Tensor, high: Tensor, rate: Tensor, read_noise: Tensor, *, slopes: bool
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """log P(low < residual ≤ high), and its derivatives with respect to all four arguments if requested, at the same nodes. Let s
    = line + it. The factor of a cell's probability is q = 2·sinh(s·half)/s, that of the density at the cell's upper and lower end
    exp(∓s·half), that of the derivative with respect to the rate q·(eˢ − 1), and to the read noise q·read_noise·s²."""
    middle, half = (low + high) / 2, (high - low) / 2
    line = saddle_point(middle, rate, read_noise)
    sinh, cosh, at_zero = _cell_at_zero(line, half)
    bottom, top = torch.exp((line * half).clamp(max=0) * 2), torch.exp((-line * half).clamp(max=0) * 2)
    path = _Path(middle, rate, read_noise, line)
    mass, by_rate, by_noise = at_zero / 2, at_zero / 2, line * sinh / 2
    at_low, at_high = bottom / 2, top / 2
    for t, real, imaginary in path.nodes():
        cosine, sine, square = torch.cos(t * half), torch.sin(t * half), line**2 + t**2
        q_real = (sinh * cosine * line + cosh * sine * t) / square
        q_imaginary = (cosh * sine * line - sinh * cosine * t) / square
        cell = real * q_real - imaginary * q_imaginary
        mass = mass + cell
        if slopes:
            at_low = at_low + bottom * (real * cosine - imaginary * sine)
            at_high = at_high + top * (real * cosine + imaginary * sine)
            turned = real * q_imaginary + imaginary * q_real
            by_rate = by_rate + cell * torch.cos(t) - turned * torch.sin(t)
            by_noise = by_noise + cell * (line**2 - t**2) - turned * (2 * line * t)
    value = (line * half).abs() + path.exponent + torch.log(mass * path.spacing / math.pi)
    if not slopes:
        return value, ()
    of_low, of_high = -at_low / mass, at_high / mass
    of_rate = torch.exp(line.clamp(max=60)) * by_rate / mass - 1 + of_low + of_high
    return value, (of_low, of_high, of_rate, read_noise * by_noise / mass)


def _cell_at_zero(line: Tensor, half: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """2·sinh and 2·cosh of line·half, and 2·sinh(line·half)/line, all scaled by exp(−|line·half|)."""
    a = line * half
    shrink = torch.exp(-2 * a.abs())
    sinh, cosh = -torch.sign(line) * torch.expm1(-2 * a.abs()), 1 + shrink
    tiny = a.abs() < 1e-4
    flat = 2 * half * torch.exp(-a.abs()) * (1 + a**2 / 6)
    return sinh, cosh, torch.where(tiny, flat, sinh / torch.where(tiny, torch.ones_like(line), line))


def contour_log_mass(edge: Tensor, rate: Tensor, upper: Tensor) -> Tensor:
    """log P(k beyond an integer) without read noise: at large rates the integrand still vanishes before Im s = π."""
    side = torch.where(upper, 1.0, -1.0).to(rate)
    least = 2 / torch.sqrt(torch.maximum(rate, edge)).detach()
    line = side * torch.maximum(side * torch.log(edge / rate).detach(), least)
    shrink = torch.exp(-line)

    def factor(t: Tensor) -> tuple[Tensor, Tensor]:
        real, imaginary = 1 - shrink * torch.cos(t), shrink * torch.sin(t)  # 1 − exp(−s)
        square = side * (real**2 + imaginary**2)
        return real / square, -imaginary / square

    return log_contour_integral(edge - rate, rate, rate.new_zeros(()), line, side / (1 - shrink), factor)


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
    if not is_traced(rate) and not bool(large.any()):
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
