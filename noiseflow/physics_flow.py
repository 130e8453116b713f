"""Physics and a flow: shot and read noise exactly, and a smooth map of its latent for what they miss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions import (
    NoiseDistribution,
    log_normal_cdf,
    log_normal_interval,
    normal_hazard,
    normal_quadrature,
)
from noiseflow.electrons import log_density, log_tail
from noiseflow.flow import ConditionalFlow, _inverse, affine_layer, spline_layer
from noiseflow.physical import PoissonGaussian, PoissonGaussianDistribution
from noiseflow.transforms import Transform

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_MAX_INVERSION_STEPS = 80
_NODES_AT_ONCE = 100_000


class PhysicsFlow(nn.Module):
    """Poisson–Gaussian noise, corrected by a flow of its latent.

    The latent of an observation under the detector, z = Φ⁻¹(F(o | s)), is standard normal if the detector is the whole truth.
    A conditional affine map and spline, which start at the identity, take it to z′, and z′ is the standard normal latent of this
    model: log p = log p_detector + log φ(z′) + log dz′/dz − log φ(z). Peaks of single electrons stay where the physics puts them.

    Args:
        num_bins: bins of the spline.
        width: hidden units of the conditioning network.
        detector: the physical part; a default `PoissonGaussian` where none is given.
    """

    def __init__(self, num_bins: int = 16, *, width: int = 32, detector: PoissonGaussian | None = None) -> None:
        super().__init__()
        self.num_bins, self.width = num_bins, width
        self.detector = PoissonGaussian() if detector is None else detector
        self.correction = ConditionalFlow([affine_layer(), spline_layer(num_bins)], width=width)

    def forward(self, signal: Tensor) -> PhysicsFlowDistribution:
        """The distribution of observations of pixels with the given signals, any shape, detector units."""
        coordinate = self.correction.standardisation.coordinate(signal)
        return PhysicsFlowDistribution(self.detector(signal), self.correction.transforms(coordinate))

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Start at the most likely detector for (N,) signals and observations."""
        self.detector.standardise(signal, observation)
        self.correction.standardise(signal, observation)

    def config(self) -> dict[str, Any]:
        """The arguments that make this model again, besides the detector inside."""
        return {"num_bins": self.num_bins, "width": self.width}


