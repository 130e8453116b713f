"""Handling of arguments and results shared by all noise distributions.

This module handles data types, NaN and infinity, probabilities outside [0, 1] and shapes that do not broadcast. Large inputs
are evaluated in pieces; if a gradient is needed, each piece is evaluated again in the backward pass.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from noiseflow.distributions.numerics import tables
from noiseflow.distributions.numerics.tables import LARGE
from noiseflow.distributions.pixels import all_finite, broadcast_shapes, is_traced

Method = Callable[..., Tensor]


def answering(cls: type) -> None:
    """Wrap the methods that a class defines so that they handle arguments and results as described above."""
    for name, wrap in _WRAPPERS.items():
        method = cls.__dict__.get(name)
        if callable(method) and not getattr(method, "__isabstractmethod__", False):
            setattr(cls, name, wrap(method, name))
    for name in ("mean", "variance"):
        found = cls.__dict__.get(name)
        if isinstance(found, property) and found.fget is not None:
            setattr(cls, name, property(_cast(found.fget), doc=found.__doc__))


def _cast(getter: Callable[[Any], Tensor]) -> Callable[[Any], Tensor]:
    @functools.wraps(getter)
    def get(self: Any) -> Tensor:
        return self.cast(getter(self))  # type: ignore[no-any-return]

    return get


def _taken(self: Any, name: str, values: Sequence[Any]) -> tuple[list[Tensor], torch.dtype]:
    """Values as floating-point tensors of the working type or wider, and the type of the result."""
    tensors = [
        v if isinstance(v, Tensor) else torch.as_tensor(v, dtype=self.working_dtype, device=self.device) for v in values
    ]
    answer: torch.dtype = self.dtype
    for value in values:
        if isinstance(value, Tensor) and value.is_floating_point():
            answer = torch.promote_types(answer, value.dtype)
    working = torch.promote_types(answer, torch.float32)
    try:
        shape = broadcast_shapes(self.batch_shape, *(tensor.shape for tensor in tensors))
    except (RuntimeError, ValueError) as error:
        given_shapes = " and ".join(str(tuple(tensor.shape)) for tensor in tensors)
        raise ValueError(
            f"{name}: a value of shape {given_shapes} does not broadcast with the signal's {tuple(self.batch_shape)}; "
            "give one observation per pixel, or leading axes for several"
        ) from error
    kinds = [torch.promote_types(t.dtype if t.is_floating_point() else working, working) for t in tensors]
    return [self.widened(t, kind).expand(shape) for t, kind in zip(tensors, kinds, strict=True)], answer


def _of_value(method: Method, name: str) -> Method:
    density = name == "log_prob"

    @functools.wraps(method)
    def call(self: Any, value: Any) -> Tensor:
        (tensor,), answer = _taken(self, name, [value])
        compute = functools.partial(_looked_up, method, self) if density else functools.partial(method, self)
        if (density and self.takes_missing) or (not is_traced(tensor) and all_finite(tensor)):
            return compute(tensor).to(answer)
        finite = torch.isfinite(tensor)
        found = compute(torch.where(finite, tensor, torch.zeros_like(tensor)))
        infinite = -math.inf if density else (tensor > 0).to(found.dtype)
        return torch.where(finite, found, torch.where(torch.isnan(tensor), math.nan, infinite).to(found)).to(answer)

    return call


def _interval(method: Method, name: str) -> Method:
    @functools.wraps(method)
    def log_interval_prob(self: Any, low: Any, high: Any) -> Tensor:
        (below, above), answer = _taken(self, name, [low, high])
        proper = below < above
        if not is_traced(below) and bool(proper.all()):
            return in_pieces(method, self, below, above).to(answer)
        zero = torch.zeros_like(below)
        found = in_pieces(method, self, torch.where(proper, below, zero), torch.where(proper, above, zero + 1))
        instead = torch.where(torch.isnan(below) | torch.isnan(above), math.nan, -math.inf).to(found)
        return torch.where(proper, found, instead).to(answer)

    return log_interval_prob


def _quantile(method: Method, name: str) -> Method:
    @functools.wraps(method)
    def icdf(self: Any, value: Any) -> Tensor:
        (tensor,), answer = _taken(self, name, [value])
        inside = (tensor > 0) & (tensor < 1)
        if not is_traced(tensor):
            if bool(inside.all()):
                return method(self, tensor).to(answer)
            outside = (tensor < 0) | (tensor > 1)
            if bool(outside.any()):
                worst = float(tensor[outside].flatten()[0])
                raise ValueError(f"icdf: {worst:g} is not a probability; give values from 0 to 1")
        found = method(self, torch.where(inside, tensor, torch.full_like(tensor, 0.5)))
        low, high = (end.to(found) for end in self.limits)
        ends = torch.where(tensor == 0, low, torch.where(tensor == 1, high, math.nan))
        return torch.where(inside, found, ends).to(answer)

    return icdf


def _draw(method: Method, name: str) -> Method:
    @functools.wraps(method)
    def sample(self: Any, sample_shape: Any = (), generator: torch.Generator | None = None) -> Tensor:
        sizes = [sample_shape] if isinstance(sample_shape, int) else sample_shape
        if not isinstance(sizes, Sequence) or any(not isinstance(size, int) or size < 0 for size in sizes):
            raise ValueError(f"sample_shape is {sample_shape!r}; give a number of draws or a shape, such as (10, 2)")
        if not isinstance(generator, torch.Generator | None):
            raise TypeError(f"generator is {generator!r}; for a seed give torch.Generator().manual_seed(seed)")
        shape = torch.Size(sizes)
        with torch.no_grad():
            whole = torch.Size([*shape, *self.batch_shape])
            found = _drawn_from_table(self, whole, generator)
            if found is not None:
                return found
            if not (self.independent and whole.numel() > LARGE) or torch.compiler.is_compiling() or not self.splits:
                return self.cast(method(self, shape, generator=generator))  # type: ignore[no-any-return]
            parts = self.expand(whole).flat().parts(LARGE)
            drawn = [self.cast(method(part, torch.Size(), generator=generator)) for part in parts]
            return torch.cat(drawn).reshape(whole)

    return sample


def _drawn_from_table(self: Any, shape: torch.Size, generator: torch.Generator | None) -> Tensor | None:
    if shape.numel() < LARGE or torch.compiler.is_compiling() or self.source is None:
        return None
    model, signal = self.source
    if not (hasattr(self, "from_latent") and tables.may_tabulate(model)):
        return None
    found = tables.sample(model, signal.expand(shape), generator)
    return None if found is None else self.cast(found)


def _looked_up(method: Method, self: Any, value: Tensor) -> Tensor:
    """Look the result up in a table if an accurate one exists, otherwise compute it. Light distributions are always computed."""
    if value.numel() >= LARGE and self.source is not None and not self.light:
        model, signal = self.source
        large = tables.is_large(model, signal, value)
        if large and (found := tables.log_prob(model, signal, value)) is not None:
            return found
    return in_pieces(method, self, value)


def in_pieces(method: Method, self: Any, *values: Tensor, size: int = LARGE) -> Tensor:
    """The method's result for values (..., *batch), in pieces of at most `size` pixels if there are more."""
    shape = broadcast_shapes(self.batch_shape, *(value.shape for value in values))
    traced = torch.compiler.is_compiling() or torch._C._functorch.peek_interpreter_stack() is not None
    if shape.numel() <= size or not self.independent or self.light or traced or not self.splits:
        return method(self, *values)
    whole = self if self.batch_shape == shape else self.expand(shape)
    split = [torch.split(value.expand(shape).reshape(-1), size) for value in values]
    found = [_again(method, part, *some) for part, *some in zip(whole.flat().parts(size), *split, strict=True)]
    return torch.cat(found).reshape(shape)


def _again(method: Method, part: Any, *values: Tensor) -> Tensor:
    """The result for one piece; its graph is not stored but rebuilt in the backward pass."""

    def fresh(*some: Tensor) -> Tensor:  # values cached by a distribution belong to one pass
        return method(part.mapped(lambda tensor, rest: tensor, part.batch_shape), *some)

    if not torch.is_grad_enabled():
        return fresh(*values)
    found: Tensor = checkpoint(fresh, *values, use_reentrant=False, preserve_rng_state=False)
    return found


_WRAPPERS = {
    "log_prob": _of_value,
    "log_interval_prob": _interval,
    "cdf": _of_value,
    "cdf_below": _of_value,
    "icdf": _quantile,
    "sample": _draw,
}
