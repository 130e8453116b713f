"""Structure that a per-pixel noise model cannot have: row, column and neighbour correlation of its residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.metrics import probability_integral_transform


@dataclass(frozen=True)
class SpatialStructure:
    """Correlations that a per-pixel noise model cannot have, of standardised residuals of an image.

    Attributes:
        rows, columns: variance of row and column means over what independent pixels would give; 1 where there is no structure.
        horizontal, vertical: correlation of neighbouring pixels.
        error: standard error of `horizontal` and `vertical` under independence.
        suffices: whether a per-pixel model suffices: nothing stands out by over four standard errors.
    """

    rows: float
    columns: float
    horizontal: float
    vertical: float
    error: float
    suffices: bool

    def in_words(self) -> str:
        """One line for people."""
        figures = (
            f"neighbours correlate by {self.horizontal:+.3f} along x and {self.vertical:+.3f} along y (± {self.error:.3f}), "
            f"row means vary {self.rows:.2f} and column means {self.columns:.2f} times as much as independent pixels' would"
        )
        return figures + ("; a per-pixel model suffices" if self.suffices else "; a per-pixel model does not suffice")


@torch.no_grad()
def spatial_structure(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> SpatialStructure:
    """Residual row, column and neighbour correlation of (y, x) images, or stacks of them, under a noise model."""
    u = probability_integral_transform(
        noise_model, signal.reshape(-1), observation.reshape(-1), np.random.default_rng(0)
    )
    z = torch.special.ndtri(torch.from_numpy(u).clamp(1e-6, 1 - 1e-6)).reshape(signal.shape).numpy()
    z = (z - z.mean()) / z.std()
    height, width = z.shape[-2:]
    rows, columns = float(z.mean(-1).var() * width), float(z.mean(-2).var() * height)
    horizontal, vertical = float((z[..., 1:] * z[..., :-1]).mean()), float((z[..., 1:, :] * z[..., :-1, :]).mean())
    error = 1 / math.sqrt(z.size)
    stands_out = (
        abs(horizontal) > 4 * error
        or abs(vertical) > 4 * error
        or rows > 1 + 4 * math.sqrt(2 * width / z.size)
        or columns > 1 + 4 * math.sqrt(2 * height / z.size)
    )
    return SpatialStructure(rows, columns, horizontal, vertical, error, not stands_out)
