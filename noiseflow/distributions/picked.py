"""Pixels picked from images, for the noise models that look beyond one pixel: at its place, its row or its neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class PickedSignal:
    """Signals of some pixels of images.

    Attributes:
        values: (...) their clean signals, detector units.
        place: (...) where in its image each lies, y·width + x.
        windows: (..., k²) clean signals of the window around each, row by row; None where no model asks for them.
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
"""What models that need an image take: images (..., y, x), or pixels picked from some."""


def values_of(signal: Signal) -> Tensor:
    """The signals alone."""
    return signal.values if isinstance(signal, PickedSignal) else signal


def needs_image(noise_model: nn.Module) -> bool:
    """Whether some part of a noise model looks beyond single pixels."""
    return any(getattr(module, "needs_image", False) for module in noise_model.modules())


def window_size(noise_model: nn.Module) -> int:
    """Side of the largest window that some part of a noise model looks at; 1 where none does."""
    return max(int(getattr(module, "neighbourhood", 1)) for module in noise_model.modules())


def given_to(noise_model: nn.Module, signal: Signal) -> Signal:
    """A signal as a noise model inside another one takes it."""
    return signal if needs_image(noise_model) else values_of(signal)


def require_image(signal: Signal, what: str) -> None:
    """Refuse a flat list of pixels.

    Raises:
        ValueError: the signal has fewer than two axes; the message says `what` needs them.
    """
    if isinstance(signal, Tensor) and signal.ndim < 2:
        raise ValueError(
            f"{what}: give the signal as images (..., y, x); it has shape {tuple(signal.shape)}, in which pixels have no place"
        )


def pick(predict: Callable[[Tensor], Tensor], pixels: Tensor, image: tuple[int, int], window: int) -> PickedSignal:
    """The signals of pixels of a stack of images, and of the windows around them.

    Args:
        predict: flat pixel indices to signals, a `SignalModel`.
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
    """(..., window²) flat indices of the windows around pixels; at the border the outermost pixels stand in for those beyond."""
    height, width = image
    reach = torch.arange(window, device=pixels.device) - window // 2
    frame, place = pixels // (height * width), pixels % (height * width)
    y = (place // width)[..., None, None] + reach[:, None]
    x = (place % width)[..., None, None] + reach
    inside = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    return (frame[..., None, None] * (height * width) + inside).flatten(-2)


def windows_of(signal: Signal, window: int) -> Tensor:
    """(..., window²) signals around every pixel of images, or of picked pixels with windows at least as large."""
    if isinstance(signal, Tensor):
        index = torch.arange(signal.numel(), device=signal.device).reshape(signal.shape)
        return signal.reshape(-1)[window_indices(index, (signal.shape[-2], signal.shape[-1]), window)]
    if signal.windows is None:
        raise ValueError("these pixels were picked without the windows around them; pick them with window_size(model)")
    side = round(signal.windows.shape[-1] ** 0.5)
    edge = (side - window) // 2
    square = signal.windows.reshape(*signal.shape, side, side)
    return square[..., edge : side - edge, edge : side - edge].reshape(*signal.shape, window * window)
