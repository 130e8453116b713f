"""Grids of voxels: one free parameter per voxel, and the sum of dense grids at doubling resolutions."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from recon.fields.fields import EMPTY, Field
from recon.projection.tiles import Tiles, upsampling


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


class MultiresolutionField(Field):
    """The sum of dense grids at doubling resolutions: as general as `VoxelField`, but much better conditioned.

    The coarse grids act as a multigrid preconditioner: one step of Adam changes all wavelengths.

    Args:
        coarsest: minimum number of voxels along the longest side of the coarsest grid.

    Example:
        >>> import recon
        >>> field = recon.MultiresolutionField((8, 8, 8))
        >>> field.volume().shape, len(list(field.parameters()))
        (torch.Size([8, 8, 8]), 2)
    """

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0, coarsest: int = 3) -> None:
        super().__init__(shape, scale=scale)
        if coarsest < 1:
            raise ValueError(f"coarsest {coarsest} must be at least one voxel")
        sizes = [(self.depth, self.width, self.height)]
        while max(sizes[0]) >= 2 * coarsest:
            sizes.insert(0, tuple((size + 1) // 2 for size in sizes[0]))  # type: ignore[arg-type]
        self.grids = nn.ParameterList(nn.Parameter(torch.zeros(size)) for size in sizes)
        nn.init.constant_(self.grids[0], math.log(math.expm1(EMPTY)))

    def start_from(self, volume: Tensor) -> None:
        """Initialise a grid four times coarser than the voxel grid, because finer detail of the volume is noise."""
        with torch.no_grad():
            for grid in self.grids:
                grid.zero_()
            grid = self.grids[max(0, len(self.grids) - 3)]
            grid.copy_(self._raw_of(volume, grid.shape))

    def coarser(self) -> Field | None:
        """The sum of all grids except the finest; None for derived classes that compute their volume differently."""
        if len(self.grids) == 1 or type(self) is not MultiresolutionField:
            return None
        depth, width, height = self.grids[-2].shape
        field = MultiresolutionField((depth, height, width), scale=2 * float(self.scale)).to(self.scale.device)
        field.grids = self.grids[:-1]
        return field

    def units(self) -> Tensor:
        return functional.softplus(_sum(list(self.grids)))

    def on(self, tiles: Tiles) -> Tensor:
        *coarse, finest = self.grids
        values = tiles.gathered(finest)
        if coarse:
            values = values + tiles.upsampled(_sum(coarse))
        return functional.softplus(values) * tiles.filled


def _sum(grids: Sequence[Tensor]) -> Tensor:
    total, *finer = grids
    for grid in finer:
        total = upsample(total, grid.shape, plus=grid)
    return total


def upsample(grid: Tensor, shape: Sequence[int], *, plus: Tensor | None = None) -> Tensor:
    """Linear interpolation of a 3D grid to twice its size along each axis (or one less), with aligned cell centres.

    Products with matrices are several times faster than torch's general function, forward and backward. `plus` is an array of
    that shape that is added in the same pass.
    """
    result: Tensor = _Upsampling.apply(grid, tuple(shape), plus)  # type: ignore[no-untyped-call]
    return result


class _Upsampling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, shape: tuple[int, int, int], plus: Tensor | None) -> Tensor:
        ctx.size = grid.shape
        across, _, along = upsampling(tuple(grid.shape), shape, grid.dtype, grid.device)
        wide = grid.reshape(-1, grid.shape[2]) @ along.T
        found = across @ wide if plus is None else torch.addmm(plus.reshape(-1, shape[2]), across, wide)
        return found.view(shape)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, Tensor | None]:
        _, back, along = upsampling(tuple(ctx.size), tuple(gradient.shape), gradient.dtype, gradient.device)
        found = (back @ gradient.reshape(-1, gradient.shape[2])) @ along
        return found.view(ctx.size), None, gradient if ctx.needs_input_grad[2] else None


FIELD = MultiresolutionField
FIELDS = {"voxels": VoxelField}
