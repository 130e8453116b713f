"""Bases of laws: a latent normal variable pushed through a map, and levels with one probability each."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import constraints

from noiseflow.distributions.noise_distribution import NoiseDistribution, panels
from noiseflow.distributions.numerics.normal import LOG_SQRT_2PI, log_normal_interval, normal_cdf
from noiseflow.distributions.pixels import is_traced

ROUNDINGS = 8
"""Rounding errors within which two values count as equal."""
NEAR = 1e-3
"""Steps between levels: a value this near to a level counts as that level. Number formats round less; in single precision the
1000th level is off by as much."""


class LatentDistribution(NoiseDistribution):
    """A distribution whose observation is an increasing function of a standard normal latent, so F(o) = Φ(latent(o))."""

    @abstractmethod
    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The latent of an observation and its log-derivative, ``(z, log dz/do)``."""

    @abstractmethod
    def from_latent(self, latent: Tensor) -> Tensor:
        """The observation of a latent."""

    def log_prob(self, value: Tensor) -> Tensor:
        latent, ladj = self.to_latent(value)
        return ladj - 0.5 * latent * latent - LOG_SQRT_2PI

    def cdf(self, value: Tensor) -> Tensor:
        return normal_cdf(self.to_latent(value)[0])

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        low, high = torch.broadcast_tensors(low, high)  # type: ignore[no-untyped-call]
        ends = torch.stack([low, high])  # one call is half the work
        inside = torch.isfinite(ends)
        latent, slope = self.to_latent(torch.where(inside, ends, torch.zeros_like(ends)))
        bottom, top = torch.where(inside, latent, ends)
        slope_below, slope_above = torch.where(inside, slope, torch.zeros_like(slope))
        mass = log_normal_interval(bottom, top)
        # in a narrow cell the difference of latents loses digits; the slopes at its ends then give the width, unless they
        # differ by more than is lost, as near the cusp of a radial layer
        middle, finite = (bottom + top) / 2, torch.isfinite(bottom) & torch.isfinite(top)
        width, eps = top - bottom, torch.finfo(bottom.dtype).eps
        alike = (slope_above - slope_below).abs() * width <= ROUNDINGS * eps * (1 + middle.abs())
        narrow = finite & (high > low) & (width < eps ** (1 / 3)) & alike
        zero = torch.zeros_like(middle)
        width = torch.where(narrow, high - low, zero + 1)
        middle, slope = torch.where(narrow, middle, zero), torch.where(narrow, (slope_below + slope_above) / 2, zero)
        return torch.where(narrow, torch.log(width) + slope - 0.5 * middle * middle - LOG_SQRT_2PI, mass)

    def icdf(self, value: Tensor) -> Tensor:
        return self.from_latent(torch.special.ndtri(value))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        like = self.anything()
        shape = (*sample_shape, *self.batch_shape)
        return self.from_latent(torch.randn(shape, generator=generator, dtype=like.dtype, device=like.device))

    def _place(self, value: Tensor) -> tuple[Tensor, Tensor]:
        latent, ladj = self.to_latent(value)
        return latent, torch.exp(ladj)

    def quadrature(self) -> tuple[Tensor, Tensor]:
        like = self.anything().expand(self.batch_shape)
        return resolved_nodes(lambda value: self.to_latent(value)[0], self.from_latent, like)


