"""Counting detectors with dead time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.laws.dead_time import DeadTimeDistribution
from noiseflow.models.base import NoiseModelBase


class DeadTimeCounter(NoiseModelBase):
    """Counts of single events by a detector with a fixed dead time after each count (non-paralysable).

    The signal is the expected *count*; the event rate signal/(1 − signal·dead_time) is higher. The variance is about
    signal·(1 − signal·dead_time)², less than that of Poisson counts.

    Args:
        dead_time: dead time as a share of the exposure, above 0 and below 1.

    Raises:
        ValueError: `dead_time` is outside this range.

    Example:
        >>> import noiseflow, torch
        >>> counter = noiseflow.DeadTimeCounter(dead_time=0.01)
        >>> bool(counter(torch.tensor(20.0)).variance < 20)  # scatters less than Poisson counts
        True
    """

    describes_single_readings = True
    fits_directly = True

    def __init__(self, dead_time: float = 1e-3) -> None:
        super().__init__()
        check(dead_time=dead_time)
        self.raw_dead_time = nn.Parameter(torch.logit(torch.tensor(float(dead_time))))

    @property
    def dead_time(self) -> Tensor:
        """Dead time as a share of the exposure."""
        return torch.sigmoid(self.raw_dead_time)

    def forward(self, signal: Tensor) -> DeadTimeDistribution:
        """The distribution of the counts, given the expected counts, any shape."""
        return DeadTimeDistribution(signal, self.dead_time)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the dead time from the variance of (N,) signals and counts, signal·(1 − signal·dead_time)²."""
        signal, observation = signal.double(), observation.double()
        lack = signal - (observation - signal) ** 2  # its expectation is 2·signal²·dead_time, to first order
        weight = 1 / signal.clamp(min=1e-3)
        share = (weight * lack).sum() / (2 * weight * signal**2).sum()
        self.raw_dead_time.copy_(torch.logit(share.clamp(1e-5, 0.5 / max(1.0, float(signal.max())))))

    def extra_repr(self) -> str:
        return f"dead_time={self.dead_time.item():.4g}"
