"""Detectors with random electron multiplication: EMCCDs, photomultipliers, direct detectors with straggling."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.electrons.contour import draw_poisson
from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile, of_finite
from noiseflow.distributions.numerics.normal import LOG_SQRT_2PI, log_normal_interval, normal_cdf
from noiseflow.distributions.pixels import is_traced
from noiseflow.models.physical import ElectronCounter
from noiseflow.models.standardisation import lagrange_weights
from noiseflow.statistics import weighted_line

_NODES, _CELLS = 48, 4096
# Width of a cell and the first one, in units of the grid, about a standard deviation: 13 of them below the mean, and 38 above
# it, where the tail is exponential.
_WIDTH, _START = 0.0125, -12.8
# Density per unit below which rounding errors of the transform dominate.
_LEAST = 1e-14
_LEAST_RATE = 1e-4
# Read noises: up to this width of an interval, three nodes have an error below 1e-5.
_NARROW = 1.5
# Standard deviations of the noise; below it, the noise is normal, and the electrons too many to add.
_LEAST_GAIN = 1e-3


class ExcessNoise(ElectronCounter):
    """Shot noise with random electron multiplication, plus read noise.

    observation = offset + gain·(Σ of k pulses + read_noise·n), k Poisson, n standard normal, each pulse gamma-distributed with
    mean 1 and variance F² − 1. F² = 2 is the exponential distribution of a long multiplication register (EMCCD,
    doi:10.1109/TED.2003.813462); F² near 1 is a Poisson–Gaussian detector; photomultipliers (Polya distribution) and direct
    detectors (straggling) are in between.

    The variance, F²·gain·(signal − offset) + (gain·read_noise)², determines only the product F²·gain; the shape of the noise
    separates the two factors. Clock-induced charge is part of the signal.

    Args:
        gain: counts per electron, the mean of a pulse.
        offset: counts without electrons.
        read_noise: electrons rms before multiplication.
        excess_factor: excess noise factor F², above 1.

    Raises:
        ValueError: gain or read noise is not positive, or F² is not above 1.

    Example:
        >>> import noiseflow, torch
        >>> emccd = noiseflow.ExcessNoise(gain=10.0, offset=100.0, read_noise=0.1, excess_factor=2.0)
        >>> sample = emccd(torch.full((1000,), 600.0)).sample(generator=torch.Generator().manual_seed(0))
        >>> bool(80 < sample.std() < 120)  # √2 times the shot noise of 50 electrons
        True
    """

    costly = True
    starts_most_likely = True  # `standardise` finds the maximum of the likelihood
    origin: Tensor

    def __init__(
        self, gain: float = 0.01, offset: float = 0.0, read_noise: float = 2.0, *, excess_factor: float = 2.0
    ) -> None:
        super().__init__()
        check(gain=gain, offset=offset, read_noise=read_noise, excess_factor=excess_factor)
        start = [math.log(gain), math.log(read_noise), math.log(excess_factor - 1)]
        self.change = nn.Parameter(torch.zeros(4))
        self.register_buffer("origin", torch.tensor([start[0], offset, *start[1:]], dtype=torch.float64))

    def _parameters_now(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        change = self.change.double()
        gain, read_noise = torch.exp(self.origin[0] + change[0]), torch.exp(self.origin[2] + change[2])
        offset = self.origin[1] + torch.exp(self.origin[0] + self.origin[2]) * change[1]
        return gain, offset, read_noise, torch.exp(self.origin[3] + change[3])

    @property
    def excess_factor(self) -> Tensor:
        """Excess noise factor F²: variance with multiplication relative to that without."""
        return 1 + self._parameters_now()[3]

    def forward(self, signal: Tensor) -> ExcessNoiseDistribution:
        return ExcessNoiseDistribution(signal, *self._parameters_now())

    def standardise(self, signal: Tensor, observation: Tensor, *, settle: bool = True) -> None:
        """Set the parameters from the second and third moments of (N,) observations at each signal level."""
        s, residual = signal.double(), observation.double() - signal.double()
        groups = torch.tensor_split(torch.argsort(s), max(4, min(32, s.numel() // 200)))
        mean = np.array([float(s[group].mean()) for group in groups])
        second, third = (np.array([float((residual[group] ** k).mean()) for group in groups]) for k in (2, 3))
        second = np.maximum(second, 1e-30)
        line = weighted_line(mean, second, second**-2.0)
        skew = weighted_line(mean, third, second**-3.0).slope
        spread, error = math.sqrt(second.mean()), line.slope_error * math.sqrt(2 * len(groups) / s.numel())
        product, ratio, intercept = line.slope, skew / max(line.slope, 1e-30) ** 2, line.intercept
        if product < max(5 * error, _LEAST_GAIN * spread):  # alike signals, or noise that hardly depends on them
            product, ratio = 0.3 * spread, 1.5
            intercept = second.mean() - product * mean.mean()
        squared = 1 / (2 - min(max(ratio, 1.02), 1.6))
        gain = product / squared
        offset = float(mean.min()) - max(float(second.min()) * 0.5, 0.0) / product
        read = math.sqrt(max(intercept + product * offset, 0.02 * float(second.min()))) / gain
        with torch.no_grad():
            self.change.zero_()
            self.origin.copy_(torch.tensor([math.log(gain), offset, math.log(read), math.log(squared - 1)]))
        if settle:
            self.settle(signal, observation)

    def extra_repr(self) -> str:
        gain, offset, read_noise, more = (float(each.detach()) for each in self._parameters_now())
        return f"gain={gain:.5g}, offset={offset:.5g}, read_noise={read_noise:.4g}, excess_factor={1 + more:.4g}"


class ExcessNoiseDistribution(NoiseDistribution):
    """Distribution of offset + gain·(compound Poisson of gamma pulses + read noise).

    The term without a pulse is a normal distribution. The characteristic function of the others is exact; its Fourier transform
    gives log-densities and CDFs on grids of charges at `_NODES` rates between the smallest and the largest, interpolated by
    cubics along charges and by six nodes across rates (error 1e-5 nats at up to a thousand electrons).

    Args:
        signal: clean pixel values, detector units.
        gain, offset, read_noise, pulse_variance: scalars, float64; the last is F² − 1.
    """

    per_pixel = ("signal",)

    def __init__(
        self, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, pulse_variance: Tensor
    ) -> None:
        super().__init__(signal.shape, like=signal)
        self.signal, self.gain, self.offset = self.clean(signal), gain, offset
        self.read_noise, self.pulse_variance = read_noise, pulse_variance

    @property
    def rate(self) -> Tensor:
        """Expected electrons, float64."""
        return ((self.signal.double() - self.offset) / self.gain).clamp(min=0)

    def _charge(self, value: Tensor) -> Tensor:
        """Electrons of an observation. For a signal below the offset, read noise is centred on the signal."""
        return (value.double() - torch.minimum(self.signal.double(), self.offset)) / self.gain

    def _grid(self, rate: Tensor, *, aligned: float = 30.0) -> tuple[Tensor, Tensor]:
        """Origin and unit, electrons, of the grid of charges at each rate. At low rates, grids start at no charge, where the
        density has an edge; well above the rate `aligned`, so few pixels are without a pulse that the edge is gone, and grids
        follow the mean."""
        unit = torch.sqrt(rate * (1 + self.pulse_variance) + self.read_noise**2 + self.pulse_variance)
        return rate**3 / (rate**2 + aligned**2), unit

    def _transformed(self, *, narrowest: float = 1.5) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Density of charges, per cell, given at least one pulse, (node, cell); units of the nodes, (node, 1); and their ends. Of
        edges narrower than so many cells, cubics are wrong by up to 2 %; that at no charge is gone at tens of electrons."""
        place = _place(self.rate.detach().nan_to_num()) if self.rate.numel() else self.rate.new_zeros(1)
        low, high = place.amin(), place.amax() + 1e-3
        fraction = torch.linspace(0, 1, _NODES, dtype=torch.float64, device=place.device)
        start = math.sqrt(_LEAST_RATE)  # the inverse of `_place`
        rate = ((torch.expm1(low + (high - low) * fraction) + start) ** 2 - _LEAST_RATE).clamp(min=1e-30)
        origin, unit = (each[:, None] for each in self._grid(rate))
        spread = torch.maximum(self.read_noise, narrowest * _WIDTH * unit * torch.exp(-0.03 * rate[:, None]))
        turn = torch.arange(_CELLS // 2 + 1, dtype=torch.float64, device=rate.device) * 2 * math.pi / (_CELLS * _WIDTH)
        if not is_traced(spread):  # frequencies that the read noise damps below the rounding errors are 0
            damped = math.sqrt(-2 * math.log(torch.finfo(torch.float64).eps))
            turn = turn[turn < damped * float((unit / spread).detach().max())]
        phase, none = turn / unit, torch.expm1(-rate[:, None])
        # the characteristic function of one pulse, (1 − iφv)^(−1/v), in real numbers, which are three times as fast
        wide = phase * self.pulse_variance
        size = torch.exp(-0.5 * torch.log1p(wide**2) / self.pulse_variance)
        angle = torch.atan(wide) / self.pulse_variance
        grown = torch.expm1(rate[:, None] * (size * torch.cos(angle) - 1))
        half = rate[:, None] * size * torch.sin(angle) / 2
        sine, cosine = torch.sin(half), torch.cos(half)
        # of at least one pulse: (exp(λ(p − 1)) − exp(−λ)) / (1 − exp(−λ)), without cancellation at small rates λ
        real = (grown - none) * (1 - 2 * sine**2) - 2 * (1 + none) * sine**2
        imaginary = 2 * (1 + grown) * sine * cosine
        factor, moved = torch.exp(-0.5 * (phase * spread) ** 2) / -none, turn * _START + phase * origin
        sine, cosine = torch.sin(moved) * factor, torch.cos(moved) * factor
        spectrum = torch.complex(real * cosine + imaginary * sine, real * sine - imaginary * cosine)
        density = torch.fft.irfft(spectrum, n=_CELLS) / _WIDTH
        return density.clamp(min=_LEAST), unit, low, high

    def _log_densities(self) -> Tensor:
        density, unit, _, _ = self.once(self._transformed)
        return density.log() - unit.log()

    def _cumulative(self) -> Tensor:
        density = self.once(self._transformed)[0]
        step = 0.5 * _WIDTH * (density[:, 1:] + density[:, :-1])
        # the trapezoidal rule with its end correction, exact to fourth order
        slope = torch.nn.functional.pad((density[:, 2:] - density[:, :-2]) / 2, (1, 1))
        return torch.nn.functional.pad(torch.cumsum(step, 1), (1, 0)) - _WIDTH * (slope - slope[:, :1]) / 12

    def _looked_up(self, table: Callable[[], Tensor], charge: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A table (node, cell) at some charges, how far beyond its cells these are (electrons), and P(any pulse)."""
        _, _, low, high = self.once(self._transformed)
        origin, unit = self._grid(self.rate)
        cell = ((charge - origin) / unit - _START) / _WIDTH
        node = ((_place(self.rate) - low) / (high - low) * (_NODES - 1)).expand_as(cell)
        # of six nodes across rates, second derivatives are accurate to 1e-3; of four, to 1e-2
        (first, across), (start, along) = lagrange_weights(node, _NODES, 6), lagrange_weights(cell, _CELLS)
        rows, steps = (torch.arange(n, device=cell.device).view(-1, *(1,) * cell.ndim) for n in (6, 4))
        index = ((first + rows) * _CELLS)[:, None] + start + steps
        corner = self.once(table).reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)
        total = ((corner * torch.stack(along)).sum(1) * torch.stack(across)).sum(0)
        beyond = (cell - cell.clamp(0, _CELLS - 1)).abs() * _WIDTH * unit
        return total, beyond, -torch.expm1(-self.rate.clamp(min=1e-30))

    def _log_density(self, charge: Tensor) -> Tensor:
        """Log-density, per electron, of charges with at least one pulse; the tail beyond the table is that of one pulse."""
        found, beyond, share = self._looked_up(self._log_densities, charge)
        return found - beyond / self.pulse_variance + torch.log(share)

    def _below(self, charge: Tensor) -> Tensor:
        """CDF of charges with at least one pulse."""
        found, _, share = self._looked_up(self._cumulative, charge)
        return found.clamp(0, 1) * share

    def log_prob(self, value: Tensor) -> Tensor:
        charge = self._charge(value)
        dark = -0.5 * (charge / self.read_noise) ** 2 - torch.log(self.read_noise) - LOG_SQRT_2PI - self.rate
        return _added(dark, self._log_density(charge)) - torch.log(self.gain)

    def cdf(self, value: Tensor) -> Tensor:
        charge = self._charge(value)
        return torch.exp(-self.rate) * normal_cdf(charge / self.read_noise) + self._below(charge)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        """Log-probability of (low, high]: Gauss–Legendre quadrature in narrow intervals, the difference of the CDF in others."""
        bottom, top = (of_finite(self._charge, each.double()) for each in (low, high))
        dark = log_normal_interval(*(of_finite(lambda z: z / self.read_noise, z) for z in (bottom, top))) - self.rate
        width = top - bottom
        narrow = width.detach() < _NARROW * self.read_noise.detach()
        zero, one = torch.zeros_like(width), torch.ones_like(width)
        middle, half = torch.where(narrow, (bottom + top) / 2, zero), torch.where(narrow, width / 2, one)
        shape = (3, *(1,) * width.ndim)
        nodes, weights = (width.new_tensor(each).view(shape) for each in np.polynomial.legendre.leggauss(3))
        inside = torch.logsumexp(self._log_density(middle + nodes * half) + torch.log(weights * half), 0)
        if not is_traced(narrow) and bool(narrow.all()):
            return _added(dark, inside)
        ends = []
        for charge in (bottom, top):
            finite = torch.isfinite(charge)
            below = self._below(torch.where(finite, charge, zero))
            ends.append(torch.where(finite, below, (charge > 0) * -torch.expm1(-self.rate)))
        return _added(dark, torch.where(narrow, inside, torch.log((ends[1] - ends[0]).clamp(min=_LEAST))))

    def icdf(self, value: Tensor) -> Tensor:
        reach = 12 * self.variance.sqrt().double() + 20 * self.gain
        middle = self.mean.double() + 0 * value
        return bisect_quantile(self.cdf, value.double(), middle - reach, middle + 1.5 * reach)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        rate = self.rate.expand((*sample_shape, *self.batch_shape))
        electrons = draw_poisson(torch.nan_to_num(rate), generator)
        shape = electrons / self.pulse_variance
        charge = torch._standard_gamma(shape.clamp(min=1e-30), generator=generator) * self.pulse_variance
        normal = torch.randn(rate.shape, generator=generator, dtype=rate.dtype, device=rate.device)
        charge = torch.where(electrons > 0, charge, torch.zeros_like(charge))
        return torch.minimum(self.signal.double(), self.offset) + self.gain * (charge + self.read_noise * normal)

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self.gain**2 * (self.rate * (1 + self.pulse_variance) + self.read_noise**2)


def _added(first: Tensor, second: Tensor) -> Tensor:
    """log(exp(first) + exp(second)); torch.logaddexp has NaN as second derivative where the two differ much."""
    return torch.logsumexp(torch.stack([first, second]), 0)


def _place(rate: Tensor) -> Tensor:
    """Coordinate of the nodes, log(1 + √rate); with a finite slope at 0, as double backward passes need."""
    return torch.log1p(torch.sqrt(rate + _LEAST_RATE) - math.sqrt(_LEAST_RATE))
