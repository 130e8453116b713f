"""Single steps of an optimiser that a number that is not finite cannot spoil."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor


def _without_compiler(kind: type[torch.optim.Optimizer]) -> Any:
    """An optimiser without the guards that keep torch's compiler out of its methods: the first call of one loads the whole
    compiler, which takes seconds."""
    names = ("add_param_group", "load_state_dict", "state_dict", "zero_grad")
    methods = {name: inspect.unwrap(getattr(kind, name)) for name in names}
    return type(kind.__name__, (kind,), methods | {"step": torch.no_grad()(inspect.unwrap(kind.step))})


_Adam, _LBFGS = _without_compiler(torch.optim.Adam), _without_compiler(torch.optim.LBFGS)


def adam(groups: Iterable[dict[str, Any]]) -> torch.optim.Optimizer:
    """Adam, with a short memory of the gradients' sizes."""
    optimiser: torch.optim.Optimizer = _Adam(list(groups), betas=(0.9, 0.99), fused=True)
    return optimiser


def lbfgs(parameters: Iterable[Tensor], *, max_iter: int, history_size: int = 100) -> torch.optim.LBFGS:
    """L-BFGS with a line search by the strong Wolfe conditions."""
    optimiser: torch.optim.LBFGS = _LBFGS(
        list(parameters), max_iter=max_iter, history_size=history_size, line_search_fn="strong_wolfe"
    )
    return optimiser


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
