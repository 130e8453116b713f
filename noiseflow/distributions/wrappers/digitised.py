"""The distribution of rounded and clipped observations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from noiseflow.distributions.laws.base import NEAR, ROUNDINGS, DiscreteLevels, near_level
from noiseflow.distributions.noise_distribution import DistributionAround
from noiseflow.distributions.pixels import is_traced
from noiseflow.distributions.wrappers.numerical import MOST_LEVELS, as_noise_distribution

# The edge of a cell may be rounded by 1/64 of the step, an error of at most 0.03 nats; and levels are taken together in groups
# 1/64 as wide as they are far from the median, which changes variances by less than 3e-4.
_SHARE = 64


class Converter(Protocol):
    """An analogue-to-digital converter: rounds to steps from an origin and clips at two limits, detector units."""

    step: float
    low: float
    high: float
    origin: float


class DigitisedDistribution(DistributionAround):
    """A rounded and clipped distribution.

    ``log_prob`` is a log-probability at the clipping limits and, if the step is positive, at every level. With ``step = 0``,
    observations between the limits have a log-density. A value between two levels gets the probability of a cell centred on it.
    A value beyond a limit by more than half a step is impossible (−inf).

    Args:
        detector: the step and the clipping limits; a module if large inputs may be tabulated.
        base: distribution before the converter: any torch distribution of one number per pixel.
        signal: the signal, for tables of large inputs; None to use no tables.
    """

    per_pixel = ("_signal",)

    def __init__(self, detector: Converter, base: Any, signal: Tensor | None = None) -> None:
        super().__init__(as_noise_distribution(base))
        self.step, self.low, self.high = detector.step, detector.low, detector.high
        self._origin = detector.low if math.isfinite(detector.low) else detector.origin  # one of the levels
        self._top = self.high - NEAR * self.step  # counts as the high limit, which another data type may have rounded
        self._detector, self._signal = detector, signal

    def widened(self, value: Tensor, dtype: torch.dtype) -> Tensor:
        """Convert an observation to a wider data type; a value equal to a limit in its own type stays equal to it."""
        wider = value.to(dtype)
        if wider.dtype == value.dtype:
            return wider
        for limit in (self.low, self.high):
            wider = torch.where(value == limit, limit, wider)
        return wider

    @property
    def source(self) -> tuple[nn.Module, Tensor] | None:
        """The detector and the signal."""
        if self._signal is None or not isinstance(self._detector, nn.Module):
            return None
        return self._detector, self._signal

    @property
    def discrete(self) -> bool:  # type: ignore[override]
        """Whether every observation has a probability rather than a density."""
        return self.step > 0 or self.base.discrete

    @property
    def has_rsample(self) -> bool:  # type: ignore[override]
        """Whether draws are differentiable: only if they are clipped and not rounded."""
        return self.step == 0 and self.base.has_rsample

    def rescaled(self, scale: Tensor, shift: Tensor) -> DigitisedDistribution:
        return DigitisedDistribution(self._detector, self.base.rescaled(scale, shift))

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> DigitisedDistribution:
        """The same for a larger batch."""
        signal = None if self._signal is None else self._signal.expand(torch.Size(batch_shape))
        return DigitisedDistribution(self._detector, self.base.expand(batch_shape), signal)

    @property
    def edges(self) -> tuple[float, float]:
        """The values before digitisation below which all are clipped to the low limit, and above which to the high one."""
        if self.step == 0:
            return self.low, self.high
        steps = (self.high - self._origin) / self.step
        # if the high limit lies between two levels, only values that round to the level above it are clipped
        last = math.ceil(steps - NEAR) - 1 if math.isfinite(steps) else steps
        return self.low + self.step / 2, self._origin + (last + 0.5) * self.step

    def log_prob(self, value: Tensor) -> Tensor:
        value = self._fine(value)
        on_low, on_high, possible = self._places(value)
        inside = value.clamp(self.low, self.high)  # values beyond a limit are not used and must not affect the gradient
        if self.step > 0:
            found = self.base.log_interval_prob(*self._cell(inside, on_low, on_high))
        else:
            found = self._clipped(inside, on_low, on_high)
        return torch.where(possible, found, torch.full_like(found, -math.inf))

    def represents(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The ends of the interval before a converter with a positive step that each value stands for."""
        value = self._fine(value)
        on_low, on_high, _ = self._places(value)
        return self._cell(value.clamp(self.low, self.high), on_low, on_high)

    def _cell(self, inside: Tensor, on_low: Tensor, on_high: Tensor) -> tuple[Tensor, Tensor]:
        half = self.step / 2
        below, above = (edge if math.isfinite(edge) else 0.0 for edge in self.edges)
        low = torch.where(on_low, -math.inf, torch.where(on_high, above, inside - half))
        return low, torch.where(on_high, math.inf, torch.where(on_low, below, inside + half))

    def _clipped(self, inside: Tensor, on_low: Tensor, on_high: Tensor) -> Tensor:
        result = self.base.log_prob(inside)
        if inside.shape == self.batch_shape and self.base.independent and self.base.splits and not is_traced(inside):
            place = torch.nonzero((on_low | on_high).reshape(-1)).squeeze(1)
            base = self.base.mapped(lambda each, rest: each.reshape(-1, *rest)[place], torch.Size([place.numel()]))
            below, ends = on_low.reshape(-1)[place], inside.new_tensor([-math.inf, self.low, self.high, math.inf])
            mass = base.log_interval_prob(torch.where(below, ends[0], ends[2]), torch.where(below, ends[1], ends[3]))
            return result.reshape(-1).index_put((place,), mass.to(result)).reshape(self.batch_shape)
        if inside.shape == self.batch_shape and math.isfinite(self.low) and math.isfinite(self.high):
            # the other limit may be so far in a tail that the logarithm of its probability has no gradient
            low = torch.where(on_low, -math.inf, torch.full_like(inside, self.high))
            high = torch.where(on_low, self.low, torch.full_like(inside, math.inf))
            return torch.where(on_low | on_high, self.base.log_interval_prob(low, high), result)
        # the probability of a limit depends on the signal alone: it has the batch shape, not that of the values
        nothing = torch.zeros(self.batch_shape, dtype=inside.dtype, device=inside.device)
        for clipped, first, last in ((on_low, -math.inf, self.low), (on_high, self.high, math.inf)):
            if first < last:  # unless it is infinite
                result = torch.where(clipped, self.base.log_interval_prob(nothing + first, nothing + last), result)
        return result

    def _places(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Whether values are at the low limit, at the high limit, and possible at all."""
        rounding = ROUNDINGS * torch.finfo(value.dtype).eps
        slack = [max(self.step / 2, rounding * abs(limit)) for limit in (self.low, self.high)]
        possible = (value >= self.low - slack[0]) & (value <= self.high + slack[1])
        return value <= self.low + rounding * abs(self.low) * math.isfinite(self.low), value >= self._top, possible

    def _fine(self, value: Tensor) -> Tensor:
        """Values in double precision if single precision would shift the edges of their cells."""
        exact = self.step == 0 or value.dtype == torch.float64 or not value.numel()
        if not exact and not is_traced(value):
            exact = torch.finfo(value.dtype).eps * float(value.detach().abs().max()) * _SHARE <= self.step
        return value if exact else self.widened(value, torch.float64)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.base.log_interval_prob(self._edge(low), self._edge(high))

    def cdf(self, value: Tensor) -> Tensor:
        return self.base.cdf(self._edge(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        edge = self._level(self._fine(value), torch.ceil) - self.step / 2 if self.step > 0 else value
        edge = torch.where(value <= self.low, -math.inf, edge)
        return self.base.cdf_below(torch.where(value > self.high, math.inf, edge))

    def _edge(self, value: Tensor) -> Tensor:
        """The value before digitisation below which every value is digitised to at most `value`."""
        finite = torch.isfinite(value)
        safe = self._fine(torch.where(finite, value, torch.zeros_like(value)))
        edge = self._level(safe, torch.floor) + self.step / 2 if self.step > 0 else safe
        edge = torch.where(value < self.low, -math.inf, torch.where(finite, edge, value))
        return torch.where(value >= self._top, math.inf, edge)

    def _level(self, value: Tensor, rounding: Callable[[Tensor], Tensor]) -> Tensor:
        steps = (value - self._origin) / self.step
        nearest = torch.round(steps)
        # rounding errors must not move a level to its neighbour
        return self._origin + self.step * torch.where((steps - nearest).abs() < NEAR, nearest, rounding(steps))

    def digitise(self, value: Tensor) -> Tensor:
        """Round and clip values; as in `cdf`, half a step is rounded down, and what is nearly the high limit is the limit."""
        if self.step == 0:
            return value.clamp(self.low, self.high)
        tie = near_level(value, self._origin, self.step) if self.base.discrete else 0.0
        rounded = self._level(value, lambda steps: torch.ceil(steps - 0.5 - tie)).clamp(self.low, self.high)
        return torch.where(rounded >= self._top, self.high, rounded)

    def icdf(self, value: Tensor) -> Tensor:
        return self.digitise(self.base.icdf(value))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        return self.digitise(self.base.sample(sample_shape, generator=generator))

    def rsample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Differentiable draws of a distribution that is clipped and not rounded; see `NoiseDistribution.rsample`."""
        draw = self.base.rsample if self.has_rsample else super().rsample
        return self.digitise(draw(sample_shape, generator))

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """The clipping limits, or the limits of the base distribution if they are narrower."""
        low, high = self.base.limits
        return self.digitise(low), self.digitise(high)

    @property
    def support(self) -> constraints.Constraint:
        """The levels; without rounding, all values between the limits."""
        levels = DiscreteLevels(self.step, self._origin, self.low, self.high)
        return levels if self.step > 0 else constraints.interval(self.low, self.high)  # type: ignore[no-untyped-call]

    def quadrature(self) -> tuple[Tensor, Tensor]:
        if self.step == 0:
            nodes, weights = self.base.quadrature()
            return self.digitise(nodes), weights
        first, last = self._likely_levels
        count = int(((last - first) / self.step).ceil().max()) + 1 if first.numel() else 1
        if count > MOST_LEVELS:
            raise ValueError(f"some pixels have {count} likely levels, more than {MOST_LEVELS}; use a coarser step")
        steps = torch.arange(count, dtype=first.dtype, device=first.device).view(-1, *(1,) * first.ndim)
        nodes = torch.minimum(first + steps * self.step, last)
        once = torch.cat([torch.ones_like(nodes[:1], dtype=torch.bool), nodes[1:] > nodes[:-1]])
        return nodes, torch.where(once, torch.exp(self.log_prob(nodes)), torch.zeros_like(nodes))

    def nodes(self) -> tuple[Tensor, Tensor]:
        """As for any noise, but of thousands of levels, as heavy tails have, those far from the median are taken together."""
        return self.quadrature() if self.step == 0 else self._groups() if torch.is_grad_enabled() else self._kept_groups

    @cached_property
    def _likely_levels(self) -> tuple[Tensor, Tensor]:
        """The lowest and the highest likely level of each pixel, float64."""
        first, last = self.base.likely_range()
        return self.digitise(first), self.digitise(last)

    _kept_groups = cached_property(lambda self: self._groups())  # without a gradient: mean and variance need them each

    def _groups(self) -> tuple[Tensor, Tensor]:
        """Middles and probabilities of groups of levels; the 64 on each side of the median stand alone."""
        first, last = self._likely_levels
        middle = self._level(self.base.icdf(torch.full_like(first, 0.5)), torch.round)
        reach = torch.maximum(last - middle, middle - first) / self.step
        ends, farthest = [0.5], float(reach.detach().max()) if first.numel() else 0.0
        while ends[-1] < farthest:
            ends.append(ends[-1] + max(1, ends[-1] // _SHARE))
        beyond = torch.tensor(ends, dtype=first.dtype, device=first.device).view(-1, *(1,) * first.ndim)
        inner = (middle + self.step * torch.cat([-beyond.flip(0), beyond])).clamp(*self.edges)
        infinity = torch.full_like(first[None], math.inf)
        edges = torch.cat([-infinity, inner, infinity])
        nodes = torch.cat([first[None], (inner[1:] + inner[:-1]) / 2, last[None]])
        return nodes, self.base.log_interval_prob(edges[:-1], edges[1:]).exp()
