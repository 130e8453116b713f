"""Costly elementwise functions: evaluated in pieces, stored without a graph, and twice differentiable."""

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

from noiseflow.distributions.pixels import broadcast_shapes, is_traced
from noiseflow.resources import kept_memory

PIECE = 2**14
"""Pixels evaluated at once: a dozen float64 arrays of this size fit in the cache."""

LONG = 8 * PIECE
"""Above this, releasing memory and allocating it again costs more than keeping it."""

Function = Callable[..., Tensor]


def pixelwise(function: Function, *inputs: Tensor, with_slopes: Callable[..., Any] | None = None) -> Tensor:
    """Apply `function` elementwise, in float64, to tensors that broadcast.

    Only the inputs are stored for the gradient; the function is evaluated again in pieces in the backward pass. Ordinary backward
    passes, ``torch.func`` (grad, vmap, jvp, hessian) and double backward are supported; third derivatives are not.

    Args:
        function: takes one float64 tensor of shape (n,) or () per input, and the keyword ``twice``: whether autograd must be able
            to differentiate the result twice.
        *inputs: tensors that broadcast together; scalars are not expanded.

    Returns:
        The values, float64; NaN where an input is NaN.
    """
    if torch.compiler.is_compiling():
        named: Tensor = _whole(function.__name__, list(inputs))
        return named
    several = [each for each in inputs if each.ndim]
    shape = broadcast_shapes(*(each.shape for each in several)) if several else torch.Size()
    full = [each.expand(shape) if each.ndim else each for each in inputs]
    found: Tensor
    if with_slopes is None or any(is_traced(each) for each in inputs):
        found = _Value.apply(function, *full)  # type: ignore[no-untyped-call]
    elif torch.is_grad_enabled() and any(each.requires_grad for each in full):
        found = _Kept.apply(function, with_slopes, *full)  # type: ignore[no-untyped-call]
    else:
        with torch.no_grad():
            found = _by_pieces(lambda *part: (with_slopes(*part, slopes=False)[0],), full, [True])[0]
    return found


_NAMED: dict[str, Function] = {}


def compilable(function: Function) -> Function:
    """Decorator for functions that `pixelwise` may apply inside ``torch.compile``, where they become single operators."""
    _NAMED[function.__name__] = function
    return function


@torch.library.custom_op("noiseflow::pixelwise", mutates_args=())
def _whole(name: str, inputs: list[Tensor]) -> Tensor:
    """`pixelwise` as one operator: the compiler does not look inside."""
    with torch.no_grad():
        return pixelwise(_NAMED[name], *inputs)


@_whole.register_fake
def _(name: str, inputs: list[Tensor]) -> Tensor:
    shape = broadcast_shapes(*(each.shape for each in inputs))
    return torch.empty(shape, dtype=torch.float64, device=inputs[0].device)


@torch.library.custom_op("noiseflow::pixelwise_slopes", mutates_args=())
def _whole_slopes(name: str, inputs: list[Tensor], gradient: Tensor) -> list[Tensor]:
    full = _expanded(inputs)
    # torch switches autograd off inside operators
    with torch._C._SetExcludeDispatchKeyGuard(torch._C.DispatchKey.AutogradFunctionality, False):
        found = _vector_product(_NAMED[name], gradient.contiguous(), full, [True] * len(inputs))
    return [
        torch.zeros_like(each) if slope is None else slope.sum_to_size(each.shape).to(each.dtype).clone()
        for slope, each in zip(found, inputs, strict=True)
    ]


@_whole_slopes.register_fake
def _(name: str, inputs: list[Tensor], gradient: Tensor) -> list[Tensor]:
    return [torch.empty_like(each) for each in inputs]


def _keep_whole(ctx: Any, inputs: tuple[str, list[Tensor]], output: Tensor) -> None:
    ctx.name = inputs[0]
    ctx.save_for_backward(*inputs[1])


_whole.register_autograd(
    lambda ctx, gradient: (None, _whole_slopes(ctx.name, list(ctx.saved_tensors), gradient)), setup_context=_keep_whole
)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.function = inputs[0]
    ctx.save_for_backward(*inputs[1:])
    ctx.save_for_forward(*inputs[1:])


class _Value(torch.autograd.Function):
    setup_context = staticmethod(_keep)

    @staticmethod
    def forward(function: Function, *inputs: Tensor) -> Tensor:
        with torch.no_grad():
            return _by_pieces(lambda *part: (function(*part),), inputs, [True])[0]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        if not torch.is_grad_enabled():
            return None, *_vector_product(ctx.function, gradient, inputs, ctx.needs_input_grad[1:])
        slopes = _Slopes.apply(ctx.function, *inputs)  # type: ignore[no-untyped-call]
        return None, *_summed([gradient * slope for slope in slopes], inputs)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> Tensor:
        slopes = _Slopes.apply(ctx.function, *ctx.saved_tensors)  # type: ignore[no-untyped-call]
        parts = [slope * tangent for slope, tangent in zip(slopes, tangents, strict=True) if tangent is not None]
        total: Tensor = sum(parts[1:], parts[0])
        return total

    @staticmethod
    def vmap(info: Any, in_dims: Sequence[int | None], function: Function, *inputs: Tensor) -> tuple[Tensor, int]:
        return pixelwise(function, *_unbatched(info.batch_size, in_dims[1:], inputs)), 0


