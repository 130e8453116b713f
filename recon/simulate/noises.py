"""Known noise models without trainable parameters, for simulation and as ground truth for learnt noise models."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.noise_distribution import NoiseDistribution, bisect_quantile
from noiseflow.distributions.numerics.normal import LOG_SQRT_2PI, log_normal_interval, normal_quadrature
from noiseflow.models.base import NoiseModelBase


class SkewedNoise(NoiseModelBase):
    """Noise with standard deviation ``floor + slope · signal``, Gaussian or skewed (sinh–arcsinh, doi:10.1093/biomet/asp053).

    Args:
        floor: standard deviation at zero signal, detector units.
        slope: increase of the standard deviation per unit signal.
        skewness: skewness parameter of the sinh–arcsinh family; 0 is Gaussian, 0.5 has a long tail to the right.
    """

    def __init__(self, floor: float = 0.05, slope: float = 0.2, skewness: float = 0.0) -> None:
        super().__init__()
        self.floor, self.slope, self.skewness = floor, slope, skewness

    def forward(self, signal: Tensor) -> SinhArcsinh:
        return SinhArcsinh(signal, self.floor + self.slope * signal.clamp_min(0), self.skewness)


class SinhArcsinh(LatentDistribution):
    """signal + scale · (sinh(arcsinh z + ε) − mean) / deviation, with mean `signal` and standard deviation `scale`."""

    def __init__(self, signal: Tensor, scale: Tensor, skewness: float) -> None:
        super().__init__(signal.shape)
        self.signal, self.scale, self._skewness = signal, scale, skewness
        nodes, weights = normal_quadrature(torch.float64)
        self._mean = math.sinh(skewness) * float((weights * torch.sqrt(1 + nodes**2)).sum())
        second = math.cosh(skewness) ** 2 + 2 * math.sinh(skewness) ** 2
        self._deviation = math.sqrt(second - self._mean**2)

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        stretched = (value - self.signal) / self.scale * self._deviation + self._mean
        inner = torch.asinh(stretched) - self._skewness
        slope = torch.log(torch.cosh(inner)) - 0.5 * torch.log1p(stretched**2)
        return torch.sinh(inner), slope + math.log(self._deviation) - torch.log(self.scale)

    def from_latent(self, latent: Tensor) -> Tensor:
        stretched = torch.sinh(torch.asinh(latent) + self._skewness)
        return self.signal + self.scale * (stretched - self._mean) / self._deviation

    def _like(self) -> Tensor:
        return self.signal

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self.scale**2


class OutlierNoise(NoiseModelBase):
    """Gaussian noise with a share of outliers with larger standard deviation.

    Args:
        floor, slope: standard deviation at zero signal, and its increase per unit signal.
        share: share of outliers.
        factor: ratio of the standard deviations.
    """

    def __init__(self, floor: float = 0.05, slope: float = 0.1, share: float = 0.05, factor: float = 8.0) -> None:
        super().__init__()
        self.floor, self.slope, self.share, self.factor = floor, slope, share, factor

    def forward(self, signal: Tensor) -> GaussianMixture:
        scale = self.floor + self.slope * signal.clamp_min(0)
        weights = torch.tensor([1 - self.share, self.share]).log().to(signal)
        ones = torch.ones_like(signal)
        return GaussianMixture(
            signal,
            log_weights=torch.stack([weights[0] * ones, weights[1] * ones]),
            centres=torch.stack([signal, signal]),
            scales=torch.stack([scale, self.factor * scale]),
        )


class CountingNoise(NoiseModelBase):
    """Poisson counts plus Gaussian read noise, one count per detector unit; only read noise for signals below zero.

    Args:
        read_noise: electrons rms.
        most: count at which the Poisson sum is truncated.
    """

    def __init__(self, read_noise: float = 0.5, most: int = 40) -> None:
        super().__init__()
        self.read_noise, self.most = read_noise, most

    def forward(self, signal: Tensor) -> GaussianMixture:
        counts = torch.arange(self.most + 1, dtype=signal.dtype, device=signal.device)
        counts = counts.view(-1, *[1] * signal.ndim)
        rate = signal.clamp_min(1e-4)  # keeps likelihoods finite for a vanishing signal
        log_weights = counts * torch.log(rate) - rate - torch.lgamma(counts + 1)
        centres = counts + (signal - rate)
        return GaussianMixture(signal, log_weights, centres, torch.full_like(log_weights, self.read_noise))


class GaussianMixture(NoiseDistribution):
    """A mixture of normal distributions, with components along a new first axis.

    Args:
        mean: mean of the mixture; its shape is the batch shape.
        log_weights, centres, scales: (component, *batch).
    """

    def __init__(self, mean: Tensor, log_weights: Tensor, centres: Tensor, scales: Tensor) -> None:
        super().__init__(mean.shape)
        self._mean, self.log_weights, self.centres, self.scales = mean, log_weights, centres, scales

    def log_prob(self, value: Tensor) -> Tensor:
        latent = (value - self.centres) / self.scales
        return torch.logsumexp(self.log_weights - 0.5 * latent**2 - torch.log(self.scales) - LOG_SQRT_2PI, 0)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        bounds = ((bound - self.centres) / self.scales for bound in (low, high))
        return torch.logsumexp(self.log_weights + log_normal_interval(*bounds), 0)

    def cdf(self, value: Tensor) -> Tensor:
        shares: Tensor = self.log_weights.exp() * torch.special.ndtr((value - self.centres) / self.scales)
        return shares.sum(0)

    def icdf(self, value: Tensor) -> Tensor:
        reach = 12 * self.scales.amax(0)
        return bisect_quantile(self, value, self.centres.amin(0) - reach, self.centres.amax(0) + reach)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        like = self._mean
        shape = (*sample_shape, *self.batch_shape)
        with torch.no_grad():
            uniform = torch.rand(shape, generator=generator, dtype=like.dtype, device=like.device)
            total = torch.zeros_like(uniform)
            chosen = torch.zeros(shape, dtype=torch.long, device=like.device)
            for log_weight in self.log_weights[:-1]:
                total = total + log_weight.exp()
                chosen += uniform > total
            centre, scale = (
                table.expand(-1, *self.batch_shape).gather(0, chosen.reshape(-1, *self.batch_shape)).reshape(shape)
                for table in (self.centres, self.scales)
            )
            return centre + scale * torch.randn(shape, generator=generator, dtype=like.dtype, device=like.device)

    @property
    def mean(self) -> Tensor:
        return self._mean

    @property
    def variance(self) -> Tensor:
        second = (self.log_weights.exp() * (self.centres**2 + self.scales**2)).sum(0)
        return second - self._mean**2
