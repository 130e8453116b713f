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
    flip = low > -high  # an interval right of zero is its mirror image left of zero
    low, high = torch.where(flip, -high, low), torch.where(flip, -low, high)
    width = high - low
    middle = low + width / 2
    narrow = width * (1 + middle.abs()) < 0.1
    zero = torch.zeros_like(low)
    # narrow intervals: mean of the normal density over the interval, to fourth order in its width
    w, m = torch.where(narrow, width, zero + 1), torch.where(narrow, middle, zero)
    log_narrow = torch.log(w.clamp(min=torch.finfo(w.dtype).tiny)) - 0.5 * m * m - LOG_SQRT_2PI
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
    ratio: Tensor = applied(_LogRatio, _LogRatioForward, low, high)
    ratio = torch.where(unbounded | (ratio >= 0), -torch.ones_like(ratio), ratio)
    rest = torch.log(-torch.expm1(ratio))
    whole: Tensor = log_normal_cdf(high)
    return whole + torch.where(unbounded, torch.zeros_like(rest), rest)


def normal_cdf(x: Tensor) -> Tensor:
    """Φ(x), accurate to rounding in the lower tail; that of torch is 0 below −5.5 in single precision."""
    return 0.5 * torch.erfc(x * -math.sqrt(0.5))


def log_normal_cdf(x: Tensor) -> Tensor:
    """log Φ(x), with a gradient that is accurate far into both tails; that of torch fails below about −10⁸."""
    found: Tensor = applied(_LogCdf, _LogCdfForward, x)
    return found


def applied(kind: Any, with_jvp: Any, *inputs: Any) -> Tensor:
    """Apply a function; ``torch.compile`` does not support forward-mode derivatives of custom functions."""
    found: Tensor = (kind if torch.compiler.is_compiling() else with_jvp).apply(*inputs)
    return found


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


class _LogRatio(torch.autograd.Function):
    """log Φ(low) − log Φ(high) for low < high ≤ −low, without the cancellation of two large numbers."""

    generate_vmap_rule = True

    @staticmethod
    def forward(low: Tensor, high: Tensor) -> Tensor:
        # for x < 0, Φ(x) = exp(−x²/2)·erfcx(−x/√2)/2, and the difference of squares is computed as a product
        a, b = (-end.clamp(max=0) / math.sqrt(2) for end in (low, high))
        left = (b - a) * (a + b) + torch.log(torch.special.erfcx(a) / torch.special.erfcx(b))
        return torch.where(high <= 0, left, torch.special.log_ndtr(low) - torch.special.log_ndtr(high))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        low, high = ctx.saved_tensors
        return gradient * hazard_of(low), -gradient * hazard_of(high)


class _LogRatioForward(_LogRatio):
    """As `_LogRatio`, with forward-mode derivatives."""

    @staticmethod
    def jvp(ctx: Any, low_tangent: Tensor, high_tangent: Tensor) -> Tensor:
        low, high = ctx.saved_tensors
        return low_tangent * hazard_of(low) - high_tangent * hazard_of(high)
