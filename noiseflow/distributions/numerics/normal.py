"""The standard normal distribution, accurate in its tails: CDF, intervals, hazard and expectations."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def normal_quadrature(
    dtype: torch.dtype, device: torch.device | str = "cpu", *, limit: float = 12.0, count: int = 401
) -> tuple[Tensor, Tensor]:
    """Nodes and weights (Q,) of the trapezoidal rule for expectations under a standard normal.

    The rule converges geometrically for smooth functions. Unlike Gauss–Hermite quadrature, it stays accurate at the kinks of
    splines and radial layers.
    """
    nodes = torch.linspace(-limit, limit, count, dtype=torch.float64, device=device)
    weights = torch.exp(-0.5 * nodes * nodes)
    return nodes.to(dtype), (weights / weights.sum()).to(dtype)


def log_normal_interval(low: Tensor, high: Tensor) -> Tensor:
    """log[Φ(high) − Φ(low)] for low ≤ high, without cancellation in the tails or in narrow intervals.

    Args:
        low, high: bounds in units of the standard normal; may be ``-inf`` and ``inf``.
    """
    return applied(_LogInterval, _LogIntervalForward, *torch.broadcast_tensors(low, high))[0]


def _interval(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """log[Φ(high) − Φ(low)] and its derivatives with respect to `low` and `high`."""
    flip = low > -high  # an interval right of zero is its mirror image left of zero
    far, near = torch.where(flip, -high, low), torch.where(flip, -low, high)
    width, middle = near - far, (near + far) / 2
    # Φ(−|x|) = exp(−x²/2)·erfcx(|x|/√2)/2, and the difference of squares is computed as a product
    at_near, at_far = (torch.special.erfcx(end.abs() * math.sqrt(0.5)) / 2 for end in (near, far))
    ratio = torch.exp(width * middle)  # of the density at `far` to that at `near`
    ratio = torch.where(torch.isinf(far), torch.zeros_like(ratio), ratio)
    exponent = -0.5 * near * near
    across = 1 - torch.exp(exponent) * at_near - torch.exp(-0.5 * far * far) * at_far
    share = torch.where(near > 0, across, at_near - ratio * at_far)
    exponent_of_slope = torch.where(near > 0, exponent, torch.zeros_like(exponent))
    value = torch.log(share) + torch.where(near > 0, torch.zeros_like(exponent), exponent)
    slope = torch.exp(exponent_of_slope - LOG_SQRT_2PI) / share
    # narrow intervals: mean of the normal density over the interval, to fourth order in its width
    narrow = width * (1 + middle.abs()) < 0.1
    tiny = torch.finfo(width.dtype).tiny
    bend = torch.log1p(width * width * (middle * middle - 1) / 24)
    log_narrow = torch.log(width.clamp(min=tiny)) - 0.5 * middle * middle - LOG_SQRT_2PI + bend
    narrow_slope = torch.where(width > tiny, torch.exp(-width * (near + middle) / 4 - bend) / width, 0 * width)
    value, slope = torch.where(narrow, log_narrow, value), torch.where(narrow, narrow_slope, slope)
    other = slope * ratio
    return value, -torch.where(flip, slope, other), torch.where(flip, other, slope)


def normal_cdf(x: Tensor) -> Tensor:
    """Φ(x), accurate to rounding in the lower tail; that of torch is 0 below −5.5 in single precision."""
    return 0.5 * torch.erfc(x * -math.sqrt(0.5))


def log_normal_cdf(x: Tensor) -> Tensor:
    """log Φ(x), with a gradient that is accurate far into both tails; that of torch fails below about −10⁸."""
    found: Tensor = applied(_LogCdf, _LogCdfForward, x)
    return found


def applied(kind: Any, with_jvp: Any, *inputs: Any) -> Any:
    """Apply a function; ``torch.compile`` does not support forward-mode derivatives of custom functions."""
    return (kind if torch.compiler.is_compiling() else with_jvp).apply(*inputs)


def normal_hazard(x: Tensor) -> Tensor:
    """φ(x)/Φ(x), the derivative of log Φ(x)."""
    left = math.sqrt(2 / math.pi) / torch.special.erfcx(-x.clamp(max=0) / math.sqrt(2))
    right = torch.exp(-0.5 * x * x - LOG_SQRT_2PI) / normal_cdf(x.clamp(min=0))
    return torch.where(x <= 0, left, right)


class _Hazard(torch.autograd.Function):
    """`normal_hazard` h with its derivative −h·(x + h), because torch has no derivative of erfcx."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return normal_hazard(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient * _hazard_slope(*ctx.saved_tensors)


class _HazardForward(_Hazard):
    """As `_Hazard`, with forward-mode derivatives."""

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor) -> Tensor:
        return tangent * _hazard_slope(*ctx.saved_tensors)


def _hazard_slope(x: Tensor) -> Tensor:
    hazard = normal_hazard(x)
    # far left, x + h tends to −1/x and the sum cancels
    far = x < -1e4
    return -hazard * torch.where(far, -1 / torch.where(far, x, -torch.ones_like(x)), x + hazard)


def hazard_of(x: Tensor) -> Tensor:
    """`normal_hazard`, differentiable."""
    found: Tensor = applied(_Hazard, _HazardForward, x)
    return found


class _LogCdf(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        value: Tensor = torch.special.log_ndtr(x)
        return value

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient * hazard_of(x)


class _LogCdfForward(_LogCdf):
    """As `_LogCdf`, with forward-mode derivatives."""

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return tangent * hazard_of(x)


class _LogInterval(torch.autograd.Function):
    """`_interval`, whose derivatives are outputs, so that they have derivatives too."""

    generate_vmap_rule = True

    @staticmethod
    def forward(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _interval(low, high)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs, *output[1:])
        ctx.save_for_forward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, by_low: Tensor, by_high: Tensor) -> tuple[Tensor, Tensor]:
        low, high, down, up = ctx.saved_tensors
        change = gradient - by_low * down - by_high * up
        return down * (change - by_low * _finite(low)), up * (change - by_high * _finite(high))


class _LogIntervalForward(_LogInterval):
    """As `_LogInterval`, with forward-mode derivatives."""

    @staticmethod
    def jvp(ctx: Any, low_tangent: Tensor, high_tangent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        low, high, down, up = ctx.saved_tensors
        change = low_tangent * down + high_tangent * up
        by_low, by_high = (change + _finite(low) * low_tangent, change + _finite(high) * high_tangent)
        return change, -down * by_low, -up * by_high


def _finite(bound: Tensor) -> Tensor:
    """The bound, or 0 if it is infinite: there, the density is 0."""
    return torch.where(torch.isinf(bound), torch.zeros_like(bound), bound)