class _Kept(torch.autograd.Function):
    """The value with its derivatives, computed together and stored."""

    @staticmethod
    def forward(ctx: Any, function: Function, with_slopes: Callable[..., Any], *inputs: Tensor) -> Tensor:
        needed = ctx.needs_input_grad[2:]

        def both(*part: Tensor) -> tuple[Tensor, ...]:
            value, slopes = with_slopes(*part, slopes=True)
            return value, *slopes

        value, *slopes = _by_pieces(both, inputs, [True, *needed])
        ctx.function, ctx.count = function, len(inputs)
        ctx.save_for_backward(*inputs, *slopes)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, kept = ctx.saved_tensors[: ctx.count], iter(ctx.saved_tensors[ctx.count :])
        if torch.is_grad_enabled():  # to be differentiated again
            slopes = _Slopes.apply(ctx.function, *inputs)  # type: ignore[no-untyped-call]
            return None, None, *_summed([gradient * slope for slope in slopes], inputs)
        products = [gradient * next(kept) if need else None for need in ctx.needs_input_grad[2:]]
        return None, None, *_summed(products, inputs)


class _Slopes(torch.autograd.Function):
    """The derivatives of the function with respect to each input, (n,) each."""

    setup_context = staticmethod(_keep)

    @staticmethod
    def forward(function: Function, *inputs: Tensor) -> tuple[Tensor, ...]:
        return _by_pieces(lambda *part: _slopes(function, part, twice=False), inputs, [True] * len(inputs))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        curved = _Curvature.apply(ctx.function, *ctx.saved_tensors, *gradients)  # type: ignore[no-untyped-call]
        return None, *_summed(curved, ctx.saved_tensors)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        inputs = ctx.saved_tensors
        shape = _shape_of(inputs)
        full = [
            torch.zeros((), dtype=at.dtype, device=at.device).expand(shape) if each is None else each.expand(shape)
            for each, at in zip(tangents, inputs, strict=True)
        ]
        # the matrix of second derivatives is symmetric: its product with the tangents is that of the backward pass
        found: tuple[Tensor, ...] = _Curvature.apply(ctx.function, *inputs, *full)  # type: ignore[no-untyped-call]
        return found

    @staticmethod
    def vmap(info: Any, in_dims: Sequence[int | None], function: Function, *inputs: Tensor) -> tuple[Any, Any]:
        found = _Slopes.apply(function, *_expanded(_unbatched(info.batch_size, in_dims[1:], inputs)))  # type: ignore[no-untyped-call]
        return found, (0,) * len(inputs)


class _Curvature(torch.autograd.Function):
    """Hessian of each pixel times a vector; takes the inputs, then the entries of the vector."""

    @staticmethod
    def forward(function: Function, *tensors: Tensor) -> tuple[Tensor, ...]:
        half = len(tensors) // 2

        def curved(*part: Tensor) -> tuple[Tensor, ...]:
            with torch.enable_grad():
                at = _leaves(part[:half])
                slopes = _slopes(function, at, twice=True)
                total = sum((s * v.detach() for s, v in zip(slopes, part[half:], strict=True)), torch.zeros(()))
                return _gradients(total, at)

        return _by_pieces(curved, tensors, [True] * half)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        """Store nothing, because there is no third derivative."""

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> None:
        raise NotImplementedError("this likelihood has no third derivative; use derivatives up to the Hessian")

    @staticmethod
    def vmap(info: Any, in_dims: Sequence[int | None], function: Function, *tensors: Tensor) -> tuple[Any, Any]:
        found = _Curvature.apply(function, *_expanded(_unbatched(info.batch_size, in_dims[1:], tensors)))  # type: ignore[no-untyped-call]
        return found, (0,) * (len(tensors) // 2)


def _shape_of(inputs: Sequence[Tensor]) -> torch.Size:
    return next((each.shape for each in inputs if each.ndim), torch.Size())


def _leaves(part: Sequence[Tensor]) -> list[Tensor]:
    """(n,) leaves of the graph of one piece; scalars are repeated, because each pixel has its own derivative."""
    size = max(each.numel() for each in part)
    return [each.detach().double().expand(size).clone().requires_grad_() for each in part]


def _slopes(function: Function, part: Sequence[Tensor], *, twice: bool) -> tuple[Tensor, ...]:
    with torch.enable_grad():
        at = part if twice else _leaves(part)
        value = function(*at, twice=twice)
        return _gradients(value, at, create_graph=twice)


def _gradients(value: Tensor, at: Sequence[Tensor], *, create_graph: bool = False) -> tuple[Tensor, ...]:
    if not value.requires_grad:
        return tuple(torch.zeros_like(each) for each in at)
    found = torch.autograd.grad(value.sum(), at, create_graph=create_graph, allow_unused=True)
    return tuple(torch.zeros_like(a) if each is None else each for each, a in zip(found, at, strict=True))


def _vector_product(
    function: Function, gradient: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool]
) -> list[Tensor | None]:
    """The gradient of each input that needs one, in pieces; gradients of scalars are summed."""
    wanted = [i for i, need in enumerate(needed) if need]
    flat = gradient.reshape(-1)
    flat_inputs, count = [each.detach().reshape(-1) if each.ndim else each.detach() for each in inputs], flat.numel()
    found = [torch.zeros(count if inputs[i].ndim else 1, dtype=torch.float64, device=flat.device) for i in wanted]
    for start in range(0, count, PIECE):
        part = [each[start : start + PIECE].double() if each.ndim else each.double() for each in flat_inputs]
        nothing, part = _without_nan(part)
        at = [part[i].requires_grad_() for i in wanted]
        with torch.enable_grad():
            value = function(*part).reshape(-1)
            if not value.requires_grad:
                continue
            good = flat[start : start + PIECE].to(value.dtype)
            good = good if nothing is None else good.masked_fill(nothing.reshape(-1), 0.0)
            # given as an argument, a gradient makes torch import sympy: 0.5 s and 40 MiB
            slopes = torch.autograd.grad(torch.dot(value, good), at, allow_unused=True)
        for total, i, slope in zip(found, wanted, slopes, strict=True):
            if slope is not None and inputs[i].ndim:
                total[start : start + PIECE] = slope
            elif slope is not None:
                total += slope
    totals = dict(zip(wanted, found, strict=True))
    return [totals[i].reshape(each.shape).to(each.dtype) if i in totals else None for i, each in enumerate(inputs)]


