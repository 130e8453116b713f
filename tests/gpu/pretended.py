"""A pretended GPU: tensors "on cuda" that compute on the CPU, and refuse what a real one refuses.

Within `pretended_gpu()`, tensors moved to ``cuda`` or created there say that they are there. As on a GPU, they do not mix with
tensors on the CPU, except for single numbers and indices, and are no NumPy arrays until they are moved back. So a machine
without a GPU finds what has been left on the wrong device; it does not find what differs in the arithmetic.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

GPU = torch.device("cuda", 0)
_MIX = {"copy_", "_to_copy", "index", "index_put", "index_put_", "_index_put_impl_"}  # operations that may
_JOIN = {"cat", "stack", "dot", "mm", "mv", "addmm", "bmm"}  # operations that do not take even a single number


class OnGPU(Tensor):
    """A tensor that says it is on the GPU; `held` is the real one."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> OnGPU:
        strides = held.stride() if held.layout == torch.strided else None
        made = Tensor._make_wrapper_subclass(cls, held.shape, strides=strides, dtype=held.dtype, device="cpu")
        made.held = held
        return made

    @property
    def device(self) -> torch.device:
        return GPU

    @property
    def is_cuda(self) -> bool:
        return True

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        made = OnGPU(self.held.detach().clone()).requires_grad_(self.requires_grad)
        if getattr(self, "_is_param", False):
            made._is_param = True
        memo[id(self)] = made
        return made

    def __repr__(self, **_: Any) -> str:
        return f"OnGPU({self.held!r})"

    def numpy(self, **_: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")

    def tolist(self) -> Any:
        return self.held.tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = {name: value for name, value in (kwargs or {}).items() if name not in ("device", "pin_memory")}
        name = function.overloadpacket.__name__
        tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        if name.startswith("index") and not isinstance(args[0], OnGPU):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        here = [each for each in tensors if not isinstance(each, OnGPU) and (each.ndim > 0 or name in _JOIN)]
        if (
            torch._C._current_graph_task_id() != -1
        ):  # gradients of unused outputs are zeros, made where no one can pretend
            here = [each for each in here if each.layout != torch.strided or bool(each.any())]
        if here and name not in _MIX:
            raise RuntimeError(
                f"Expected all tensors to be on the same device, but one argument of {function} is on cpu"
            )
        plain_args, plain_kwargs = tree_map(_held, (args, kwargs))
        found = function(*plain_args, **plain_kwargs)
        wrapped = tree_map(
            lambda each: OnGPU(each.resolve_conj().resolve_neg()) if isinstance(each, Tensor) else each, found
        )
        if name == "copy_" and not isinstance(args[0], OnGPU):
            return args[0]
        return return_and_correct_aliasing(function, args, kwargs, wrapped)


def _held(value: Any) -> Any:
    return value.held if isinstance(value, OnGPU) else value


class _Moved(torch.autograd.Function):
    """A copy on the other device."""

    @staticmethod
    def forward(ctx: Any, given: Tensor) -> Tensor:
        return given.held.clone() if isinstance(given, OnGPU) else OnGPU(given.detach().clone())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return _Moved.apply(gradient)


def _moved(given: Tensor, device: torch.device | None) -> Tensor:
    wanted = given.device.type if device is None else device.type
    found: Tensor = given if given.device.type == wanted else _Moved.apply(given)
    return found


def _device_of(value: Any) -> torch.device | None:
    if isinstance(value, Tensor):
        return value.device
    return torch.device(value) if isinstance(value, str | torch.device) else None


def _made(make: Callable[..., Any]) -> Callable[..., Any]:
    """A function that makes a tensor on the CPU, or on the pretended GPU where `device` says so."""

    @functools.wraps(make)
    def made(*args: Any, **kwargs: Any) -> Any:
        given = next((each for each in args if isinstance(each, Tensor)), None)
        asked = _device_of(kwargs.pop("device", None))
        if asked is None and make.__name__ != "as_tensor":
            return make(*args, **kwargs)
        found = make(*args, **kwargs)
        return _moved(found, asked or (found if given is None else given).device)

    return made


_to, _new_tensor = Tensor.to, Tensor.new_tensor


def _converted(self: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """`torch.Tensor.to`, with or without a device."""
    devices = [_device_of(each) for each in (*args, kwargs.pop("device", None), kwargs.get("other"))]
    found = _moved(self, next((each for each in devices if each is not None), None))
    kinds = [each.dtype if isinstance(each, Tensor) else each for each in (*args, *kwargs.values())]
    kind = next((each for each in kinds if isinstance(each, torch.dtype)), found.dtype)
    copied = kwargs.get("copy", False) and found is self
    return _to(found, kind, copy=copied) if copied or kind != found.dtype else found


_MAKERS = "tensor zeros ones empty full arange linspace logspace eye rand randn randint randperm hann_window as_tensor"
_ALIKE = "zeros_like ones_like empty_like full_like rand_like randn_like"


def _patches() -> list[Any]:
    made = [mock.patch.object(torch, name, _made(getattr(torch, name))) for name in f"{_MAKERS} {_ALIKE}".split()]
    methods = {
        "to": _converted,
        "cpu": lambda self: _moved(self, torch.device("cpu")),
        "cuda": lambda self, *_: _moved(self, GPU),
        "type_as": _converted,
        "new_tensor": lambda self, *given, **kwargs: _moved(_new_tensor(_held(self), *given, **kwargs), self.device),
    }
    made += [
        mock.patch.object(torch.cuda, "is_available", return_value=True),
        mock.patch.object(torch.cuda, "mem_get_info", return_value=(1 << 34, 1 << 34)),
        mock.patch.object(torch, "Generator", _Generator),
    ]
    return made + [mock.patch.object(Tensor, name, method) for name, method in methods.items()]


class _Generator(torch.Generator):
    """A generator that says which device it is for."""

    place: torch.device

    def __new__(cls, device: Any = "cpu") -> _Generator:
        made = super().__new__(cls, "cpu")
        made.place = torch.device(device)
        return made

    @property
    def device(self) -> torch.device:
        return self.place


@contextmanager
def pretended_gpu() -> Iterator[torch.device]:
    """Pretend that this machine has a GPU; gives its device."""
    before = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with ExitStack() as stack:
            for patch in _patches():
                stack.enter_context(patch)
            yield GPU
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(before)
