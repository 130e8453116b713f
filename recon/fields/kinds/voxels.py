"""One free parameter per voxel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from recon.fields.fields import EMPTY, Field
from recon.projection.tiles import Tiles


class VoxelField(Field):
    """One free parameter per voxel.

    Example:
        >>> import recon
        >>> recon.VoxelField((4, 6, 8)).volume().shape  # (z, y, x)
        torch.Size([4, 6, 8])
    """

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0) -> None:
        super().__init__(shape, scale=scale)
        empty = math.log(math.expm1(EMPTY))
        self.values = nn.Parameter(torch.full((self.depth, self.width, self.height), empty))

    def start_from(self, volume: Tensor) -> None:
        with torch.no_grad():
            self.values.copy_(self._raw_of(volume, self.values.shape))

    def units(self) -> Tensor:
        return functional.softplus(self.values)

    def on(self, tiles: Tiles) -> Tensor:
        return functional.softplus(tiles.gathered(self.values)) * tiles.filled


FIELD = VoxelField
