"""The network of Kniesel et al. (CVPR 2022), evaluated once on the occupied voxels for the rays of all tilts."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.distributions.numerics.elementwise import LONG
from recon.fields.kinds.network import CoordinateNetwork

DENSEST = 4.0
"""Attenuation of a density of one, in units of the field's scale."""


class CoordinateDensity(nn.Module):
    """Density in (0, 1) at points of the cube [-1, 1]³: fully connected layers on a positional encoding, with a final sigmoid.

    Args:
        frequencies: number of octaves of the encoding, with sine and cosine each.
        skip: number of hidden layers after which the encoding is concatenated again; 0 for none.
    """

    def __init__(self, frequencies: int = 10, layers: int = 9, width: int = 256, skip: int = 5) -> None:
        super().__init__()
        self.frequencies, self.skip = frequencies, skip
        encoded = 6 * frequencies
        sizes = [encoded, *[width] * (layers - 1)]
        if skip:
            sizes[skip] += encoded
        self.hidden = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.last = nn.Linear(width, 1)

    def forward(self, points: Tensor) -> Tensor:
        """Density (...) at points (..., 3)."""
        encoded = self.encode(points)
        values = encoded
        for index, layer in enumerate(self.hidden):
            if self.skip and index == self.skip:
                values = torch.cat([encoded, values], -1)
            values = functional.relu(layer(values))
        return torch.sigmoid(self.last(values)).squeeze(-1)

    def encode(self, points: Tensor) -> Tensor:
        """Sines and cosines of π·2ᵏ times each coordinate, (..., 6·frequencies)."""
        octaves = math.pi * 2.0 ** torch.arange(self.frequencies, dtype=points.dtype, device=points.device)
        phases = (points[..., None, :] * octaves[:, None]).flatten(-2)
        return torch.cat([torch.sin(phases), torch.cos(phases)], -1)


class PaperField(CoordinateNetwork):
    """The network of the paper (doi:10.1109/CVPR52688.2022.02018) as a field on a voxel grid.

    Args:
        shape, scale: see `recon.Field`; the attenuation of a density of one is four units of the scale.
        width, layers, frequencies, skip: see `CoordinateDensity`.
    """

    relative_rate = 0.005
    # 72 times the products of the sine network
    step_cost = 500.0
    # outputs of nine layers of 256, and of the encoding twice, in bytes
    more_memory = 4 * LONG * (9 * 256 + 2 * 60)

    def __init__(
        self,
        shape: Sequence[int],
        *,
        scale: float = 1.0,
        width: int = 256,
        layers: int = 9,
        frequencies: int = 10,
        skip: int = 5,
    ) -> None:
        self.octaves, self.skip = frequencies, skip
        super().__init__(shape, scale=scale, width=width, layers=layers)

    def make_network(self) -> nn.Module:
        return CoordinateDensity(self.octaves, self.layers, self.layer_width, self.skip)

    def config(self) -> dict[str, Any]:
        return {"width": self.layer_width, "layers": self.layers, "frequencies": self.octaves, "skip": self.skip}

    def positive(self, values: Tensor) -> Tensor:
        return values * DENSEST

    def start_from(self, volume: Tensor) -> None:
        """Initialise with a constant, the mean of the volume."""
        share = (volume.mean() / self.scale / DENSEST).clamp(1e-3, 0.5)
        with torch.no_grad():
            self.network.last.bias.copy_(torch.logit(share))  # type: ignore[union-attr, operator]


FIELD = PaperField