def resolved_nodes(
    to_latent: Callable[[Tensor], Tensor],
    from_latent: Callable[[Tensor], Tensor],
    like: Tensor,
    *,
    latents: tuple[float, int] = (9.0, 55),
    values: tuple[float, int] = (4.0, 47),
) -> tuple[Tensor, Tensor]:
    """Values ``(Q, *shape)`` at the nodes of Gauss–Legendre panels for expectations under a standard normal latent, and weights.

    Panels end at even latents, and at the latents of even values between far quantiles: so a jump of the value, as between two
    peaks of the density, is resolved as well as a tail.

    Args:
        to_latent, from_latent: increasing functions of (P, *shape), inverse to each other.
        like: a tensor of the shape, type and device of the values.
        latents: the outermost of the even latents, beyond which lies 2e-19, and their number.
        values: the same of the quantiles between which the even values lie, which one pixel in 16 000 passes.
    """
    column = (-1, *[1] * like.ndim)
    with torch.no_grad():
        evenly, share = (torch.linspace(-most, most, count).to(like).view(column) for most, count in (latents, values))
        low, high = from_latent(share[[0, -1]].expand(2, *like.shape).contiguous())
        even = (low + high + share[1:-1] / share[-1] * (high - low)) / 2
        ends = evenly[0], evenly[-1]
        edges = torch.cat([to_latent(even).clamp(*ends), evenly.expand(-1, *like.shape)]).sort(0).values
    latent, weights = panels(edges[:-1], edges[1:], 1)
    latent, weights = latent.flatten(0, 1), (weights * torch.exp(-0.5 * latent * latent)).flatten(0, 1)
    return from_latent(latent), weights / weights.sum(0)


class DiscreteLevels(constraints.Constraint):
    """Constraint to levels: multiples of a step from an origin, between two limits, which are levels too.

    Args:
        step: spacing, detector units.
        origin: one of the levels.
        low, high: the smallest and the largest level.
    """

    is_discrete = True

    def __init__(self, step: float, origin: float, low: float, high: float) -> None:
        self.step, self.origin, self.lower_bound, self.upper_bound = step, origin, low, high

    def __repr__(self) -> str:
        return f"DiscreteLevels(step={self.step:g}, low={self.lower_bound:g}, high={self.upper_bound:g})"

    def check(self, value: Tensor) -> Tensor:
        """Which values are levels, boolean."""
        steps = (value - self.origin) / self.step
        level = ((steps - torch.round(steps)).abs() < NEAR) | (value == self.lower_bound) | (value == self.upper_bound)
        return level & (value >= self.lower_bound) & (value <= self.upper_bound)


def near_level(value: Tensor, origin: Tensor | float, step: Tensor | float) -> Tensor:
    """Distance from a level, in steps, within which a value is that level: it may once have been rounded to single precision."""
    size = ROUNDINGS * (value.detach().double().abs() + torch.as_tensor(origin).abs()) / step
    once = (size * torch.finfo(torch.float32).eps).clamp(max=NEAR)
    return torch.maximum(once, size * torch.finfo(value.dtype).eps).clamp(max=0.5)


def between(distribution: Any, low: Tensor, high: Tensor, *, fewest: int = 8) -> Tensor:
    """log P(low < k ≤ high) for integers k; the bounds are integers or infinite.

    Args:
        distribution: has ``log_masses(count)``, and ``masses_up_to(count, beyond=…)`` for both tails.
        low, high: bounds that broadcast with the batch of the distribution.
        fewest: up to this number of levels, probabilities are added one by one, which is exact even if they are tiny.
    """
    few = (high - low <= fewest) & torch.isfinite(low) & torch.isfinite(high)
    start = torch.where(few, low, torch.zeros_like(low))
    known = bool(few.numel()) and not is_traced(few)
    most = max(int(torch.where(few, high - low, 1).max()), 1) if known else fewest
    counts = (start + step for step in range(1, most + 1))
    parts = [torch.where(count <= high, distribution.log_masses(count), -math.inf) for count in counts]
    summed = log_sum(torch.stack(parts))
    if known and bool(few.all()):
        return summed
    lower, upper = ([distribution.masses_up_to(bound, beyond=b) for bound in (low, high)] for b in (False, True))
    # use the smaller tail, which is the more accurate one
    many = torch.where(lower[0] < 0.5, lower[1] - lower[0], upper[0] - upper[1]).clamp(min=0)
    positive = many > 0
    log_many = torch.where(positive, torch.log(torch.where(positive, many, torch.ones_like(many))), -math.inf)
    return torch.where(few, summed, log_many)


def log_sum(log_masses: Tensor) -> Tensor:
    """logsumexp along the first axis, with a gradient of zero where all are −inf."""
    none = torch.isneginf(log_masses).all(0)
    found = torch.logsumexp(torch.where(none, torch.zeros_like(log_masses), log_masses), 0)
    return torch.where(none, torch.full_like(found, -math.inf), found)
