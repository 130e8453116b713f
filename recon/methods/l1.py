"""Least absolute deviations with the field and the regulariser of the joint fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.models.base import NoiseModelBase
from recon.methods._fitted import fitted


class Laplace(NoiseModelBase):
    """Laplace noise with the same width at all signals.

    Args:
        scale: mean absolute deviation, detector units.
    """

    def __init__(self, scale: float = 0.1) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(scale)))

    def forward(self, signal: Tensor) -> LaplaceDistribution:
        return LaplaceDistribution(signal, self.log_scale)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the scale to the mean absolute residual of (N,) signals and observations."""
        self.log_scale.copy_(torch.log((observation.double() - signal.double()).abs().mean()))

    def config(self) -> dict[str, Any]:
        return {}


class LaplaceDistribution(NoiseDistribution):
    """Laplace distribution around the signal."""

    def __init__(self, signal: Tensor, log_scale: Tensor) -> None:
        super().__init__(signal.shape)
        self.signal, self.log_scale = signal, log_scale

    def _standard(self, value: Tensor) -> Tensor:
        return (value - self.signal) * torch.exp(-self.log_scale)

    def log_prob(self, value: Tensor) -> Tensor:
        return -self._standard(value).abs() - self.log_scale - math.log(2)

    def cdf(self, value: Tensor) -> Tensor:
        standard = self._standard(value)
        tail = 0.5 * torch.exp(-standard.abs())
        return torch.where(standard < 0, tail, 1 - tail)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        low, high = self._standard(low), self._standard(high)
        flip = low > -high  # intervals above zero are mirrored
        low, high = torch.where(flip, -high, low), torch.where(flip, -low, high)
        left = high + torch.log(-torch.expm1(low - high)) - math.log(2)
        across = torch.log1p(-0.5 * (torch.exp(low) + torch.exp(-high.clamp_min(0))))
        return torch.where(high <= 0, left, across)

    def icdf(self, value: Tensor) -> Tensor:
        tail = torch.minimum(value, 1 - value)
        return self.signal - torch.sign(value - 0.5) * torch.log(2 * tail) * torch.exp(self.log_scale)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        like, shape = self.signal, (*sample_shape, *self.batch_shape)
        with torch.no_grad():
            uniform = torch.rand(shape, generator=generator, dtype=torch.float64, device=like.device)
            return self.icdf(uniform.clamp_min(1e-300)).to(like.dtype)

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return 2 * torch.exp(2 * self.log_scale).expand_as(self.signal)


METHOD = fitted(
    "l1",
    "Least absolute deviations, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Laplace},
)
