"""Selected pixels of images, for noise models that depend on a pixel's position, row or neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn


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
