"""What the library's modules have in common: a repr of one line, and calls with NumPy arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import nn

from noiseflow.arrays import ArrayDistribution, floating


class Described(nn.Module):
    """A module whose repr is one line: its settings, the described modules inside, and its units.

    Attributes:
        measured_in: units of what the module takes or gives.
    """

    measured_in: str = "detector units"

    def summary(self) -> str:
        """The settings, then the described modules inside, then how many parameters there are."""
        inside = [repr_without_units(child) for child in self.children() if isinstance(child, Described)]
        count = sum(parameter.numel() for parameter in self.parameters())
        parts = [self.extra_repr(), *inside, f"{count} parameters" if count > 8 else ""]
        return ", ".join(part for part in parts if part)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.summary()}, units={self.measured_in!r})"


def repr_without_units(module: Described) -> str:
    """A module inside another one, whose units are those of the whole."""
    return f"{type(module).__name__}({module.summary()})"


class ArrayModel(Described):
    """A noise model that takes arrays too: its distribution then takes and gives arrays."""

    def __call__(self, signal: Any) -> Any:
        if not isinstance(signal, np.ndarray):
            return super().__call__(signal)
        pixels = floating(signal)
        pixels = pixels.to(next((parameter.device for parameter in self.parameters()), pixels.device))
        return ArrayDistribution(super().__call__(pixels), pixels)
