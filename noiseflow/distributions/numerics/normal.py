"""The standard normal distribution, accurate in its tails: CDF, intervals, hazard and expectations."""

import math
from typing import Any

import torch
from torch import Tensor

LOG_SQRT_2PI = math.log(math.sqrt(math.tau))
REACH = 6.5
"""Standard deviations: one draw in 10¹⁰ lies beyond."""
FULL = 8.0
"""Standard deviations beyond which Φ is 0 or 1 to rounding."""
FARTHEST = 30.0
"""Standard deviations beyond which probabilities, near e⁻⁴⁵⁰, would underflow."""


def normal_quadrature(dtype: torch.dtype, *, limit: float = 12.0, count: int = 401) -> tuple[Tensor, Tensor]:
    """Nodes and weights (Q,) of the trapezoidal rule for expectations under a standard normal.

    The rule converges geometrically for smooth functions. Unlike Gauss–Hermite quadrature, it stays accurate at the kinks of
    splines and radial layers.
    """
    nodes = torch.linspace(-limit, limit, count, dtype=torch.float64, device="cpu")
    weights = torch.exp(-0.5 * nodes * nodes)
    return nodes.to(dtype), (weights / weights.sum()).to(dtype)


def log_normal_interval(low: Tensor, high: Tensor) -> Tensor:
    """log[Φ(high) − Φ(low)] for low ≤ high, without cancellation in the tails or in narrow intervals.

    Args:
        low, high: bounds in units of the standard normal; may be ``-inf`` and ``inf``.
    """
    return _log_interval(low, high)[0]


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
    outside = torch.exp(exponent) * at_near + torch.exp(-0.5 * far * far) * at_far
    across, beside = near > 0, at_near - ratio * at_far
    value = torch.where(across, torch.log1p(-outside), torch.log(beside) + exponent)
    share = torch.where(across, 1 - outside, beside)
    slope = torch.exp(torch.where(across, exponent, 0 * ratio) - LOG_SQRT_2PI) / share
    # narrow intervals: mean of the normal density over the interval, to fourth order in its width
    narrow = width * (1 + middle.abs()) < 0.1
    tiny = torch.finfo(width.dtype).tiny
    bend = torch.log1p(width * width * (middle * middle - 1) / 24)
    log_narrow = torch.log(width.clamp(min=tiny)) - 0.5 * middle * middle - LOG_SQRT_2PI + bend
    narrow_slope = torch.where(width > tiny, torch.exp((middle - near) * (middle + near) / 2 - bend) / width, 0 * width)
    value, slope = torch.where(narrow, log_narrow, value), torch.where(narrow, narrow_slope, slope)
    other = slope * ratio
    return value, -torch.where(flip, slope, other), torch.where(flip, other, slope)


def normal_cdf(x: Tensor) -> Tensor:
    """Φ(x), accurate to rounding in the lower tail; that of torch is 0 below −5.5 in single precision."""
    return 0.5 * torch.erfc(x * -math.sqrt(0.5))


def log_normal_cdf(x: Tensor) -> Tensor:
    """log Φ(x), with a gradient that is accurate far into both tails; that of torch fails below about −10⁸."""
    return log_normal_interval(torch.full_like(x, -math.inf), x)


def _log_interval(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `_interval`, differentiable."""
    ends = torch.broadcast_tensors(low, high)  # type: ignore[no-untyped-call]
    found: tuple[Tensor, Tensor, Tensor] = applied(_LogInterval, _LogIntervalForward, *ends)
    return found


def applied(kind: Any, with_jvp: Any, *inputs: Any) -> Any:
    """Apply a function; ``torch.compile`` does not support forward-mode derivatives of custom functions."""
    return (kind if torch.compiler.is_compiling() else with_jvp).apply(*inputs)


def normal_hazard(x: Tensor) -> Tensor:
    """φ(x)/Φ(x), the derivative of log Φ(x)."""
    return _log_interval(torch.full_like(x, -math.inf), x)[2]


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
        both = down * up
        return (
            gradient * down - by_low * down * _turn(low, down) - by_high * both,
            gradient * up - by_high * up * _turn(high, up) - by_low * both,
        )


class _LogIntervalForward(_LogInterval):
    """As `_LogInterval`, with forward-mode derivatives."""

    @staticmethod
    def jvp(ctx: Any, low_tangent: Tensor, high_tangent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        low, high, down, up = ctx.saved_tensors
        by_low, by_high = low_tangent * down, high_tangent * up
        down_by, up_by = -by_low * _turn(low, down) - by_high * down, -by_high * _turn(high, up) - by_low * up
        return by_low + by_high, down_by, up_by


def _turn(bound: Tensor, slope: Tensor) -> Tensor:
    """bound + slope, minus the logarithmic derivative of the slope; −1/bound where it cancels, far in a tail; 0 at infinity."""
    total = torch.where(torch.isinf(bound), torch.zeros_like(bound), bound + slope)
    far = total.abs() < torch.finfo(bound.dtype).eps ** 0.5 * bound.abs()
    return torch.where(far, -1 / torch.where(far, bound, torch.ones_like(bound)), total)
