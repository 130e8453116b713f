"""Pixels: base class for batches of them, with data type, device, expanding and splitting; and selections from images, for noise
models that depend on a pixel's position, row or neighbours."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

Kept = TypeVar("Kept")
Taking = Callable[[Tensor, tuple[int, ...]], Tensor]


class PixelBatch:
    """A batch of independent pixels.

    Attributes:
        independent: whether pixels can be evaluated independently of each other.
        takes_missing: whether `log_prob` handles NaN observations itself.
        light: whether a gradient stores only a few numbers per pixel, so that evaluation in pieces has no benefit.
        per_pixel: names of the attributes that hold one value or row of values per pixel; None for all tensors whose first
            axes are the batch axes.
    """

    independent: ClassVar[bool] = True
    takes_missing: ClassVar[bool] = False
    per_pixel: ClassVar[tuple[str, ...] | None] = None
    light: ClassVar[bool] = False

    @property
    def source(self) -> tuple[nn.Module, Tensor] | None:
        """The noise model and the signal if likelihoods of large inputs may be looked up in tables, otherwise None."""
        return None

    def _set_kind(self, like: Tensor | None) -> None:
        floating = like is not None and like.is_floating_point()
        self._given_dtype = None if like is None else like.dtype if floating else torch.get_default_dtype()
        self._given_device = None if like is None else like.device
        self._computed: dict[tuple[str, bool], Any] = {}

    def once(self, compute: Callable[[], Kept]) -> Kept:
        """The cached result of `compute`, computed once with gradients and once without."""
        key = compute.__qualname__, torch.is_grad_enabled()
        if key not in self._computed:
            self._computed[key] = compute()
        kept: Kept = self._computed[key]
        return kept

    def _pixels(self) -> Tensor | None:
        """A tensor of the batch shape, for subclasses that do not set the data type of their results."""
        held = (value for value in vars(self).values() if isinstance(value, Tensor) and value.is_floating_point())
        return next((value for value in held if value.shape == self.batch_shape), None)

    @property
    def dtype(self) -> torch.dtype:
        """Data type of samples, means and variances."""
        if self._given_dtype is not None:
            return self._given_dtype
        pixels = self._pixels()
        return torch.get_default_dtype() if pixels is None else pixels.dtype

    @property
    def device(self) -> torch.device:
        """Device of samples, means and variances."""
        if self._given_device is not None:
            return self._given_device
        pixels = self._pixels()
        return torch.get_default_device() if pixels is None else pixels.device

    @property
    def working_dtype(self) -> torch.dtype:
        """Data type of the computation, at least single precision."""
        return torch.promote_types(self.dtype, torch.float32)

    def working(self, tensor: Tensor) -> Tensor:
        """Convert a tensor to the working data type unless its own is wider."""
        return tensor.to(torch.promote_types(tensor.dtype, self.working_dtype))

    def widened(self, value: Tensor, dtype: torch.dtype) -> Tensor:
        """Convert an observation to a data type that is at least as wide as its own."""
        return value.to(dtype)

    def clean(self, signal: Tensor) -> Tensor:
        """Convert a signal to the working data type; non-finite signals become NaN, and so do all results for them."""
        signal = self.working(signal)
        if is_traced(signal) or not all_finite(signal):
            return torch.where(torch.isfinite(signal), signal, torch.full_like(signal, math.nan))
        return signal

    def cast(self, tensor: Tensor) -> Tensor:
        """Convert a result to the data type of the signal."""
        return tensor if self._given_dtype is None else tensor.to(self._given_dtype)

    def anything(self) -> Tensor:
        """A scalar of the working data type on the device."""
        return torch.zeros((), dtype=self.working_dtype, device=self.device)

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of the signal."""
        shape: torch.Size = self._batch_shape  # type: ignore[attr-defined]
        return shape

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Self:
        """The same distribution for a larger batch; pixels along a new or expanded axis are independent of each other."""
        shape = torch.Size(batch_shape)
        broadcast_shapes(self.batch_shape, shape)
        return self if shape == self.batch_shape else self.mapped(lambda each, rest: each.expand(*shape, *rest), shape)

    def flat(self) -> Self:
        """The same pixels with one batch axis."""
        return self.mapped(lambda tensor, rest: tensor.reshape(-1, *rest), torch.Size([math.prod(self.batch_shape)]))

    def parts(self, size: int) -> list[Self]:
        """Split a batch with one axis into distributions of `size` consecutive pixels each."""
        split: dict[int, tuple[Tensor, tuple[Tensor, ...]]] = {}  # keeps the tensor alive, so that its id is not reused

        def part(index: int) -> Taking:
            return lambda tensor, rest: split.setdefault(id(tensor), (tensor, torch.split(tensor, size)))[1][index]

        count = self.batch_shape[0]
        starts = range(0, count, size)
        return [self.mapped(part(i), torch.Size([min(size, count - at)])) for i, at in enumerate(starts)]

    def mapped(self, take: Taking, shape: torch.Size) -> Self:
        """A copy with every per-pixel tensor replaced by ``take(tensor, shape of the axes after the batch axes)``."""
        other = copy.copy(self)
        other._batch_shape, other._computed = shape, {}  # type: ignore[attr-defined]
        size = len(self.batch_shape)
        for name, value in vars(self).items():
            if isinstance(getattr(type(self), name, None), cached_property):
                del other.__dict__[name]
            elif isinstance(value, PixelBatch):
                setattr(other, name, value.mapped(take, shape))
            elif isinstance(value, Tensor) and self._is_per_pixel(name, value):
                setattr(other, name, take(value, tuple(value.shape[size:])))
        return other

    @property
    def splits(self) -> bool:
        """Whether the distribution can be split into pixels. It cannot if a tensor may hold pixels along axes other than the
        leading ones, or stands inside a list, a dictionary or another object."""
        for name, value in vars(self).items():
            if isinstance(value, PixelBatch) and not value.splits:
                return False
            if isinstance(value, Tensor) and value.numel() > 1 and not self._is_per_pixel(name, value):
                return self.per_pixel is not None
        return self.per_pixel is not None or not any(_hides_pixels(value) for value in vars(self).values())

    def _is_per_pixel(self, name: str, tensor: Tensor) -> bool:
        if self.per_pixel is not None:
            return name in self.per_pixel
        return tensor.shape[: len(self.batch_shape)] == self.batch_shape

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.batch_shape)) or "1"
        kind = str(self.dtype).removeprefix("torch.")
        inside = getattr(self, "base", None)
        of = f", of {type(inside).__name__}" if isinstance(inside, PixelBatch) else ""
        return f"{type(self).__name__}({shape} pixels, {kind}, {self.device}{of})"


