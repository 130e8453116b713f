"""Base class of volume costs that compute value and gradient in one pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class SavedGradient(torch.autograd.Function):
    """A scalar function whose ``forward`` saves the gradient with respect to its first argument, the only differentiable one."""

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * outer, *[None] * (len(ctx.needs_input_grad) - 1)
