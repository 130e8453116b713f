"""Gradients by hand: of linear maps, and of costs that compute value and gradient in one pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Multiply = Callable[[Tensor, bool], Tensor]


def linear(dense: Tensor, multiply: Multiply, *, transposed: bool = False) -> Tensor:
    """``multiply(dense, transposed)``, the product with a matrix or with its transpose; its gradient is the other product."""
    result: Tensor = _Linear.apply(dense, multiply, transposed)  # type: ignore[no-untyped-call]
    return result


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dense: Tensor, multiply: Multiply, transposed: bool) -> Tensor:
        ctx.of = multiply, transposed
        return multiply(dense, transposed)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        multiply, transposed = ctx.of
        return linear(gradient, multiply, transposed=not transposed), None, None


class SavedGradient(torch.autograd.Function):
    """A scalar function whose ``forward`` saves the gradient with respect to its first argument, the only differentiable one."""

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * outer, *[None] * (len(ctx.needs_input_grad) - 1)