class PhysicsFlowDistribution(NoiseDistribution):
    """A Poisson–Gaussian distribution whose latent is mapped on; float64 inside.

    Args:
        base: the detector's distribution.
        transforms: increasing maps from the detector's latent to this model's, in order.
    """

    def __init__(self, base: PoissonGaussianDistribution, transforms: Sequence[Transform]) -> None:
        super().__init__(base.batch_shape)
        self.base, self._transforms = base, transforms

    def _correct(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """The mapped latent, and the log-density of this model over that of the detector."""
        mapped, gain = latent, torch.zeros_like(latent)
        for transform in self._transforms:
            mapped, ladj = transform.forward(mapped)
            gain = gain + ladj
        return mapped, gain + (latent - mapped) * (latent + mapped) / 2

    def _detector_latent(self, value: Tensor) -> Tensor:
        finite = torch.isfinite(value)
        residual, rate = self.base.electrons(torch.where(finite, value, torch.zeros_like(value)))
        side = torch.where(residual.detach() > 0, -1.0, 1.0).to(residual)
        latent = side * ndtri_exp(log_tail(residual, rate, self.base.read_noise))
        return torch.where(finite, latent, value.to(latent))

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The latent of an observation and the log-derivative, ``(z, log dz/do)``."""
        latent, _ = self._correct(self._detector_latent(value))
        ladj = self._log_prob(value) + 0.5 * latent**2 + _LOG_SQRT_2PI
        return latent.to(value.dtype), ladj.to(value.dtype)

    @torch.no_grad()
    def from_latent(self, latent: Tensor) -> Tensor:
        """The observation of a latent."""
        found = self._invert(_inverse(self._transforms, latent.double())[0])
        return found.to(latent.dtype)

    def _invert(self, target: Tensor) -> Tensor:
        rate = self.base.rate.expand_as(target)
        residual = invert_latent(target.flatten(), rate.flatten(), self.base.read_noise).reshape(target.shape)
        return residual * self.base.gain + self.base.mean.double()

    def _log_prob(self, value: Tensor) -> Tensor:
        residual, rate = self.base.electrons(value)
        detector = log_density(residual, rate, self.base.read_noise) - torch.log(self.base.gain)
        return detector + self._correct(self._detector_latent(value))[1]

    def log_prob(self, value: Tensor) -> Tensor:
        return self._log_prob(value).to(value.dtype)

    def cdf(self, value: Tensor) -> Tensor:
        probability: Tensor = torch.special.ndtr(self._mapped_bound(self._detector_latent(value)))
        return probability.to(value.dtype)

    def _mapped_bound(self, latent: Tensor) -> Tensor:
        finite = torch.isfinite(latent)
        mapped = self._correct(torch.where(finite, latent, torch.zeros_like(latent)))[0]
        return torch.where(finite, mapped, latent)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        """The detector's own, exact mass times the mean correction, so that masses far below rounding of the CDF survive."""
        bottom, top = self._detector_latent(low), self._detector_latent(high)
        narrow = top - bottom < 1e-3
        zero = torch.zeros_like(bottom)
        at_middle = self._correct(torch.where(narrow, (bottom + top) / 2, zero))[1]
        a, b = torch.where(narrow, zero - 1, bottom), torch.where(narrow, zero + 1, top)
        wide = log_normal_interval(self._mapped_bound(a), self._mapped_bound(b)) - log_normal_interval(a, b)
        result = self.base.log_interval_prob(low.double(), high.double()) + torch.where(narrow, at_middle, wide)
        return result.to(low.dtype)

    def icdf(self, value: Tensor) -> Tensor:
        return self.from_latent(torch.special.ndtri(value.double())).to(value.dtype)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        signal = self.base.signal
        shape = (*sample_shape, *self.batch_shape)
        return self.from_latent(torch.randn(shape, generator=generator, dtype=signal.dtype, device=signal.device))

    @property
    def mean(self) -> Tensor:
        return self._moment(torch.zeros_like(self.base.signal), 1)

    @property
    def variance(self) -> Tensor:
        return self._moment(self.mean, 2)

    def _moment(self, about: Tensor, power: int) -> Tensor:
        nodes, weights = normal_quadrature(torch.float64)
        total = torch.zeros(self.batch_shape, dtype=torch.float64)
        together = max(1, _NODES_AT_ONCE // max(1, total.numel()))
        for part, weight in zip(torch.split(nodes, together), torch.split(weights, together), strict=True):
            shape = (-1, *(1 for _ in self.batch_shape))
            observations = self.from_latent(part.reshape(shape).expand(-1, *self.batch_shape))
            total = total + (weight.reshape(shape) * (observations - about) ** power).sum(0)
        return total.to(self.base.signal.dtype)


@torch.no_grad()
def invert_latent(target: Tensor, rate: Tensor, read_noise: Tensor) -> Tensor:
    """The residual, electrons, whose detector latent is `target`: Newton's method between bounds that close in on it; (N,)."""
    spread, size = torch.sqrt(rate) + read_noise + 1, target.abs() + 3
    low, high = -spread * size, spread * size + size**2
    result = residual = torch.sqrt(rate + read_noise**2) * target
    left = torch.arange(target.numel())
    for step in range(_MAX_INVERSION_STEPS):
        side = torch.where(residual > 0, -1.0, 1.0).to(residual)
        latent = side * ndtri_exp(log_tail(residual, rate, read_noise))
        above = latent >= target
        low, high = torch.where(above, low, residual), torch.where(above, residual, high)
        result = result.index_put((left,), residual)
        log_slope = log_density(residual, rate, read_noise) + 0.5 * latent**2 + _LOG_SQRT_2PI
        newton = residual - (latent - target) * torch.exp(-log_slope)
        residual = torch.where((newton > low) & (newton < high) & (step % 4 != 3), newton, (low + high) / 2)
        going = ((latent - target).abs() > 1e-9) & (high - low > 1e-12 * spread)
        if not bool(going.any()):
            break
        left, target, rate, residual, low, high, spread = (
            each[going] for each in (left, target, rate, residual, low, high, spread)
        )
    return result


def ndtri_exp(log_probability: Tensor) -> Tensor:
    """Φ⁻¹(exp(log_probability)), accurate and differentiable however small the probability."""
    with torch.no_grad():
        deep = log_probability < -200
        far = torch.where(deep, -2 * log_probability, torch.full_like(log_probability, 400.0))
        start = torch.special.ndtri(torch.exp(torch.where(deep, -1.0, log_probability)))
        z = torch.where(deep, -torch.sqrt(far - torch.log(2 * math.pi * far)), start)
        z = z - (log_normal_cdf(z) - log_probability) / normal_hazard(z)
        hazard = normal_hazard(z)
    return z - (log_normal_cdf(z) - log_probability) / hazard
