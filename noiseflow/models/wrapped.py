"""Values that start again at the end of a period, such as phases, orientations and hues."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.noise_distribution import DistributionAround, NoiseDistribution, bisect_quantile
from noiseflow.distributions.pixels import Signal, values_of
from noiseflow.models.digitisation import FEWEST
from noiseflow.models.wrapper import DensityAround


class Wrapped(DensityAround):
    """A noise model of values that start again at the end of a period, such as phases in [−π, π).

    An observation has the probability of all values whole periods from it under the inner model; signals may be unwrapped.

    Args:
        model: the noise model before wrapping, of single pixels with a density.
        start, period: the lowest value, and how far above it the values start again, detector units.

    Raises:
        ValueError: the period is not positive, or the inner model needs images or has discrete values.

    Example:
        >>> import noiseflow, torch
        >>> phase = noiseflow.Wrapped(noiseflow.Gaussian(0.4))
        >>> share = phase(torch.tensor(3.0)).cdf(torch.tensor(0.0))  # beyond π, values continue at −π
        >>> round(share.item(), 2)
        0.36
    """

    settings = ("start", "period")

    def __init__(self, model: nn.Module, start: float = -math.pi, period: float = 2 * math.pi) -> None:
        super().__init__(model)
        check(start=start, period=period)
        self.start, self.period = float(start), float(period)

    def forward(self, signal: Signal) -> WrappedDistribution:
        return WrappedDistribution(self.model(values_of(signal)), self.start, self.period, values_of(signal))

    def inside(self, signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The observation before wrapping if it was within half a period of the signal, and 0."""
        behind = signal.double() - self.period / 2
        return behind + torch.remainder(observation.double() - behind, self.period), torch.zeros_like(behind)

    def standardise(self, signal: Signal, observation: Tensor, **options: Any) -> None:
        """Standardise the inner model on (N,) values before wrapping."""
        nearest = self.inside(values_of(signal), observation)[0].to(observation)
        self.scale.set_from(values_of(signal), nearest)
        self.model.standardise(values_of(signal), nearest, **options)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels from their `fixed_part`."""
        found: Tensor = self(signal).log_prob(fixed_part[:, 1])
        return found.to(signal.dtype)


class WrappedDistribution(DistributionAround):
    """The distribution of values of `base` wrapped into a period. As under a von Mises law in torch, values beyond its ends have
    the log-density of those that they are wrapped to."""

    per_pixel = ("_turn",)
    has_rsample = False  # type: ignore[misc]

    def __init__(self, base: NoiseDistribution, start: float, period: float, signal: Tensor) -> None:
        super().__init__(base)
        self._start, self._period = start, period
        self._turn = torch.floor((self.clean(signal).detach() - start) / period)

    def _wrapped(self, value: Tensor) -> Tensor:
        return (self._start + torch.remainder(value.double() - self._start, self._period)).to(value)

    def _turned(self, value: Tensor, most: int = 2) -> Tensor:
        """(5, *shape) values around the signal, whole periods from those given, or from the end of the period beyond which these
        are. Of normal noise with a standard deviation of half a period, even to 1.5 % when it is wrapped, 6e-5 lie farther."""
        turns = torch.arange(-most, most + 1, device=value.device).view(-1, *(1,) * value.ndim) + self._turn
        return value.clamp(self._start, self._start + self._period) + self._period * turns

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.logsumexp(self.base.log_prob(self._turned(self._wrapped(value))), 0)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return torch.logsumexp(self.base.log_interval_prob(self._turned(low), self._turned(high)), 0)

    def cdf(self, value: Tensor) -> Tensor:
        starts = self._turned(torch.full_like(value, self._start))
        return (self.base.cdf(self._turned(value)) - self.base.cdf(starts)).sum(0).clamp(0, 1)

    def icdf(self, value: Tensor) -> Tensor:
        return bisect_quantile(self.cdf, value, *self.limits)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        return self._wrapped(self.base.sample(sample_shape, generator=generator))

    def quadrature(self) -> tuple[Tensor, Tensor]:
        nodes = self.base.quadrature()[0].detach().sort(0).values  # as dense as the inner noise needs
        jumps = self._turned(torch.full_like(nodes[0], self._start)).clamp(nodes[0], nodes[-1])
        edges = torch.cat([nodes[::4], nodes[-1:], jumps]).sort(0).values
        nodes, weights = self.base.panels(edges[:-1], edges[1:], 1)
        mass = torch.exp(self.base.log_interval_prob(edges[:-1], edges[1:])).detach()
        return self._wrapped(nodes).flatten(0, 1), (mass * weights).flatten(0, 1)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        return self.anything() + self._start, self.anything() + self._start + self._period


def wrapping(signal: Tensor, observation: Tensor, step: float = 0.0) -> tuple[float, float] | None:
    """Start and period of (N,) observations that start again at the end of a period; None if they do not. Half of the pixels just
    above the lowest and just below the highest value then come from beyond the end, whatever the signals are. They, like all
    pixels, are near their signal if values a period apart are the same: the mean cosine of the deviation is half of that of noise
    which wrapping makes even to a half. The pixels are within the median deviation from an end, or 1/64 of the range of values,
    in which the density hardly changes; that half of the fewest has an error of 0.11."""
    low, high = (float(each) for each in observation.aminmax())
    away = observation.double() - signal.double()
    near = min((high - low) / 64, float(away.abs().median())) + step
    ends = away[(observation < low + near) | (observation > high - near)]
    period = high - low + max(step, 2 * near / max(ends.numel(), 1), 1e-30)
    jumped = (ends.abs() > period / 2).double().mean()
    cosine = min(float(torch.cos(2 * math.pi / period * each).mean()) for each in (away, ends))
    if ends.numel() < 2 * FEWEST or 2 * abs(float(jumped) - 0.5) > 0.5 or 2 * cosine < 0.5:
        return None
    return (low + high - period) / 2, period
