"""Known noises that noise models are judged on, and the clean image that they are put on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, constraints

import noiseflow
from noiseflow.distributions.laws.textbook import GaussianDistribution

SIDE = 512
_ONE = torch.Size()


@dataclass(frozen=True)
class Noise:
    """A known noise.

    Args:
        title: what it is.
        model: the noise model that makes it.
        signals: range of the clean image, detector units.
    """

    title: str
    model: nn.Module
    signals: tuple[float, float] = (0.0, 1.0)


class Truth(nn.Module):
    """Known noise: `shape` is a torch distribution of standardised noise, scaled by `scale(signal)` around the signal."""

    def __init__(self, shape: Distribution, scale: Callable[[Tensor], Tensor], mean: float = 0.0) -> None:
        super().__init__()
        self.shape, self.scale, self.mean = shape, scale, mean

    def forward(self, signal: Tensor) -> TruthDistribution:
        return TruthDistribution(self, signal)


class TruthDistribution(Distribution):
    support = constraints.real
    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(self, truth: Truth, signal: Tensor) -> None:
        super().__init__(signal.shape, validate_args=False)
        self.truth, self.signal, self.scale = truth, signal, truth.scale(signal)

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return self.scale**2 * self.truth.shape.variance

    def log_prob(self, value: Tensor) -> Tensor:
        standard = (value - self.signal) / self.scale + self.truth.mean
        inside = self.truth.shape.support.check(standard)
        safe = torch.where(inside, standard, torch.ones_like(standard))
        density = self.truth.shape.log_prob(safe) - torch.log(self.scale)
        return torch.where(inside, density, torch.full_like(density, -torch.inf))

    def sample(self, sample_shape: torch.Size = _ONE, generator: torch.Generator | None = None) -> Tensor:
        with torch.random.fork_rng(devices=[], enabled=generator is not None):
            if generator is not None:
                torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
            standard = self.truth.shape.sample(sample_shape + self.signal.shape) - self.truth.mean
            return self.signal + self.scale * standard


class UnevenGaussian(GaussianDistribution):
    """A Gaussian whose width differs between pixels."""

    per_pixel = ("signal", "log_scale")


class Analytic(nn.Module):
    """Gaussian noise of given signal dependence, as a noise model."""

    def __init__(self, scale: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, signal: Tensor) -> UnevenGaussian:
        return UnevenGaussian(signal, torch.log(self.scale(signal)))


def growing(signal: Tensor) -> Tensor:
    """A standard deviation that grows like shot noise over read noise."""
    return torch.sqrt(0.03**2 + 0.07**2 * signal)


def noises() -> dict[str, Noise]:
    """Every known noise by the name that the command line takes."""
    normal = torch.distributions.Normal(0.0, 1.0)
    outliers = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(torch.tensor([0.99, 0.01])),
        torch.distributions.Normal(torch.zeros(2), torch.tensor([1.0, 10.0])),
    )
    found = {
        "gaussian": Noise("Gaussian", Truth(normal, lambda s: torch.full_like(s, 0.1))),
        "signal-dependent": Noise("signal-dependent Gaussian", Truth(normal, growing)),
        "student-t": Noise("Student-t (3)", Truth(torch.distributions.StudentT(3.0), lambda s: 0.6 * growing(s))),
        "gamma": Noise("gamma-skewed", Truth(torch.distributions.Gamma(4.0, 2.0), growing, mean=2.0)),
        "outliers": Noise("1 % outliers, 10 × wider", Truth(outliers, growing)),
        "clipped": Noise("clipped to [0, 1]", noiseflow.Digitised(Analytic(growing), step=0.0, low=0.0, high=1.0)),
        "8-bit": Noise("8-bit rounded", noiseflow.Digitised(Analytic(growing), step=1 / 255, low=0.0, high=1.0)),
    }
    for rate in (0.5, 3.0, 50.0):
        for read_noise in (0.2, 0.5):
            model = noiseflow.PoissonGaussian(gain=1.0, offset=0.0, read_noise=read_noise)
            title = f"Poisson–Gaussian, λ = {rate:g}, read noise {read_noise:g}"
            found[f"electrons-{rate:g}-{read_noise:g}"] = Noise(title, model, (0.5 * rate, 1.5 * rate))
    return found


def clean_image(low: float, high: float, size: int = SIDE) -> Tensor:
    """A smooth field of all signal levels, (size, size); sizes that divide 512 take every so many of its pixels."""
    x = torch.linspace(0, 1, SIDE)
    field = 0.5 + 0.25 * (torch.sin(7 * x[None, :] + 2 * x[:, None]) + torch.cos(11 * x[:, None] * x[None, :]))
    return low + (high - low) * field[:: SIDE // size, :: SIDE // size].contiguous()
