"""The volume as a coordinate network, evaluated once on the voxel grid for the rays of all tilts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from recon.fields.fields import Field
from recon.methods.kniesel2022.network import CoordinateDensity

_DENSEST = 4.0  # attenuation of a density of one, in units of the field's scale
_POINTS_TOGETHER = 2**15


class CoordinateNetwork(Field):
    """The field of Kniesel et al. (CVPR 2022, doi:10.1109/CVPR52688.2022.02018): a network on a positional encoding.

    Activations are recomputed block by block in the backward pass, so that only those of one block are in memory.

    Args:
        shape: (depth, height, width) of the voxel grid, voxels along (z, y, x).
        scale: see `Field`.
        width: width of the hidden layers.
        layers: number of hidden layers.
        frequencies: number of octaves of the positional encoding.
        skip: number of hidden layers after which the encoding is concatenated again; 0 for none.

    Example:
        >>> import recon, torch
        >>> field = recon.CoordinateNetwork((8, 8, 8), width=16, layers=3, skip=2)
        >>> field.volume().shape, bool((field.volume() >= 0).all())
        (torch.Size([8, 8, 8]), True)
    """

    relative_rate = 0.005

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
        super().__init__(shape, scale=scale)
        self.density = CoordinateDensity(frequencies=frequencies, layers=layers, width=width, skip=skip)

    def start_from(self, volume: Tensor) -> None:
        """Initialise with a constant, the mean of the volume."""
        share = (volume.mean() / self.scale / _DENSEST).clamp(1e-3, 0.5)
        with torch.no_grad():
            self.density.last.bias.copy_(torch.logit(share))

    def units(self) -> Tensor:
        everywhere = torch.arange(self.depth * self.width * self.height, device=self.scale.device)
        return self.at(everywhere).view(self.depth, self.width, self.height)

    def at(self, indices: Tensor) -> Tensor:
        """Attenuation, in units of the scale, at (N,) flat indices of the voxel grid (z, x, y)."""
        parts = torch.split(indices, _POINTS_TOGETHER)
        values = [checkpoint(self._density, part, use_reentrant=False) for part in parts]
        return torch.cat(values) * _DENSEST

    def _density(self, indices: Tensor) -> Tensor:
        """Density in (0, 1); coordinates are relative to the centre, in units of half the width."""
        y, x = indices % self.height, indices // self.height % self.width
        z = indices // (self.height * self.width)
        sizes = ((x, self.width), (y, self.height), (z, self.depth))
        points = torch.stack([(2 * place + 1 - size) / self.width for place, size in sizes], -1)
        density: Tensor = self.density(points.to(self.scale.dtype))
        return density
