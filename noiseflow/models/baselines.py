"""The textbook noise models that the flows are judged against: Gaussian and Poisson."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from noiseflow.distributions.textbook import GaussianDistribution as GaussianDistribution
from noiseflow.distributions.textbook import PoissonDistribution as PoissonDistribution
from noiseflow.models.base import NoiseModelBase


class Gaussian(NoiseModelBase):
    """Gaussian noise of one standard deviation around the signal.

    Args:
        scale: standard deviation, detector units.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.Gaussian(0.1)
        >>> noise(torch.tensor([0.5, 0.7])).mean
        tensor([0.5000, 0.7000])
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


class Poisson(NoiseModelBase):
    """Shot noise: observation = gain·k + offset with k Poisson of rate (signal − offset)/gain.

    Observations lie on a grid of spacing ``gain``. ``log_prob`` spreads each grid point's mass evenly over its cell: it
    is a density per detector unit like that of the other models, for observations between grid points too.

    Args:
        gain: counts per electron.
        offset: counts at zero dose.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.Poisson(gain=2.0)
        >>> noise(torch.tensor(100.0)).variance.item()
        200.0
    """

    describes_single_readings = True

    def __init__(self, gain: float = 1.0, offset: float = 0.0) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.tensor(math.log(gain)))
        self.offset = nn.Parameter(torch.tensor(float(offset)))

    def forward(self, signal: Tensor) -> PoissonDistribution:
        wide = torch.promote_types(self.log_gain.dtype, torch.float32)
        return PoissonDistribution(signal, torch.exp(self.log_gain.to(wide)), self.offset)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Start at the straight line of variance against (N,) signal, and stay there: the likelihood of a grid of unknown
        spacing has no useful gradient."""
        gain, offset = photon_line(signal, observation)
        self.log_gain.copy_(torch.log(gain))
        self.offset.copy_(offset)
        self.requires_grad_(False)

    def extra_repr(self) -> str:
        return f"gain={math.exp(self.log_gain.item()):.4g}, offset={self.offset.item():.4g}"


def photon_line(signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Gain and offset of pure shot noise, ``variance = gain·(signal − offset)``, for (N,) signals and observations.

    Least squares of squared residual on signal gives the line. Where it makes pixel values impossible (shot noise never
    falls below the offset), the offset moves one count below the lowest pixel value and the gain keeps the mean variance.
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
