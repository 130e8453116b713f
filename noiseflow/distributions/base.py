"""What a noise model returns: a distribution of one observation per pixel, given that pixel's signal."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_ROUNDINGS = 8
_TOGETHER = 2**16  # readings


class NoiseDistribution(Distribution):
    """p(observation | signal), one independent observation per pixel: ``batch_shape`` is the signal's, ``event_shape`` is ()."""

    has_rsample: ClassVar[bool] = False  # type: ignore[misc]
    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(self, shape: torch.Size) -> None:
        super().__init__(shape, torch.Size(), validate_args=False)

    @abstractmethod
    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density in nats per detector unit; of a digitised model, log-mass."""

    @abstractmethod
    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        """log P(low < observation ≤ high), accurate far into both tails; the bounds may be infinite."""

    @abstractmethod
    def cdf(self, value: Tensor) -> Tensor:
        """P(observation ≤ value)."""

    def cdf_below(self, value: Tensor) -> Tensor:
        """P(observation < value); differs from `cdf` only where single readings have mass."""
        return self.cdf(value)

    def rescaled(self, scale: Tensor, shift: Tensor) -> NoiseDistribution:
        """The distribution of scale·o + shift; a digitised one rounds and clips after that. Both broadcast with the batch."""
        return RescaledDistribution(self, scale, shift)

    @abstractmethod
    def icdf(self, value: Tensor) -> Tensor:
        """The quantile: smallest observation whose CDF reaches `value`."""

    @abstractmethod
    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Draw observations, ``(*sample_shape, *batch_shape)``."""


class LatentDistribution(NoiseDistribution):
    """A distribution whose observation is an increasing function of a standard normal latent, so F(o) = Φ(latent(o))."""

    @abstractmethod
    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The latent of an observation and the log-derivative, ``(z, log dz/do)``."""

    @abstractmethod
    def from_latent(self, latent: Tensor) -> Tensor:
        """The observation of a latent."""

    def log_prob(self, value: Tensor) -> Tensor:
        latent, ladj = self.to_latent(value)
        return ladj - 0.5 * latent * latent - _LOG_SQRT_2PI

    def cdf(self, value: Tensor) -> Tensor:
        probability: Tensor = torch.special.ndtr(self.to_latent(value)[0])
        return probability

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        (bottom, slope_below), (top, slope_above) = self._latent_bound(low), self._latent_bound(high)
        mass = log_normal_interval(bottom, top)
        # the difference of latents keeps few digits in a narrow cell; there the slopes at its ends tell the width, unless they
        # differ by more than is lost, as about the cusp of a radial layer
        middle, finite = (bottom + top) / 2, torch.isfinite(bottom) & torch.isfinite(top)
        width, eps = top - bottom, torch.finfo(bottom.dtype).eps
        alike = (slope_above - slope_below).abs() * width <= _ROUNDINGS * eps * (1 + middle.abs())
        narrow = finite & (high > low) & (width < eps ** (1 / 3)) & alike
        zero = torch.zeros_like(middle)
        width = torch.where(narrow, high - low, zero + 1)
        middle, slope = torch.where(narrow, middle, zero), torch.where(narrow, (slope_below + slope_above) / 2, zero)
        return torch.where(narrow, torch.log(width) + slope - 0.5 * middle * middle - _LOG_SQRT_2PI, mass)

    def _latent_bound(self, value: Tensor) -> tuple[Tensor, Tensor]:
        finite = torch.isfinite(value)
        if not bool(finite.any()):
            return value, torch.zeros_like(value)
        latent, slope = self.to_latent(torch.where(finite, value, torch.zeros_like(value)))
        return torch.where(finite, latent, value), torch.where(finite, slope, torch.zeros_like(slope))

    def icdf(self, value: Tensor) -> Tensor:
        return self.from_latent(torch.special.ndtri(value))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        like = self._like()
        shape = (*sample_shape, *self.batch_shape)
        with torch.no_grad():
            return self.from_latent(torch.randn(shape, generator=generator, dtype=like.dtype, device=like.device))

    @abstractmethod
    def _like(self) -> Tensor:
        """A tensor of the dtype and device of the distribution."""

    @property
    def mean(self) -> Tensor:
        return self.expectation(lambda observation: observation)

    @property
    def variance(self) -> Tensor:
        mean = self.mean
        return self.expectation(lambda observation: (observation - mean) ** 2)

    def expectation(self, function: Callable[[Tensor], Tensor]) -> Tensor:
        """E[function(observation)] by quadrature over the latent, shape of the batch."""
        like = self._like()
        total = torch.zeros(self.batch_shape, dtype=like.dtype, device=like.device)
        nodes, weights = (tensor.to(like) for tensor in normal_quadrature(torch.float64))
        together = max(1, _TOGETHER // max(1, total.numel()))
        for node, weight in zip(torch.split(nodes, together), torch.split(weights, together), strict=True):
            latent = node.view(-1, *[1] * total.ndim).expand(-1, *total.shape).contiguous()
            total = total + torch.tensordot(weight, function(self.from_latent(latent)), dims=1)
        return total


def normal_quadrature(
    dtype: torch.dtype, device: torch.device | str = "cpu", *, limit: float = 12.0, count: int = 401
) -> tuple[Tensor, Tensor]:
    """Nodes and weights (Q,) of the trapezoidal rule for a standard normal expectation.

    The rule converges geometrically for smooth functions and stays accurate at the kinks of splines and radial layers, where
    Gauss–Hermite does not.
    """
    nodes = torch.linspace(-limit, limit, count, dtype=torch.float64, device=device)
    weights = torch.exp(-0.5 * nodes * nodes)
    return nodes.to(dtype), (weights / weights.sum()).to(dtype)


def log_normal_interval(low: Tensor, high: Tensor) -> Tensor:
    """log[Φ(high) − Φ(low)] for low ≤ high, without cancellation in the tails or in narrow intervals.

    Args:
        low, high: bounds in units of the standard normal; ``-inf`` and ``inf`` allowed.
    """
    flip = low > -high  # an interval right of zero is its mirror image left of zero
    low, high = torch.where(flip, -high, low), torch.where(flip, -low, high)
    width = high - low
    middle = low + width / 2
    narrow = width * (1 + middle.abs()) < 0.1
    zero = torch.zeros_like(low)
    # narrow: the mean of the normal density over the interval, to fourth order in its width
    w, m = torch.where(narrow, width, zero + 1), torch.where(narrow, middle, zero)
    log_narrow = torch.log(w.clamp(min=torch.finfo(w.dtype).tiny)) - 0.5 * m * m - _LOG_SQRT_2PI
    log_narrow = log_narrow + torch.log1p(w * w * (m * m - 1) / 24)
    return torch.where(
        narrow,
        log_narrow,
        _log_wide_interval(*(torch.where(narrow, zero - k, end) for k, end in ((1, low), (0, high)))),
    )


def _log_wide_interval(low: Tensor, high: Tensor) -> Tensor:
    """log[Φ(high) − Φ(low)] for low < high ≤ −low: log Φ(high) + log[1 − Φ(low)/Φ(high)]."""
    unbounded = torch.isneginf(low)
    low = torch.where(unbounded, -torch.ones_like(low) - high.detach().abs(), low)
    ratio: Tensor = _LogRatio.apply(low, high)  # type: ignore[no-untyped-call]
    ratio = torch.where(unbounded | (ratio >= 0), -torch.ones_like(ratio), ratio)
    rest = torch.log(-torch.expm1(ratio))
    whole: Tensor = log_normal_cdf(high)
    return whole + torch.where(unbounded, torch.zeros_like(rest), rest)


def log_normal_cdf(x: Tensor) -> Tensor:
    """log Φ(x), with a gradient that holds far into both tails; torch's own fails beyond about −10⁸."""
    found: Tensor = _LogCdf.apply(x)  # type: ignore[no-untyped-call]
    return found


