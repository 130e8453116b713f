"""Single steps of an optimiser that a number that is not finite cannot spoil."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor


class _Adam(torch.optim.Adam):
    """Adam without the guards that keep torch's compiler out of its methods: the first call of one loads the whole compiler,
    which takes seconds."""

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)


def adam(groups: Iterable[dict[str, Any]]) -> torch.optim.Optimizer:
    """Adam, with a short memory of the gradients' sizes."""
    return _Adam(list(groups), betas=(0.9, 0.99), fused=True)


def take_step(optimiser: torch.optim.Optimizer, loss: Callable[[], Tensor]) -> bool:
    """One step of an optimiser; False, and no step, where loss or gradient is not finite."""
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
