"""Wraps any univariate torch distribution as a noise distribution; missing methods are computed by quadrature."""

import copy
import math
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints, register_kl

from noiseflow.distributions.laws.base import between, log_sum
from noiseflow.distributions.noise_distribution import PANELS, NoiseDistribution, bisect_quantile, panels
from noiseflow.distributions.pixels import is_traced

# ends of a scale that is linear within one standard deviation and logarithmic beyond: sinh(12) = 81 000 of them
_REACH = 12.0
_FAR, MOST_LEVELS = 40, 2**16  # integers within 40 standard deviations are summed, at most 2**16 of them


def as_noise_distribution(distribution: Any, *, like: Tensor | None = None) -> NoiseDistribution:
    """Return a noise distribution unchanged; wrap a torch distribution so that CDF, quantiles and intervals are available.

    Args:
        like: the signal, whose data type the results of a torch distribution take; by default that of its mean.

    Raises:
        TypeError: the argument is not a distribution.
        ValueError: an event is more than one number.
    """
    if isinstance(distribution, NoiseDistribution):
        return distribution
    if not isinstance(distribution, Distribution):
        raise TypeError(
            f"a noise model returned {type(distribution).__name__}; return a torch Distribution of one number per pixel"
        )
    if distribution.event_shape:
        raise ValueError(
            f"{type(distribution).__name__} has events of shape {tuple(distribution.event_shape)}; a noise model needs one "
            "number per pixel: do not wrap it in Independent"
        )
    return NumericalDistribution(distribution, like=like)


def _unchecked(distribution: Distribution) -> Distribution:
    """A copy that does not raise outside its support; results there are not used."""
    other = copy.copy(distribution)
    other._validate_args = False
    if isinstance(getattr(other, "base_dist", None), Distribution):
        other.base_dist = _unchecked(other.base_dist)  # type: ignore[attr-defined]
    return other