def normal_hazard(x: Tensor) -> Tensor:
    """φ(x)/Φ(x), the derivative of log Φ(x)."""
    left = math.sqrt(2 / math.pi) / torch.special.erfcx(-x.clamp(max=0) / math.sqrt(2))
    right = torch.exp(-0.5 * x * x - _LOG_SQRT_2PI) / torch.special.ndtr(x.clamp(min=0))
    return torch.where(x <= 0, left, right)


class _LogCdf(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        value: Tensor = torch.special.log_ndtr(x)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient * normal_hazard(x)


class _LogRatio(torch.autograd.Function):
    """log Φ(low) − log Φ(high) for low < high ≤ −low, without the cancellation of two large numbers."""

    @staticmethod
    def forward(ctx: Any, low: Tensor, high: Tensor) -> Tensor:
        ctx.save_for_backward(low, high)
        # left of zero Φ(x) = exp(−x²/2)·erfcx(−x/√2)/2, and the difference of the squares is a product
        a, b = (-end.clamp(max=0) / math.sqrt(2) for end in (low, high))
        left = (b - a) * (a + b) + torch.log(torch.special.erfcx(a) / torch.special.erfcx(b))
        return torch.where(high <= 0, left, torch.special.log_ndtr(low) - torch.special.log_ndtr(high))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        low, high = ctx.saved_tensors
        return gradient * normal_hazard(low), -gradient * normal_hazard(high)


def bisect_quantile(
    distribution: NoiseDistribution, value: Tensor, low: Tensor, high: Tensor, *, num_steps: int = 60
) -> Tensor:
    """The quantile by bisection between bounds that bracket it, for distributions without a closed form."""
    for _ in range(num_steps):
        middle = low + (high - low) / 2
        above = distribution.cdf(middle) >= value
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return high


class RescaledDistribution(NoiseDistribution):
    """The distribution of scale·o + shift, o from another noise distribution.

    Args:
        base: distribution of o.
        scale, shift: positive numbers and numbers that broadcast with the batch of `base`; new axes may only lead.
    """

    def __init__(self, base: NoiseDistribution, scale: Tensor, shift: Tensor) -> None:
        super().__init__(torch.broadcast_shapes(base.batch_shape, scale.shape, shift.shape))  # type: ignore[no-untyped-call]
        self.base, self.scale, self.shift = base, scale, shift

    def _back(self, value: Tensor) -> Tensor:
        finite = torch.isfinite(value)  # the gradient of an infinite bound must not become NaN
        inside = (torch.where(finite, value, torch.zeros_like(value)) - self.shift) / self.scale
        return torch.where(finite, inside, value)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base.log_prob((value - self.shift) / self.scale) - torch.log(self.scale)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.base.log_interval_prob(self._back(low), self._back(high))

    def cdf(self, value: Tensor) -> Tensor:
        return self.base.cdf(self._back(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self.base.cdf_below(self._back(value))

    def icdf(self, value: Tensor) -> Tensor:
        return self.base.icdf(value) * self.scale + self.shift

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        leading = self.batch_shape[: len(self.batch_shape) - len(self.base.batch_shape)]
        return self.base.sample((*sample_shape, *leading), generator) * self.scale.detach() + self.shift.detach()

    @property
    def mean(self) -> Tensor:
        return self.base.mean * self.scale + self.shift

    @property
    def variance(self) -> Tensor:
        return self.base.variance * self.scale**2 + torch.zeros_like(self.shift)
