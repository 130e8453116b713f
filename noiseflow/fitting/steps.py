"""Single optimiser steps that are skipped if loss or gradient is not finite."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor


def _without_compiler(kind: type[torch.optim.Optimizer]) -> Any:
    """An optimiser class without torch's compiler guards, whose first call loads the compiler and takes seconds."""
    names = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
    methods = {name: inspect.unwrap(getattr(kind, name)) for name in names}
    return type(kind.__name__, (kind,), methods | {"step": torch.no_grad()(inspect.unwrap(kind.step))})


_Adam, _LBFGS = _without_compiler(torch.optim.Adam), _without_compiler(torch.optim.LBFGS)


def adam(groups: Iterable[dict[str, Any]]) -> torch.optim.Optimizer:
    """Adam with a short memory of squared gradients."""
    optimiser: torch.optim.Optimizer = _Adam(list(groups), betas=(0.9, 0.99), fused=True)
    return optimiser


def lbfgs(parameters: Iterable[Tensor], *, max_iter: int, history_size: int = 100) -> torch.optim.LBFGS:
    """L-BFGS with a strong-Wolfe line search."""
    optimiser: torch.optim.LBFGS = _LBFGS(
        list(parameters), max_iter=max_iter, history_size=history_size, line_search_fn="strong_wolfe"
    )
    return optimiser


def take_step(optimiser: torch.optim.Optimizer, loss: Callable[[], Tensor]) -> bool:
    """Take one optimiser step. Return False, without a step, if loss or gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    value = loss()
    if not bool(torch.isfinite(value)):
        return False
    value.backward()  # type: ignore[no-untyped-call]
    gradients = [p.grad for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    if not all(bool(torch.isfinite(gradient.sum())) for gradient in gradients):
        return False
    optimiser.step()
    return True