def _summed(slopes: Sequence[Tensor | None], inputs: Sequence[Tensor]) -> list[Tensor | None]:
    """The slopes of the pixels as gradients of the inputs: those of scalars are summed."""
    pairs = zip(slopes, inputs, strict=True)
    return [None if s is None else (s if each.ndim else s.sum()).to(each.dtype) for s, each in pairs]


def _by_pieces(
    function: Callable[..., tuple[Tensor, ...]], inputs: Sequence[Tensor], wanted: Sequence[bool]
) -> tuple[Tensor, ...]:
    """The requested outputs, float64, shaped like the non-scalar inputs; NaN where an input is NaN."""
    shape = _shape_of(inputs)
    size, device = math.prod(shape), inputs[0].device
    found = [torch.empty(size, dtype=torch.float64, device=device) for want in wanted if want]
    flat = [each.reshape(-1) if each.ndim else each for each in inputs]
    with kept_memory() if size > LONG else nullcontext():
        for start in range(0, size, PIECE):
            part = [each[start : start + PIECE].double() if each.ndim else each.double() for each in flat]
            nothing, part = _without_nan(part)
            values = (value for value, want in zip(function(*part), wanted, strict=True) if want)
            for out, value in zip(found, values, strict=True):
                out[start : start + PIECE] = value if nothing is None else value.masked_fill(nothing, math.nan)
    return tuple(each.reshape(shape) for each in found)


def _without_nan(part: list[Tensor]) -> tuple[Tensor | None, list[Tensor]]:
    """Mask of pixels where an input is NaN (None if there are none), and the inputs with NaN replaced by 1."""
    total = sum(each if each.ndim else each.detach() for each in part)
    nothing = torch.isnan(total)  # type: ignore[arg-type]
    if not bool(nothing.any()):
        return None, part
    nothing = torch.stack(torch.broadcast_tensors(*(torch.isnan(each) for each in part))).any(0)  # type: ignore[no-untyped-call]
    return nothing, [torch.nan_to_num(each, nan=1.0, posinf=math.inf, neginf=-math.inf) for each in part]


def _unbatched(size: int, in_dims: Sequence[int | None], inputs: Sequence[Tensor]) -> list[Tensor]:
    """Inputs with the batch axis first; inputs without a batch axis get one of length 1."""
    ndim = max(each.ndim - (dim is not None) for each, dim in zip(inputs, in_dims, strict=True))
    found = []
    for each, dim in zip(inputs, in_dims, strict=True):
        if dim is None and each.ndim == 0:
            found.append(each)
            continue
        moved = each.unsqueeze(0) if dim is None else each.movedim(dim, 0)
        moved = moved.reshape(moved.shape[0], *(1,) * (ndim + 1 - moved.ndim), *moved.shape[1:])
        found.append(moved.expand(size, *moved.shape[1:]))
    return found


def _expanded(inputs: Sequence[Tensor]) -> list[Tensor]:
    shape = broadcast_shapes(*(each.shape for each in inputs if each.ndim))
    return [each.expand(shape) if each.ndim else each for each in inputs]
