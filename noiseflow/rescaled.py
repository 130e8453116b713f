"""A noise distribution whose readings are stretched and shifted, pixel by pixel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from noiseflow.distributions import NoiseDistribution


class RescaledDistribution(NoiseDistribution):
    """The distribution of scale·o + shift, o from another noise distribution.

    Args:
        base: distribution of o.
        scale, shift: positive numbers and numbers that broadcast with the batch of `base`; new axes may only lead.
    """

    def __init__(self, base: NoiseDistribution, scale: Tensor, shift: Tensor) -> None:
        super().__init__(torch.broadcast_shapes(base.batch_shape, scale.shape, shift.shape))  # type: ignore[no-untyped-call]
        self.base, self.scale, self.shift = base, scale, shift

    def _back(self, value: Tensor) -> Tensor:
        finite = torch.isfinite(value)  # the gradient of an infinite bound must not become NaN
        inside = (torch.where(finite, value, torch.zeros_like(value)) - self.shift) / self.scale
        return torch.where(finite, inside, value)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base.log_prob((value - self.shift) / self.scale) - torch.log(self.scale)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.base.log_interval_prob(self._back(low), self._back(high))

    def cdf(self, value: Tensor) -> Tensor:
        return self.base.cdf(self._back(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self.base.cdf_below(self._back(value))

    def icdf(self, value: Tensor) -> Tensor:
        return self.base.icdf(value) * self.scale + self.shift

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        leading = self.batch_shape[: len(self.batch_shape) - len(self.base.batch_shape)]
        return self.base.sample((*sample_shape, *leading), generator) * self.scale.detach() + self.shift.detach()

    @property
    def mean(self) -> Tensor:
        return self.base.mean * self.scale + self.shift

    @property
    def variance(self) -> Tensor:
        return self.base.variance * self.scale**2 + torch.zeros_like(self.shift)
