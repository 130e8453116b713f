"""Detectors with random electron multiplication: EMCCDs, photomultipliers, direct detectors with straggling."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile
from noiseflow.fitting.steps import lbfgs
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.physical import ElectronCounter

_NODES, _CELLS = 96, 4096
_WIDTH = 0.0125  # width of a cell in standard deviations; the interpolation error is then 2e-5 nats
# Share of the cells below the mean: 12.8 standard deviations, and 38 above it, where the tail is exponential
_BELOW = 0.25
_LEAST = 1e-14  # density per standard deviation below which rounding errors of the transform dominate
_FITTED, _ITERATIONS = 16384, 60


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

    origin: Tensor

    def __init__(
        self, gain: float = 0.01, offset: float = 0.0, read_noise: float = 2.0, *, excess_factor: float = 2.0
    ) -> None:
        super().__init__()
        if not (gain > 0 and read_noise > 0 and excess_factor > 1):
            raise ValueError(
                f"gain is {gain}, read_noise {read_noise} and excess_factor {excess_factor}; the first two must be positive and "
                "the last above 1"
            )
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
        """The distribution of the observations, given signals of any shape, detector units."""
        return ExcessNoiseDistribution(signal, *self._parameters_now())

    @property
    def starts_most_likely(self) -> bool:
        """True, because `standardise` finds the maximum of the likelihood."""
        return True

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the parameters from the second and third moments of (N,) observations at each signal level."""
        s, residual = signal.double(), observation.double() - signal.double()
        groups = torch.tensor_split(torch.argsort(s), max(4, min(32, s.numel() // 200)))
        mean = torch.stack([s[group].mean() for group in groups])
        second = torch.stack([(residual[group] ** 2).mean() for group in groups])
        third = torch.stack([(residual[group] ** 3).mean() for group in groups])
        product, floor = _line(mean, second, second**2)
        skew, _ = _line(mean, third, second**3)
        product = max(product, 1e-6 * float(second.mean()) / max(float(s.abs().mean()), 1e-12))
        squared = 1 / (2 - min(max(skew / product**2, 1.02), 1.6))
        gain = product / squared
        offset = float(mean.min()) - max(float(second.min()) * 0.5, 0.0) / product
        read = math.sqrt(max(floor + product * offset, 0.02 * float(second.min()))) / gain
        with torch.no_grad():
            self.change.zero_()
            self.origin.copy_(torch.tensor([math.log(gain), offset, math.log(read), math.log(squared - 1)]))
        self.settle(signal, observation)

    def settle(
        self, signal: Tensor, observation: Tensor, behind: Callable[[NoiseModelBase], NoiseModelBase] | None = None
    ) -> None:
        """Maximise the likelihood of (N,) signals and observations, starting from the current parameters.

        Args:
            signal, observation: detector units.
            behind: function that wraps the model in later stages of the detector, such as rounding and clipping.
        """
        every = max(1, signal.numel() // _FITTED)
        seen, values = signal[::every].double(), observation[::every].double()
        model = self if behind is None else behind(self)
        climber = lbfgs([self.change], max_iter=_ITERATIONS)
        best, kept = math.inf, self.change.detach().clone()

        def loss() -> Tensor:
            nonlocal best, kept
            climber.zero_grad()
            value: Tensor = -model(seen).log_prob(values).clamp(min=-60.0).mean()
            value.backward()  # type: ignore[no-untyped-call]
            if float(value.detach()) < best:
                best, kept = float(value.detach()), self.change.detach().clone()
            return value

        with torch.enable_grad():
            climber.step(loss)  # type: ignore[no-untyped-call]
        with torch.no_grad():
            self.change.copy_(kept)

    def extra_repr(self) -> str:
        gain, offset, read_noise, more = (float(each.detach()) for each in self._parameters_now())
        return f"gain={gain:.5g}, offset={offset:.5g}, read_noise={read_noise:.4g}, excess_factor={1 + more:.4g}"


def _line(mean: Tensor, value: Tensor, variance: Tensor) -> tuple[float, float]:
    """Weighted slope and intercept."""
    weight = 1 / variance.clamp(min=1e-30)
    middle = (weight * mean).sum() / weight.sum()
    slope = (weight * (mean - middle) * value).sum() / (weight * (mean - middle) ** 2).sum().clamp(min=1e-30)
    return float(slope), float((weight * value).sum() / weight.sum() - slope * middle)


class ExcessNoiseDistribution(NoiseDistribution):
    """Distribution of offset + gain·(compound Poisson of gamma pulses + read noise).

    The characteristic function is exact. Its Fourier transform gives CDFs on grids of standardised values at `_NODES` signals
    between the smallest and the largest, evenly spaced in their square root. CDFs at other signals are interpolated (error
    1e-4 nats if the noise is smooth).

    Args:
        signal: clean pixel values, detector units.
        gain, offset, read_noise, pulse_variance: scalars, float64; the last is F² − 1.
    """

    def __init__(
        self, signal: Tensor, gain: Tensor, offset: Tensor, read_noise: Tensor, pulse_variance: Tensor
    ) -> None:
        super().__init__(signal.shape)
        self.signal, self.gain, self.offset = signal, gain, offset
        self.read_noise, self.pulse_variance = read_noise, pulse_variance
        self.rate = ((signal.double() - offset) / gain).clamp(min=0)
        self._kept: tuple[Tensor, Tensor, Tensor, float, float] | None = None

    def _tables(self) -> tuple[Tensor, Tensor, Tensor, float, float]:
        """Density and CDF, (node, cell), of electrons standardised at each node; and the square roots of the nodes."""
        if self._kept is None:
            low, high = (float(end) for end in torch.aminmax(self.rate.detach().sqrt()))
            roots = torch.linspace(low, max(high, low + 1e-3), _NODES, dtype=torch.float64, device=self.rate.device)
            rate = roots**2
            deviation = torch.sqrt(rate * (1 + self.pulse_variance) + self.read_noise**2)
            width = _WIDTH
            turn = (
                torch.arange(_CELLS // 2 + 1, dtype=torch.float64, device=rate.device) * 2 * math.pi / (_CELLS * width)
            )
            phase = turn / deviation[:, None]
            pulse = torch.exp(
                -torch.log1p(torch.complex(torch.zeros_like(phase), -phase * self.pulse_variance)) / self.pulse_variance
            )
            exponent = rate[:, None] * (pulse - 1) - 0.5 * (phase * self.read_noise) ** 2
            start = -_BELOW * _CELLS * width
            shift = torch.complex(torch.zeros_like(phase), -(turn * start + phase * rate[:, None]))
            density = torch.fft.irfft(torch.conj(torch.exp(exponent + shift)), n=_CELLS) / width
            density = density.clamp(min=_LEAST)
            step = 0.5 * width * (density[:, 1:] + density[:, :-1])
            below = torch.cat([torch.zeros_like(step[:, :1]), torch.cumsum(step, 1)], 1)
            self._kept = density, below / below[:, -1:].detach().clamp(min=1e-6), roots, start, width
        return self._kept

    def _at(self, value: Tensor, log_density: bool) -> Tensor:
        """Log-density or CDF at values, interpolated between nodes and cells."""
        density, below, roots, start, width = self._tables()
        table = density.log() if log_density else below
        root = torch.sqrt(self.rate.clamp(min=1e-12)).expand(value.shape)
        residual = (value.double() - self.offset) / self.gain - self.rate
        deviation = torch.sqrt(self.rate * (1 + self.pulse_variance) + self.read_noise**2)
        place = (residual / deviation - start) / width
        cell = place.clamp(0, _CELLS - 1.001)
        node = ((root - roots[0]) / (roots[1] - roots[0])).clamp(0, _NODES - 1.001)
        i, j = node.detach().floor().long(), cell.detach().floor().long()
        a, b = node - i, cell - j
        flat = table.reshape(-1)
        corner = [flat[(i + m) * _CELLS + (j + n)] for m in (0, 1) for n in (0, 1)]
        found = (1 - a) * ((1 - b) * corner[0] + b * corner[1]) + a * ((1 - b) * corner[2] + b * corner[3])
        if not log_density:
            return found
        beyond = (place - cell).abs() * width * deviation  # electrons; there the tail decreases like that of one pulse
        return found - deviation.log() - beyond / self.pulse_variance

    def log_prob(self, value: Tensor) -> Tensor:
        return self._as(value, self._at(value, True) - torch.log(self.gain))

    def cdf(self, value: Tensor) -> Tensor:
        return self._as(value, self._at(value, False))

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        """Log-probability of (low, high]: the difference of the CDF; in far tails density times width."""
        ends = []
        for value, empty in ((low, 0.0), (high, 1.0)):
            finite = torch.isfinite(value)
            ends.append(
                torch.where(finite, self._at(torch.where(finite, value, self.signal.expand(value.shape)), False), empty)
            )
        ends[0] = torch.where(low == math.inf, torch.ones_like(ends[0]), ends[0])
        ends[1] = torch.where(high == -math.inf, torch.zeros_like(ends[1]), ends[1])
        mass = ends[1] - ends[0]
        both = torch.isfinite(low) & torch.isfinite(high)
        middle = torch.where(both, 0.5 * (low + high), self.signal.expand(low.shape))
        width = torch.where(both, high - low, torch.ones_like(low)).double().clamp(min=1e-300)
        far = self._at(middle, True) - torch.log(self.gain) + torch.log(width)
        found = torch.where(both & (mass < 1e-9), far, torch.log(mass.clamp(min=1e-12)))
        return self._as(low, found)

    def icdf(self, value: Tensor) -> Tensor:
        reach = 12 * self.variance.sqrt().double() + 20 * self.gain
        middle = self.mean.double() + 0 * value
        return self._as(value, bisect_quantile(self, value.double(), middle - reach, middle + 1.5 * reach))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            rate = self.rate.expand((*sample_shape, *self.batch_shape))
            electrons = torch.poisson(rate, generator=generator)
            shape = electrons / self.pulse_variance
            charge = torch._standard_gamma(shape.clamp(min=1e-30), generator=generator) * self.pulse_variance
            normal = torch.randn(rate.shape, generator=generator, dtype=rate.dtype, device=rate.device)
            charge = torch.where(electrons > 0, charge, torch.zeros_like(charge))
            return self._as(self.signal, self.offset + self.gain * (charge + self.read_noise * normal))

    def _as(self, like: Tensor, result: Tensor) -> Tensor:
        return result.to(torch.promote_types(like.dtype, self.signal.dtype))

    @property
    def mean(self) -> Tensor:
        return torch.maximum(self.signal, self._as(self.signal, self.offset.expand(self.signal.shape)))

    @property
    def variance(self) -> Tensor:
        return self._as(self.signal, self.gain**2 * (self.rate * (1 + self.pulse_variance) + self.read_noise**2))
