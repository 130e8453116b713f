"""Known noise models without trainable parameters, for simulation and as ground truth for learnt noise models."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.numerics.normal import normal_quadrature
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.mixture import NormalMixture


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

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self.scale**2


class OutlierNoise(NormalMixture):
    """Gaussian noise with a share of outliers with larger standard deviation.

    Args:
        floor, slope: standard deviation at zero signal, and its increase per unit signal.
        factor: ratio of the standard deviations.
    """

    tabulate = False  # the truth is exact

    def __init__(self, floor: float = 0.05, slope: float = 0.1, share: float = 0.05, factor: float = 8.0) -> None:
        super().__init__()
        self.floor, self.slope, self.share, self.factor = floor, slope, share, factor

    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        log_weight = torch.tensor([1 - self.share, self.share]).log().to(signal).expand(*signal.shape, 2)
        scale = self.floor + self.slope * signal.clamp_min(0)
        return log_weight, signal[..., None].expand_as(log_weight), torch.stack([scale, self.factor * scale], -1).log()


class CountingNoise(NormalMixture):
    """Poisson counts plus Gaussian read noise, one count per detector unit; only read noise for signals below zero.

    Args:
        read_noise: electrons rms.
        most: count at which the Poisson sum is truncated.
    """

    tabulate = False  # the truth is exact

    def __init__(self, read_noise: float = 0.5, most: int = 40) -> None:
        super().__init__()
        self.read_noise, self.most = read_noise, most

    def components_at(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        counts = torch.arange(self.most + 1, dtype=signal.dtype, device=signal.device)
        signal = signal[..., None]
        rate = signal.clamp_min(1e-4)  # keeps likelihoods finite for a vanishing signal
        log_weight = counts * torch.log(rate) - rate - torch.lgamma(counts + 1)
        return log_weight, counts + (signal - rate), torch.full_like(log_weight, self.read_noise).log()
