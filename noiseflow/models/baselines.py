"""The textbook noise models that the flows are judged against: Gaussian and Poisson."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from noiseflow.distributions.base import LatentDistribution, NoiseDistribution, bisect_quantile
from noiseflow.models.base import NoiseModelBase


class Gaussian(NoiseModelBase):
    """Gaussian noise of one standard deviation around the signal.

    Args:
        scale: standard deviation, detector units.
    """

    def __init__(self, scale: float = 0.1) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(scale)))

    def forward(self, signal: Tensor) -> GaussianDistribution:
        return GaussianDistribution(signal, self.log_scale)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Start at the root-mean-square residual of (N,) signals and observations."""
        self.log_scale.copy_(torch.log((observation.double() - signal.double()).square().mean().sqrt()))

    def extra_repr(self) -> str:
        return f"scale={math.exp(self.log_scale.item()):.4g}"


class GaussianDistribution(LatentDistribution):
    """Normal distribution around the signal."""

    def __init__(self, signal: Tensor, log_scale: Tensor) -> None:
        super().__init__(signal.shape)
        self.signal, self.log_scale = signal, log_scale

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        latent = (value - self.signal) * torch.exp(-self.log_scale)
        return latent, -self.log_scale.expand_as(latent)

    def from_latent(self, latent: Tensor) -> Tensor:
        return self.signal + latent * torch.exp(self.log_scale)

    def _like(self) -> Tensor:
        return self.signal

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return torch.exp(2 * self.log_scale).expand_as(self.signal)


class Poisson(NoiseModelBase):
    """Shot noise: observation = gain·k + offset with k Poisson of rate (signal − offset)/gain.

    Observations lie on a lattice of spacing ``gain``. ``log_prob`` spreads each lattice point's mass evenly over its cell: it
    is a density per detector unit like that of the other models, for observations between lattice points too.

    Args:
        gain: counts per electron.
        offset: counts at zero dose.
    """

    describes_single_readings = True

    def __init__(self, gain: float = 1.0, offset: float = 0.0) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.tensor(math.log(gain)))
        self.offset = nn.Parameter(torch.tensor(float(offset)))

    def forward(self, signal: Tensor) -> PoissonDistribution:
        return PoissonDistribution(signal, torch.exp(self.log_gain), self.offset)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Start at the straight line of variance against (N,) signal, and stay there: the likelihood of a lattice of unknown
        spacing has no useful gradient."""
        gain, offset = photon_line(signal, observation)
        self.log_gain.copy_(torch.log(gain))
        self.offset.copy_(offset)
        self.requires_grad_(False)

    def extra_repr(self) -> str:
        return f"gain={math.exp(self.log_gain.item()):.4g}, offset={self.offset.item():.4g}"


def photon_line(signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Gain and offset of pure shot noise, ``variance = gain·(signal − offset)``, for (N,) signals and observations.

    Least squares of squared residual on signal gives the line. Where it makes readings impossible (shot noise never falls below
    the offset), the offset moves one count below the lowest reading and the gain keeps the mean variance.
    """
    signal, observation = signal.double(), observation.double()
    squared = (observation - signal) ** 2
    centred = signal - signal.mean()
    spread = (centred**2).mean()
    gain = (centred * squared).mean() / spread if spread > 0 else torch.zeros_like(spread)
    lowest = torch.minimum(signal.min(), observation.min())
    if gain > 0 and signal.mean() - squared.mean() / gain <= lowest:
        return gain, signal.mean() - squared.mean() / gain
    # gain·(mean − lowest + gain) = mean variance
    reach = signal.mean() - lowest
    gain = 2 * squared.mean() / (reach + torch.sqrt(reach**2 + 4 * squared.mean()))
    return gain, lowest - gain


class PoissonDistribution(NoiseDistribution):
    """Scaled and shifted Poisson distribution."""

    def __init__(self, signal: Tensor, gain: Tensor, offset: Tensor) -> None:
        super().__init__(signal.shape)
        self.signal, self.gain, self.offset = signal, gain, offset
        self.rate = ((signal - offset) / gain).clamp(min=0)

    def _count(self, value: Tensor) -> Tensor:
        return (value - self.offset) / self.gain

    def log_prob(self, value: Tensor) -> Tensor:
        count = torch.round(self._count(value).detach())
        possible = (count == 0) | ((count > 0) & (self.rate > 0))
        count = torch.where(possible, count, torch.zeros_like(count))
        log_rate = torch.log(torch.where(self.rate > 0, self.rate, torch.ones_like(self.rate)))
        log_mass = count * log_rate - self.rate - torch.lgamma(count + 1)
        return torch.where(possible, log_mass, torch.full_like(log_mass, -math.inf)) - torch.log(self.gain)

    def cdf(self, value: Tensor) -> Tensor:
        # the small shift lets a value computed as gain·k + offset count as having reached k
        return self._mass_up_to(torch.floor(self._count(value) + 1e-3))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self._mass_up_to(torch.ceil(self._count(value) - 1e-3) - 1)

    def _mass_up_to(self, count: Tensor) -> Tensor:
        mass = torch.special.gammaincc((count + 1).clamp(min=1), self.rate.expand_as(count))
        return torch.where(count >= 0, mass, torch.zeros_like(mass))

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return torch.log((self._cdf_or_limit(high) - self._cdf_or_limit(low)).clamp(min=0))

    def _cdf_or_limit(self, bound: Tensor) -> Tensor:
        finite = torch.isfinite(bound)
        inside = self.cdf(torch.where(finite, bound, torch.zeros_like(bound)))
        return torch.where(finite, inside, (bound > 0).to(inside.dtype))

    def icdf(self, value: Tensor) -> Tensor:
        spread = 12 * (torch.sqrt(self.rate) + 1)
        low = torch.full_like(self.rate, -0.5).expand_as(value)
        found = bisect_quantile(self, value, self._value(low), self._value((self.rate + spread).expand_as(value)))
        return self._value(torch.round(self._count(found)))

    def _value(self, count: Tensor) -> Tensor:
        return count * self.gain + self.offset

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._value(torch.poisson(self.rate.expand((*sample_shape, *self.batch_shape)), generator=generator))

    @property
    def mean(self) -> Tensor:
        return self._value(self.rate)

    @property
    def variance(self) -> Tensor:
        return self.rate * self.gain**2
