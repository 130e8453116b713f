"""The distribution that a noise model returns: one observation per pixel, given the signal."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from operator import attrgetter
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from noiseflow.distributions.conventions import answering, in_pieces
from noiseflow.distributions.pixels import PixelBatch, Taking, broadcast_shapes

# Default quadrature. The tails beyond these quantiles contribute 2·10⁻¹⁰·log 10¹⁰ = 5e-9 nats to an entropy. The 13 standard
# deviations between them have 40 panels of four nodes each per standard deviation. At 100 electrons (standard deviation 10),
# this resolves single-electron peaks down to a read noise of 0.15 electrons.
PANELS, _TAIL = 512, 1e-10
_NODES, _WEIGHTS = (each.tolist() for each in np.polynomial.legendre.leggauss(4))
TOGETHER = 1024  # pixels of a piece, whose hundreds of nodes fit the caches
RARE = 30.0  # nats: less likely values do not occur
_REFINEMENTS, _FINER = 3, 33  # for the mode: each refinement divides the interval around the best node by 16


class NoiseDistribution(PixelBatch, Distribution):
    """p(observation | signal), one observation per pixel. ``batch_shape`` is the shape of the signal, ``event_shape`` is ().

    A subclass implements `log_prob`, `log_interval_prob`, `cdf`, `icdf` and `sample`, and `mean` and `variance` if they have a
    closed form. The base class adds the common behaviour: arguments may be numbers or tensors of any real type, half precision
    is computed in single precision, and the result has the type that signal and observation promote to. NaN gives NaN, and an
    infinite observation has log-density −inf. Large inputs are evaluated in pieces of bounded memory.

    Args:
        shape: batch shape, the shape of the signal.
        like: a tensor with the data type and device of the results, usually the signal.
    """

    has_rsample: ClassVar[bool] = True  # type: ignore[misc]
    arg_constraints: ClassVar[dict[str, Any]] = {}
    discrete: ClassVar[bool] = False
    support: Any = constraints.real

    def __init__(self, shape: torch.Size, *, like: Tensor | None = None) -> None:
        super().__init__(shape, torch.Size(), validate_args=False)
        self._set_kind(like)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        answering(cls)

    @abstractmethod
    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density in nats per detector unit; log-probability of the value for a digitised model."""

    @abstractmethod
    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        """log P(low < observation ≤ high), accurate far into both tails; the bounds may be infinite."""

    @abstractmethod
    def cdf(self, value: Tensor) -> Tensor:
        """P(observation ≤ value)."""

    def cdf_below(self, value: Tensor) -> Tensor:
        """P(observation < value); differs from `cdf` only if single values have positive probability."""
        return self.cdf(value)

    def conditional_cdf(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """P(observation < value) and P(observation ≤ value), given the pixels before it where pixels depend on each other."""
        upto = self.cdf(value)
        return upto if type(self).cdf_below is NoiseDistribution.cdf_below else self.cdf_below(value), upto

    def conditional(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`log_prob` and `conditional_cdf`, which may share their computation."""
        return self.log_prob(value), *self.conditional_cdf(value)

    @abstractmethod
    def icdf(self, value: Tensor) -> Tensor:
        """Quantile: the smallest observation whose CDF reaches `value`."""

    @abstractmethod
    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Draw observations, ``(*sample_shape, *batch_shape)``."""

    def rsample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Draw observations that are differentiable (first order) with respect to signal and parameters.

        The derivative keeps the CDF of the draw constant: do/dθ = −(∂F/∂θ)/p (Figurnov et al. 2018, arXiv:1805.08498).

        Raises:
            NotImplementedError: the observations are discrete or wrapped, so that draws have no derivative.
        """
        if not self.has_rsample:
            raise NotImplementedError(
                f"{type(self).__name__}: observations are discrete or wrapped: no derivative; use sample(), or log_prob of draws"
            )
        drawn = self.sample(sample_shape, generator=generator)
        missing, slope = self._place(drawn)
        return drawn - (missing - missing.detach()) / slope.detach()

    def rsample_and_log_prob(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Differentiable draws, see `rsample`, and their log-densities, as a variational objective needs."""
        drawn = self.rsample(sample_shape, generator=generator)
        return drawn, self.log_prob(drawn)

    def _place(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The position of an observation in the distribution and its derivative, for `rsample`."""
        return self.cdf(value), torch.exp(self.log_prob(value))

    def rescaled(self, scale: Tensor, shift: Tensor) -> NoiseDistribution:
        """The distribution of scale·o + shift, before any rounding and clipping. Both broadcast with the batch."""
        return RescaledDistribution(self, scale, shift)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """The smallest and the largest possible observation, which may be infinite."""
        infinity = torch.full((), math.inf, dtype=self.working_dtype, device=self.device)
        return -infinity, infinity

    @property
    @torch.no_grad()
    def mode(self) -> Tensor:
        """The most probable observation, accurate to 1/1000 of the spacing of the quadrature nodes."""
        nodes = torch.sort(self.quadrature()[0], 0).values
        best = self.log_prob(nodes).argmax(0, keepdim=True)
        if self.discrete:
            return self.cast(nodes.gather(0, best)[0])
        low, high = (nodes.gather(0, (best + step).clamp(0, nodes.shape[0] - 1)) for step in (-4, 4))
        fraction = torch.linspace(0, 1, _FINER, dtype=nodes.dtype, device=nodes.device)
        fraction = fraction.view(-1, *(1,) * (nodes.ndim - 1))
        for _ in range(_REFINEMENTS):
            finer = low + (high - low) * fraction
            best = self.log_prob(finer).argmax(0, keepdim=True)
            low, high = (finer.gather(0, (best + step).clamp(0, _FINER - 1)) for step in (-1, 1))
        return self.cast(((low + high) / 2)[0])

    def entropy(self) -> Tensor:
        """Entropy −E[log p], nats, by quadrature: an integral over the density plus a sum over discrete values."""
        return self.cast(in_pieces(lambda part: -part.expectation(part.log_prob), self, size=TOGETHER))

    def expectation(self, function: Callable[[Tensor], Tensor]) -> Tensor:
        """E[function(observation)] by quadrature, shape of the batch; the function takes observations ``(Q, *batch)``."""
        return weighted_sum(function, *self.nodes())

    @property
    def mean(self) -> Tensor:
        """Mean of the observations of each pixel; by quadrature unless a subclass has a closed form."""
        return self.cast(in_pieces(lambda part: part.expectation(lambda value: value), self, size=TOGETHER))

    @property
    def variance(self) -> Tensor:
        """Variance of the observations of each pixel; by quadrature unless a subclass has a closed form."""

        def variance(part: NoiseDistribution) -> Tensor:
            nodes, weights = part.nodes()
            mean = weighted_sum(lambda value: value, nodes, weights)
            return weighted_sum(lambda value: (value - mean) ** 2, nodes, weights)

        return self.cast(in_pieces(variance, self, size=TOGETHER))

    @property
    def stddev(self) -> Tensor:
        """Standard deviation of the observations of each pixel, without gradient graph; a `variance` by a formula has one."""
        with torch.no_grad():
            return self.cast(self.variance.sqrt())

    def nodes(self) -> tuple[Tensor, Tensor]:
        """Nodes and weights of `expectation`: those of `quadrature` unless a subclass takes fewer."""
        return self.quadrature()

    def quadrature(self) -> tuple[Tensor, Tensor]:
        """Nodes and weights ``(Q, *batch)`` for expectations: the Gauss–Legendre rule on panels between extreme quantiles."""
        return self.panels(*self._extremes, PANELS)

    @cached_property
    def _extremes(self) -> tuple[Tensor, Tensor]:
        """Extreme quantiles of each pixel, float64, without gradient; mean and variance need them three times."""
        low = self.icdf(torch.full(self.batch_shape, _TAIL).to(self.anything()))
        high = self.icdf(torch.full(self.batch_shape, 1 - _TAIL, dtype=torch.float64, device=self.device))
        return low.detach().double(), high.detach().double()

    def likely_range(self) -> tuple[Tensor, Tensor]:
        """The values of each pixel, float64, below and above which lie probabilities of at most exp(−`RARE`)."""
        low = torch.full(self.batch_shape, math.exp(-RARE), dtype=torch.float64, device=self.device)
        first, last = self.icdf(torch.stack([low, 1 - low]))
        return first, last

    def panels(self, low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Nodes and weights ``(4·count, *batch)`` of the integral over the density between two bounds."""
        nodes, lengths = panels(low.detach(), high.detach(), count)
        weights = lengths * torch.exp(self.log_prob(nodes))
        return nodes, weights / weights.detach().sum(0).clamp(min=torch.finfo(weights.dtype).tiny)


def of_finite(function: Callable[[Tensor], Tensor], value: Tensor) -> Tensor:
    """An increasing function of values; infinite ones stay as they are, because their gradients would be NaN."""
    finite = torch.isfinite(value)
    return torch.where(finite, function(torch.where(finite, value, torch.zeros_like(value))), value)


def weighted_sum(function: Callable[[Tensor], Tensor], nodes: Tensor, weights: Tensor) -> Tensor:
    """Sum of ``weights · function(nodes)`` over the first axis; nodes without weight do not count."""
    values = function(nodes)  # infinite at impossible observations
    return torch.where(weights > 0, weights * values, torch.zeros_like(weights)).sum(0)


def bisect_quantile(
    cdf: Callable[[Tensor], Tensor], value: Tensor, low: Tensor, high: Tensor, *, num_steps: int = 80
) -> Tensor:
    """Quantile between bounds that bracket it.

    Bisection, with inverse quadratic interpolation where the CDF is smooth (Chandrupatla, doi:10.1016/S0965-9978(96)00051-8).
    """
    with torch.no_grad():
        there, other = (end + torch.zeros_like(value, dtype=end.dtype) for end in (low, high))
        at_there, at_other = -value.to(there), 1 - value.to(there)
        tolerance = 2 * torch.finfo(there.dtype).eps * torch.maximum(there.abs(), other.abs())
        part = torch.full_like(there, 0.5)
        for _ in range(num_steps):
            place = there + part * (other - there)
            at_place = cdf(place).to(place) - value
            kept = (at_place >= 0) == (at_there >= 0)
            last, at_last = torch.where(kept, there, other), torch.where(kept, at_there, at_other)
            other, at_other = torch.where(kept, other, there), torch.where(kept, at_other, at_there)
            there, at_there = place, at_place
            width = (other - there).abs()
            if bool((width <= tolerance).all()):
                break
            gap, rise = (there - other) / (last - other), (at_there - at_other) / (at_last - at_other)
            smooth = (rise**2 < gap) & ((1 - rise) ** 2 < 1 - gap)
            curved = at_there / (at_other - at_there) * at_last / (at_other - at_last)
            more = (last - there) / (other - there) * at_there / (at_last - at_there) * at_other / (at_last - at_other)
            curved = curved + more
            least = (0.5 * tolerance / width).clamp(max=0.5)
            part = torch.where(smooth, curved, torch.full_like(curved, 0.5)).nan_to_num(0.5)
            part = torch.minimum(torch.maximum(part, least), 1 - least)
        return torch.where(at_there >= 0, there, other)


class DistributionAround(NoiseDistribution):
    """A distribution that is computed from another one, and has its traits unless it says otherwise.

    Args:
        shape: batch shape; that of `base` by default.
    """

    def __init__(self, base: NoiseDistribution, shape: torch.Size | None = None) -> None:
        like = torch.empty(0, dtype=base.dtype, device=base.device)
        super().__init__(base.batch_shape if shape is None else shape, like=like)
        self.base = base

    independent, light, discrete, has_rsample = (  # type: ignore[misc]
        property(attrgetter(f"base.{name}")) for name in ("independent", "light", "discrete", "has_rsample")
    )


class MappedDistribution(DistributionAround):
    """The distribution of an increasing function of an observation of `base`."""

    @abstractmethod
    def to_inner(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The observation of the inner distribution, and the logarithm of its derivative."""

    @abstractmethod
    def from_inner(self, inner: Tensor) -> Tensor:
        """The observation, given that of the inner distribution."""

    def _back(self, value: Tensor) -> Tensor:
        return of_finite(lambda each: self.to_inner(each)[0], value)

    def log_prob(self, value: Tensor) -> Tensor:
        inner, ladj = self.to_inner(value)
        return self.base.log_prob(inner) + ladj

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.base.log_interval_prob(self._back(low), self._back(high))

    def cdf(self, value: Tensor) -> Tensor:
        return self.base.cdf(self._back(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self.base.cdf_below(self._back(value))

    def conditional_cdf(self, value: Tensor) -> tuple[Tensor, Tensor]:
        return self.base.conditional_cdf(self._back(value))

    def icdf(self, value: Tensor) -> Tensor:
        return self.from_inner(self.base.icdf(value))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        leading = self.batch_shape[: len(self.batch_shape) - len(self.base.batch_shape)]
        return self.from_inner(self.base.sample((*sample_shape, *leading), generator=generator))

    def quadrature(self) -> tuple[Tensor, Tensor]:
        nodes, weights = self.base.expand(self.batch_shape).quadrature()
        return self.from_inner(nodes), weights

    def nodes(self) -> tuple[Tensor, Tensor]:
        nodes, weights = self.base.expand(self.batch_shape).nodes()
        return self.from_inner(nodes), weights


class RescaledDistribution(MappedDistribution):
    """The distribution of scale·o + shift, o from another noise distribution.

    Args:
        scale, shift: broadcast with the batch of `base`; new axes must be leading axes. The scale is positive.
    """

    def __init__(self, base: NoiseDistribution, scale: Tensor, shift: Tensor) -> None:
        super().__init__(base, broadcast_shapes(base.batch_shape, scale.shape, shift.shape))
        self.scale, self.shift = scale, shift

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        low, high = (end * self.scale.detach() + self.shift.detach() for end in self.base.limits)
        return low, high

    def mapped(self, take: Taking, shape: torch.Size) -> Self:
        own = [each.expand(self.batch_shape) for each in (self.scale, self.shift)]
        base = self.base.expand(self.batch_shape)
        return type(self)(base.mapped(take, shape), *(take(each, ()) for each in own))

    def to_inner(self, value: Tensor) -> tuple[Tensor, Tensor]:
        return (value - self.shift) / self.scale, -torch.log(self.scale)

    def from_inner(self, inner: Tensor) -> Tensor:
        return inner * self.scale + self.shift

    @property
    def mean(self) -> Tensor:
        return self.base.mean * self.scale + self.shift

    @property
    def variance(self) -> Tensor:
        return self.base.variance * self.scale**2 + torch.zeros_like(self.shift)


def panels(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Gauss–Legendre nodes and weights (4·count, *shape) on equal panels between two bounds of any shape."""
    ones = (1,) * low.ndim
    start = torch.arange(count, dtype=low.dtype, device=low.device).view(-1, 1, *ones)
    places = low.new_tensor(_NODES).view(1, -1, *ones)
    fraction = ((start + (places + 1) / 2) / count).flatten(0, 1)
    weight = (low.new_tensor(_WEIGHTS) / (2 * count)).repeat(count).view(-1, *ones)
    return low + (high - low) * fraction, weight * (high - low)
