"""Values that start again at the end of a period, such as phases, orientations and hues."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from noiseflow.arguments import check
from noiseflow.distributions.image_pixels import Signal, values_of
from noiseflow.distributions.noise_distribution import DistributionAround, NoiseDistribution, bisect_quantile
from noiseflow.models.standardisation import Standardisation
from noiseflow.models.wrapper import ModelAround

# Turns added to an observation, to each side. Of normal noise with a standard deviation of half a period, which is even to 1.5 %
# when it is wrapped, 6e-5 lie beyond.
_TURNS = 2
# Pixels beside the lowest and the highest value: within the median deviation, but at most this share of the range of values, in
# which the density of wrapped noise hardly changes; and the fewest of these pixels, whose share beyond the end is known to 0.11.
_BESIDE, _FEWEST = 1 / 64, 20
# Mean cosine of the deviation, in turns: that of noise which wrapping makes even to a half.
_LEAST_COSINE = 0.25


class Wrapped(ModelAround):
    """A noise model of values that start again at the end of a period, such as phases in [−π, π).

    An observation o has the probabilities of all values o + k·period under the inner model; signals lie within the period.

    Args:
        model: the noise model before wrapping, of single pixels with a density.
        start: the lowest value, detector units.
        period: the highest value is `start` + `period`.

    Raises:
        ValueError: the period is not positive, or the inner model needs images or has discrete values.

    Example:
        >>> import math, noiseflow, torch
        >>> phase = noiseflow.Wrapped(noiseflow.Gaussian(0.4))
        >>> share = phase(torch.tensor(3.0)).cdf(torch.tensor(0.0))  # beyond π, values continue at −π
        >>> round(share.item(), 2)
        0.36
    """

    def __init__(self, model: nn.Module, start: float = -math.pi, period: float = 2 * math.pi) -> None:
        super().__init__(model)
        check(start=start, period=period)
        if self.model.describes_single_readings or self.model.needs_image:
            raise ValueError(
                f"{type(self.model).__name__} is no model of single pixels with a density; put it around Wrapped instead"
            )
        self.start, self.period = float(start), float(period)
        self.scale = Standardisation()

    def forward(self, signal: Signal) -> WrappedDistribution:
        return WrappedDistribution(self.model(values_of(signal)), self.start, self.period)

    def _nearest(self, signal: Tensor, observation: Tensor) -> Tensor:
        """The observation before wrapping if it was within half a period of the signal."""
        half = self.period / 2
        return signal - half + torch.remainder(observation.double() - signal + half, self.period).to(observation)

    def standardise(self, signal: Signal, observation: Tensor, **options: Any) -> None:
        """Standardise the inner model on (N,) values before wrapping."""
        signal = values_of(signal)
        nearest = self._nearest(signal, observation)
        self.scale.set_from(signal, nearest)
        self.model.standardise(signal, nearest, **options)

    @torch.no_grad()
    def fixed_part(self, signal: Tensor, observation: Tensor, upto: Tensor | None = None) -> Tensor | None:
        """The value before wrapping, in standard deviations and as is; None for intervals."""
        if upto is not None:
            return None
        nearest = self._nearest(signal, observation)
        location, log_scale = self.scale(self.scale.coordinate(signal.double()))
        return torch.stack([(nearest.double() - signal - location) * torch.exp(-log_scale), nearest.double()], -1)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels from their `fixed_part`."""
        found: Tensor = self(signal).log_prob(fixed_part[:, 1])
        return found.to(signal.dtype)

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this model, without the inner model."""
        return {"start": self.start, "period": self.period}

    def extra_repr(self) -> str:
        return f"start={self.start:.5g}, period={self.period:.5g}"


class WrappedDistribution(DistributionAround):
    """The distribution of values of `base` that are wrapped into a period. As that of a von Mises law in torch, the log-density
    of values beyond the ends is that of the same angle."""

    per_pixel = ()
    has_rsample = False  # type: ignore[misc]

    def __init__(self, base: NoiseDistribution, start: float, period: float) -> None:
        super().__init__(base)
        self._start, self._end = start, start + period

    def wrapped(self, value: Tensor) -> Tensor:
        """Values within the period that are whole periods from those given."""
        return (self._start + torch.remainder(value.double() - self._start, self._end - self._start)).to(value)

    def _turned(self, value: Tensor) -> Tensor:
        """(5, *shape) values, whole periods apart."""
        turns = torch.arange(-_TURNS, _TURNS + 1, device=value.device).view(-1, *(1,) * value.ndim)
        return value.clamp(self._start, self._end) + (self._end - self._start) * turns

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.logsumexp(self.base.log_prob(self._turned(self.wrapped(value))), 0)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return torch.logsumexp(self.base.log_interval_prob(self._turned(low), self._turned(high)), 0)

    def cdf(self, value: Tensor) -> Tensor:
        starts = self._turned(torch.full_like(value, self._start))
        return (self.base.cdf(self._turned(value)) - self.base.cdf(starts)).sum(0).clamp(0, 1)

    def icdf(self, value: Tensor) -> Tensor:
        low, high = self.limits
        return bisect_quantile(self.cdf, value, low, high)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        return self.wrapped(self.base.sample(sample_shape, generator=generator))

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        return self.anything() + self._start, self.anything() + self._end

    @property
    def support(self) -> constraints.Constraint:
        """The period."""
        return constraints.interval(*self.limits)  # type: ignore[no-untyped-call]


def wrapping(signal: Tensor, observation: Tensor, step: float = 0.0) -> tuple[float, float] | None:
    """Start and period of (N,) observations that start again at the end of a period; None if they do not.

    Half of the pixels just above the lowest and just below the highest value then come from beyond the end, whatever the
    signals are, and they, like all pixels, are near their signal if values a period apart are the same.
    """
    low, high = (float(each) for each in observation.aminmax())
    away = observation.double() - signal.double()
    near = min(_BESIDE * (high - low), float(away.abs().median())) + step
    ends = away[(observation < low + near) | (observation > high - near)]
    period = high - low + max(step, 2 * near / max(ends.numel(), 1))
    jumped = float((ends.abs() > period / 2).double().mean()) if ends.numel() >= _FEWEST else 0
    cosine = min(float(torch.cos(2 * math.pi / period * each).mean()) for each in (away, ends))
    return None if abs(jumped - 0.5) > 0.25 or cosine < _LEAST_COSINE else ((low + high - period) / 2, period)
