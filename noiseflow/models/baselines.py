"""Baseline noise models: Gaussian and Poisson."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.laws.textbook import GaussianDistribution as GaussianDistribution
from noiseflow.distributions.laws.textbook import PoissonDistribution as PoissonDistribution
from noiseflow.distributions.laws.textbook import SpreadPoissonDistribution
from noiseflow.models.base import Behind, NoiseModelBase


class Gaussian(NoiseModelBase):
    """Gaussian noise with the same standard deviation at all signals.

    Args:
        scale: standard deviation, detector units.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.Gaussian(0.1)
        >>> noise(torch.tensor([0.5, 0.7])).mean
        tensor([0.5000, 0.7000])
    """

    fits_directly = True

    def __init__(self, scale: float = 0.1) -> None:
        super().__init__()
        check(scale=scale)
        self.log_scale = nn.Parameter(torch.tensor(math.log(scale)))

    def forward(self, signal: Tensor) -> GaussianDistribution:
        return GaussianDistribution(signal, self.log_scale)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the scale to the root-mean-square residual of (N,) signals and observations."""
        self.log_scale.copy_(torch.log((observation.double() - signal.double()).square().mean().sqrt()))

    def extra_repr(self) -> str:
        return f"scale={math.exp(self.log_scale.item()):.4g}"


class Poisson(NoiseModelBase):
    """Shot noise: observation = gain·k + offset with k Poisson of rate (signal − offset)/gain.

    Observations are on a grid of spacing ``gain``. ``log_prob`` spreads the probability of each grid point evenly over its cell.
    It is a density per detector unit, as for the other models, and also defined between grid points.

    Args:
        gain: counts per electron.
        offset: counts at zero dose.
        spread: also draw from that density, evenly within the cells. With a converter whose steps are finer than the gain,
            pixel values between the grid points are then possible.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.Poisson(gain=2.0)
        >>> noise(torch.tensor(100.0)).variance.item()
        200.0
    """

    def __init__(self, gain: float = 1.0, offset: float = 0.0, *, spread: bool = False) -> None:
        super().__init__()
        check(gain=gain, offset=offset)
        self.spread = spread
        self.log_gain = nn.Parameter(torch.tensor(math.log(gain)))
        # single precision would round the offset of a large level
        self.offset = nn.Parameter(torch.tensor(float(offset), dtype=torch.float64))

    @property
    def describes_single_readings(self) -> bool:
        """Whether pixel values are on the grid: False if the probabilities are spread."""
        return not self.spread

    def forward(self, signal: Tensor) -> PoissonDistribution:
        wide = torch.promote_types(self.log_gain.dtype, torch.float32)
        kind = SpreadPoissonDistribution if self.spread else PoissonDistribution
        return kind(signal, torch.exp(self.log_gain.to(wide)), self.offset)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set gain and offset from a straight line of variance against (N,) signals. They are not trained, because the
        likelihood of a grid of unknown spacing has no useful gradient."""
        gain, offset = photon_line(signal, observation)
        self.log_gain.copy_(torch.log(gain))
        self.offset.copy_(offset)
        self.requires_grad_(False)

    @torch.no_grad()
    def settle(self, signal: Tensor, observation: Tensor, behind: Behind | None = None) -> None:
        """Choose the position of the grid on the levels of a converter, by the likelihood of (N,) signals and observations.

        If the gain is one step, as for a counter of single events, grid and levels coincide. With a coarser grid of unknown
        spacing some levels would be impossible, so its probabilities are spread.
        """
        step = 0.0 if behind is None else behind(self).step
        if behind is None or not step > 0:
            return
        gain, offset = float(self.log_gain.exp()), float(self.offset)
        places = [(gain, offset, gain >= step)]
        # event counting, whose gain is one step: the residuals of a predicted signal may not show it
        nearest = step * round((float(signal.mean()) - float((observation - signal).square().mean()) / step) / step)
        offsets = [nearest + more * step for more in (-2, -1, 0, 1, 2)] + [0.0, float(observation.min())]
        places += [(step, place, False) for place in offsets]
        some = torch.arange(0, len(signal), max(1, len(signal) // 4096), device=signal.device)
        some = torch.cat([some, observation.argmin()[None]])  # the lowest pixel value must be possible
        signal, observation = signal[some].double(), observation[some].double()
        found: list[float] = []
        for place in places:
            self._move_to(*place)
            found.append(float(behind(self)(signal).log_prob(observation).mean()))
        self._move_to(*places[max(range(len(places)), key=found.__getitem__)])

    def _move_to(self, gain: float, offset: float, spread: bool) -> None:
        self.log_gain.fill_(math.log(gain))
        self.offset.fill_(offset)
        self.spread = spread

    def config(self) -> dict[str, Any]:
        """Whether the probabilities are spread."""
        return {"spread": True} if self.spread else {}

    def extra_repr(self) -> str:
        spread = ", spread=True" if self.spread else ""
        return f"gain={math.exp(self.log_gain.item()):.4g}, offset={self.offset.item():.4g}{spread}"


def photon_line(signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Gain and offset of pure shot noise, ``variance = gain·(signal − offset)``, for (N,) signals and observations. The line is
    fitted by least squares of squared residuals against signals. If it makes pixel values impossible (shot noise is never below
    the offset), the offset is set to one count below the lowest pixel value and the gain keeps the mean variance."""
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