def _hides_pixels(value: Any) -> bool:
    """Whether a tensor of several elements stands inside this object, where no rule says which of its axes are pixels."""
    if isinstance(value, PixelBatch | Tensor | nn.Module):
        return False
    inside = value if isinstance(value, list | tuple | set) else getattr(value, "__dict__", value)
    held = inside.values() if isinstance(inside, dict) else inside if isinstance(inside, list | tuple | set) else ()
    return any(each.numel() > 1 if isinstance(each, Tensor) else _hides_pixels(each) for each in held)


def is_traced(tensor: Tensor) -> bool:
    """Whether values are not accessible: inside ``torch.compile`` or a transform of ``torch.func``."""
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def all_finite(tensor: Tensor) -> bool:
    """Whether all values are finite. Their sum shows it in a tenth of the time, unless it overflows."""
    return math.isfinite(float(tensor.detach().sum())) or bool(torch.isfinite(tensor).all())


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """The shape that all shapes broadcast to. Uses NumPy, because the first call of torch's function loads SymPy (1 s). Raises
    ValueError if the shapes do not broadcast (RuntimeError inside ``torch.compile``)."""
    if torch.compiler.is_compiling():
        return torch.broadcast_shapes(*shapes)  # type: ignore[no-any-return, no-untyped-call]
    return torch.Size(np.broadcast_shapes(*map(tuple, shapes)))