class NumericalDistribution(NoiseDistribution):
    """A torch distribution with CDF, quantiles and interval probabilities, by Gauss–Legendre quadrature if it has none.

    `error` is an estimate of the error of the CDF. Densities should be smooth on the scale of a third of a standard deviation.

    Args:
        base: one number per pixel, continuous or integer.
        like: a tensor with the data type and device of the results; by default the mean.
    """

    independent = False  # an arbitrary torch distribution cannot be split into pixels

    def __init__(self, base: Distribution, *, like: Tensor | None = None) -> None:
        kind = base.mean if like is None else like
        super().__init__(base.batch_shape, like=kind if kind.is_floating_point() else None)
        self.base = _unchecked(base)
        self._known_mean, self._known_variance = self._moments(base)
        self._spread = torch.sqrt(self._known_variance.detach()).clamp(min=torch.finfo(self._known_mean.dtype).tiny)

    @staticmethod
    def _moments(base: Distribution) -> tuple[Tensor, Tensor]:
        """Mean and variance; location and squared scale if these do not exist, as for a Cauchy distribution."""
        mean, variance = base.mean, base.variance
        known = torch.isfinite(mean) & torch.isfinite(variance)
        if not is_traced(known) and bool(known.all()):
            return mean, variance
        loc, scale = getattr(base, "loc", None), getattr(base, "scale", None)
        if loc is None or scale is None:
            if is_traced(known):
                return mean, variance
            raise ValueError(
                f"{type(base).__name__} has no finite mean and variance, so its quadrature cannot be placed; add the attributes "
                "loc and scale to it"
            )
        return torch.where(known, mean, loc), torch.where(known, variance, scale**2)

    @property
    def discrete(self) -> bool:  # type: ignore[override]
        """Whether observations are integers."""
        return bool(self.support.is_discrete)

    @property
    def has_rsample(self) -> bool:  # type: ignore[override]
        """Whether draws are differentiable."""
        return not self.discrete

    @property
    def support(self) -> constraints.Constraint:
        found: Any = self.base.support
        return constraints.real if found is None else found

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """The bounds of the support, which may be infinite."""
        inner: Any = self.support
        if isinstance(inner, constraints.independent):
            inner = inner.base_constraint
        like = self._known_mean.detach()
        low, high = (
            torch.as_tensor(getattr(inner, name, limit)).to(like)
            for name, limit in (("lower_bound", -math.inf), ("upper_bound", math.inf))
        )
        return low, high

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Self:
        kind = torch.empty(0, dtype=self._given_dtype, device=self._given_device)
        return type(self)(self.base.expand(torch.Size(batch_shape)), like=kind)

    def log_prob(self, value: Tensor) -> Tensor:
        if self.discrete:
            return self.log_masses(value)
        low, high = self.limits
        possible = (value >= low) & (value <= high)
        found: Tensor = self.base.log_prob(torch.where(possible, value, self._known_mean.detach()))
        return torch.where(possible, found, torch.full_like(found, -math.inf))

    def log_masses(self, count: Tensor) -> Tensor:
        """Log-probabilities of integers; −inf outside the support."""
        low, high = self.limits
        possible = (count >= low) & (count <= high) & (count == torch.round(count))
        safe = torch.where(torch.isfinite(low), low, torch.zeros_like(low))
        found: Tensor = self.base.log_prob(torch.where(possible, count, safe))
        return torch.where(possible, found, torch.full_like(found, -math.inf))

    def cdf(self, value: Tensor) -> Tensor:
        if self.discrete:
            return self.masses_up_to(torch.floor(value), beyond=False)
        try:
            low, high = self.limits
            found: Tensor = self.base.cdf(torch.minimum(torch.maximum(value, low), high))
            return torch.where(value < low, torch.zeros_like(found), found)
        except NotImplementedError:
            return torch.exp(self._log_integral(torch.full_like(value, -math.inf), value)).clamp(max=1)

    def cdf_below(self, value: Tensor) -> Tensor:
        return self.masses_up_to(torch.ceil(value) - 1, beyond=False) if self.discrete else self.cdf(value)

    def masses_up_to(self, count: Tensor, *, beyond: bool) -> Tensor:
        """P(k ≤ count), or P(k > count) if `beyond`, by summation; the count may be infinite."""
        numbers = self._numbers()
        shape = (numbers.shape[0], *(1,) * (count.ndim - self._known_mean.ndim), *numbers.shape[1:])
        masses, numbers = torch.exp(self.log_masses(numbers)).reshape(shape), numbers.reshape(shape)
        chosen = (numbers > count) if beyond else (numbers <= count)
        return torch.where(chosen, masses, torch.zeros_like(masses)).sum(0)

    def _numbers(self) -> Tensor:
        """(Q, *batch) integers to sum over."""
        mean, spread, (low, high) = self._known_mean.detach(), self._spread, self.limits
        first = torch.maximum(torch.floor(mean - _FAR * spread), low).clamp(min=-(2**40))
        last = torch.minimum(torch.ceil(mean + _FAR * spread + _FAR), high)
        count = int((last - first).max()) + 1 if first.numel() else 1
        if count > MOST_LEVELS:
            raise ValueError(
                f"{type(self.base).__name__}: {count} integers within {_FAR} standard deviations are too many to sum over; "
                "use a continuous distribution and Digitised"
            )
        steps = torch.arange(count, dtype=first.dtype, device=first.device).view(-1, *(1,) * first.ndim)
        return first + steps

    @property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """Ends of the scale asinh((o − mean)/deviation), within the support."""
        ends = (self._known_mean.detach() + math.sinh(side * _REACH) * self._spread for side in (-1, 1))
        low, high = (torch.minimum(torch.maximum(end, self.limits[0]), self.limits[1]) for end in ends)
        return low, high

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        if self.discrete:
            return between(self, torch.floor(low), torch.floor(high))
        return self._log_integral(low, high)

    def _log_integral(self, low: Tensor, high: Tensor) -> Tensor:
        """log ∫ p between bounds, which may be infinite. Narrow intervals have their own nodes, even far in a tail."""
        centre, spread, (least, most) = self._known_mean.detach(), self._spread, self._ends
        low, high = torch.maximum(low, least), torch.minimum(high, most)
        empty = ~(low < high)
        low, high = torch.where(empty, centre - spread, low), torch.where(empty, centre, high)
        if not is_traced(low) and bool(((high - low).detach() <= spread / 2).all()):
            nodes, weights = panels(low, high, 2)
        else:  # on the scale asinh((o − mean)/deviation), which reaches far tails in few panels
            start, stop = (torch.asinh((end - centre) / spread) for end in (low, high))
            places, shares = panels(start, stop, PANELS // 4)
            nodes, weights = centre + spread * torch.sinh(places), shares * spread * torch.cosh(places)
        found = log_sum(self._log_density(nodes) + torch.log(weights))
        found = torch.where(empty, torch.full_like(found, -math.inf), found)
        return torch.where(torch.isfinite(centre), found, torch.full_like(found, math.nan))

    def _log_density(self, nodes: Tensor) -> Tensor:
        low, high = self.limits
        found: Tensor = self.base.log_prob(torch.minimum(torch.maximum(nodes, low), high))
        return torch.nan_to_num(found, nan=-math.inf, posinf=math.inf, neginf=-math.inf)

    def icdf(self, value: Tensor) -> Tensor:
        try:
            return self.base.icdf(value)
        except NotImplementedError:
            centre, spread = self._known_mean.detach(), self._spread
            start, stop = (torch.asinh((end - centre) / spread) for end in self._ends)
            found = bisect_quantile(lambda place: self.cdf(centre + spread * torch.sinh(place)), value, start, stop)
            found = centre + spread * torch.sinh(found)
            return torch.round(found) if self.discrete else found

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        shape = torch.Size(sample_shape)
        if generator is None:
            return self.base.sample(shape)
        seed = int(torch.randint(2**31, (), generator=generator, device=generator.device))
        devices = [self.device] if self.device.type == "cuda" else []
        with torch.random.fork_rng(devices):  # torch distributions take no generator
            torch.manual_seed(seed)
            return self.base.sample(shape)

    def quadrature(self) -> tuple[Tensor, Tensor]:
        if self.discrete:
            nodes = self._numbers()
            return nodes, torch.exp(self.log_masses(nodes))
        centre, spread = self._known_mean.detach(), self._spread
        start, stop = (torch.asinh((end - centre) / spread) for end in self._ends)
        nodes, weights = panels(start, stop, PANELS)
        at = centre + spread * torch.sinh(nodes)
        return at, weights * spread * torch.cosh(nodes) * torch.exp(self._log_density(at))

    @property
    def mean(self) -> Tensor:
        return self.base.mean

    @property
    def variance(self) -> Tensor:
        return self.base.variance


def _divergence(p: Distribution, q: Distribution) -> Tensor:
    """E_p[log p − log q], nats, by the quadrature rule of `p`."""
    first, second = as_noise_distribution(p), as_noise_distribution(q)
    if first.discrete != second.discrete:
        raise NotImplementedError(
            f"{type(p).__name__} and {type(q).__name__}: one is discrete and the other continuous; wrap the "
            "continuous one in Digitised with the rounding step of the discrete one"
        )

    def difference(observation: Tensor) -> Tensor:
        log_prob = first.log_prob(observation)
        ratio = log_prob - second.log_prob(observation)
        # observations that are impossible under p contribute nothing
        return torch.where(torch.isneginf(log_prob), torch.zeros_like(log_prob), ratio)

    return first.cast(first.expectation(difference))


register_kl(NoiseDistribution, NoiseDistribution)(_divergence)  # type: ignore[no-untyped-call]
register_kl(NoiseDistribution, Distribution)(_divergence)  # type: ignore[no-untyped-call]
register_kl(Distribution, NoiseDistribution)(_divergence)  # type: ignore[no-untyped-call]
