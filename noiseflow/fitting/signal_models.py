"""Models of the clean signal that ship with the library: a known image, and a still scene seen many times."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arrays import as_tensor
from noiseflow.models.base import Described


class KnownSignal(Described):
    """A known clean image as a signal model: nothing to learn.

    Args:
        signal: clean image, any shape, detector units.
    """

    flat: Tensor

    def __init__(self, signal: Tensor | NDArray[Any]) -> None:
        super().__init__()
        self.register_buffer("flat", as_tensor(signal).detach().reshape(-1))

    def forward(self, pixels: Tensor) -> Tensor:
        return self.flat[pixels]

    def extra_repr(self) -> str:
        return f"{self.flat.numel()} pixels"

    def signal(self) -> Tensor:
        """All pixels, flat."""
        return self.flat


class StaticScene(Described):
    """Repeated exposures of one still scene: the clean image is learnt, one value per pixel.

    Args:
        exposures: (n, ...) repeated exposures, detector units; the clean image starts at their mean.

    Raises:
        ValueError: fewer than two exposures.
    """

    def __init__(self, exposures: Tensor | NDArray[Any]) -> None:
        super().__init__()
        if exposures.shape[0] < 2:
            raise ValueError("a static scene needs at least two exposures; one exposure cannot tell signal from noise")
        self.count = exposures.shape[0]
        mean = as_tensor(exposures).to(torch.get_default_dtype()).mean(0)
        self.shape = mean.shape
        self.scene = nn.Parameter(mean.reshape(-1).clone())

    def forward(self, pixels: Tensor) -> Tensor:
        return self.scene[pixels % self.scene.numel()]

    def signal(self) -> Tensor:
        """All pixels of all exposures, flat."""
        return self.scene.repeat(self.count)

    def extra_repr(self) -> str:
        return f"{self.count} exposures of {' x '.join(map(str, self.shape))} pixels"

    def image(self) -> Tensor:
        """The clean image."""
        return self.scene.detach().reshape(self.shape)