@dataclass(frozen=True)
class PickedSignal:
    """Signals of selected pixels of images.

    Attributes:
        values: (...) clean signals, detector units.
        place: (...) position of each pixel in its image, y·width + x.
        windows: (..., k²) clean signals of the window around each pixel, row by row; None if no model needs them.
    """

    values: Tensor
    place: Tensor
    windows: Tensor | None = None

    @property
    def shape(self) -> torch.Size:
        return self.values.shape

    def __getitem__(self, part: Any) -> PickedSignal:
        return PickedSignal(self.values[part], self.place[part], None if self.windows is None else self.windows[part])


Signal = Tensor | PickedSignal
"""Input of models that need images: images (..., y, x), or pixels selected from them."""


def values_of(signal: Signal) -> Tensor:
    """The signal values."""
    return signal.values if isinstance(signal, PickedSignal) else signal


def needs_image(noise_model: nn.Module) -> bool:
    """Whether any part of a noise model needs images rather than single pixels."""
    return any(getattr(module, "needs_image", False) for module in noise_model.modules())


def window_size(noise_model: nn.Module) -> int:
    """Side of the largest window that any part of a noise model uses; 1 if none uses a window."""
    return max(int(getattr(module, "neighbourhood", 1)) for module in noise_model.modules())


def given_to(noise_model: nn.Module, signal: Signal) -> Signal:
    """The signal in the form that a nested noise model takes."""
    return signal if needs_image(noise_model) else values_of(signal)


def require_image(signal: Signal, what: str) -> None:
    """Check that a signal has image axes. Raises ValueError if the signal has fewer than two axes; `what` names the model in the
    message."""
    if isinstance(signal, Tensor) and signal.ndim < 2:
        raise ValueError(f"{what}: give signals as images (..., y, x); shape {tuple(signal.shape)} has no image axes")


def pick(predict: Callable[[Tensor], Tensor], pixels: Tensor, image: tuple[int, int], window: int) -> PickedSignal:
    """Signals of selected pixels of a stack of images, and of the windows around them.

    Args:
        predict: function from flat pixel indices to signals, a `SignalModel`.
        pixels: flat indices, any shape.
        image: height and width of each image.
        window: side of the windows, odd; 1 for none.
    """
    size = image[0] * image[1]
    if window == 1:
        return PickedSignal(predict(pixels.reshape(-1)).reshape(pixels.shape), pixels % size)
    around = window_indices(pixels, image, window)
    windows = predict(around.reshape(-1)).reshape(around.shape)
    return PickedSignal(windows[..., window * window // 2], pixels % size, windows)


def window_indices(pixels: Tensor, image: tuple[int, int], window: int) -> Tensor:
    """(..., window²) flat indices of the windows around pixels; borders are padded with the nearest pixel."""
    height, width = image
    reach = torch.arange(window, device=pixels.device) - window // 2
    frame, place = pixels // (height * width), pixels % (height * width)
    y = (place // width)[..., None, None] + reach[:, None]
    x = (place % width)[..., None, None] + reach
    inside = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    return (frame[..., None, None] * (height * width) + inside).flatten(-2)


def windows_of(signal: Signal, window: int) -> Tensor:
    """(..., window²) signals around every pixel of images, or of selected pixels with windows at least as large."""
    if isinstance(signal, Tensor):
        index = torch.arange(signal.numel(), device=signal.device).reshape(signal.shape)
        return signal.reshape(-1)[window_indices(index, (signal.shape[-2], signal.shape[-1]), window)]
    if signal.windows is None:
        raise ValueError("these pixels lack the windows around them; call pick() with window=window_size(model)")
    side = round(signal.windows.shape[-1] ** 0.5)
    edge = (side - window) // 2
    square = signal.windows.reshape(*signal.shape, side, side)
    return square[..., edge : side - edge, edge : side - edge].reshape(*signal.shape, window * window)
