"""The occupied part of a lattice: projected, and regularised, as if all the rest were there and empty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor

from recon.projector import SliceProjector
from recon.sparse import csr_tensor
from recon.upsampling import upsampling_matrix

_TOGETHER, _MOST_GROUPS = 16, 8


class Tiles:
    """The columns (z, x) of a lattice in which neighbouring slices hold anything, group by group of slices.

    Every group has its own small part of the projector's matrix: the columns that are occupied in any of its slices. A list of
    values counts as a volume that is empty wherever the list has no voxel.

    Args:
        mask: (depth, width, height) of the lattice, True where occupied.
        projector: of the whole lattice.

    Attributes:
        mask: as given.
        places: (N,) voxels of the list, flat lattice indices (z, x, y).
        occupied: (M,) where in the list the occupied ones stand.
        voxels: (M,) their flat lattice indices.
    """

    def __init__(self, mask: Tensor, projector: SliceProjector) -> None:
        self.mask, self.shape = mask.clone(), tuple(mask.shape)
        depth, width, height = self.shape
        together = max(_TOGETHER, -(-height // _MOST_GROUPS))
        flat = mask.reshape(depth * width, height)
        self.rows = [slice(start, min(start + together, height)) for start in range(0, height, together)]
        self._columns = columns = [flat[:, rows].any(1).nonzero()[:, 0] for rows in self.rows]
        spans = [torch.arange(rows.start, rows.stop, device=mask.device) for rows in self.rows]
        listed = [(part[:, None] * height + span).reshape(-1) for part, span in zip(columns, spans, strict=True)]
        self.places = torch.cat(listed)
        self.occupied = mask.reshape(-1)[self.places].nonzero()[:, 0]
        self.voxels = self.places[self.occupied]
        self.parts = [slice(*ends) for ends in pairwise(accumulate(map(len, listed), initial=0))]
        self.matrices = [projector.part(part) for part in columns]
        self._neighbours = _neighbours(self.places, self.shape)
        self._upsampling: tuple[tuple[int, ...], list[_GroupUpsampling]] | None = None

    @property
    def share(self) -> float:
        """The share of the lattice that is listed."""
        return self.places.numel() / math.prod(self.shape)

    def project(self, values: Tensor) -> Tensor:
        """Values (N,) to line integrals (tilts * detector_width, height), in the projector's native order."""
        rays: Tensor = _Projection.apply(values, self)  # type: ignore[no-untyped-call]
        return rays

    def total_variation(self, values: Tensor, *, smoothing: float) -> Tensor:
        """Of the whole lattice, see `recon.regularisers.total_variation`."""
        variation: Tensor = _Variation.apply(values, smoothing, *self._neighbours)  # type: ignore[no-untyped-call]
        return variation

    def upsampled(self, grid: Tensor) -> Tensor:
        """A grid half as fine as the lattice, (z, x, y), interpolated to the list, (N,): see `recon.upsampling`."""
        values: Tensor = _Upsampling.apply(grid, self)  # type: ignore[no-untyped-call]
        return values

    def upsampling(self, size: tuple[int, ...]) -> list[_GroupUpsampling]:
        """Of a grid of that size, for every group."""
        if self._upsampling is None or self._upsampling[0] != size:
            depth, width, height = self.shape
            like = self.matrices[0][0].values()
            across = _between_columns((depth, width), size[:2])
            along = upsampling_matrix(size[2], height, like=like)
            groups = [
                _GroupUpsampling.of(across[columns.cpu().numpy()], along[rows], like)
                for columns, rows in zip(self._columns, self.rows, strict=True)
            ]
            self._upsampling = size, groups
        return self._upsampling[1]

    def lattice(self, values: Tensor) -> Tensor:
        """The whole lattice, (depth * width, height), without gradient."""
        depth, width, height = self.shape
        empty = values.new_zeros(depth * width * height)
        return empty.index_copy(0, self.places, values.detach()).view(depth * width, height)


@dataclass(frozen=True)
class _GroupUpsampling:
    """From a coarse grid to the columns of one group: between columns by a sparse matrix, along them by a small dense one."""

    across: Tensor
    across_transposed: Tensor
    along: Tensor
    rows: slice

    @staticmethod
    def of(across: Any, along: Tensor, like: Tensor) -> _GroupUpsampling:
        needed = along.any(0).nonzero()[:, 0]
        rows = slice(int(needed[0]), int(needed[-1]) + 1)
        forward, back = (csr_tensor(matrix).to(like) for matrix in (across, across.T.tocsr()))
        return _GroupUpsampling(forward, back, along[:, rows].contiguous(), rows)


def _between_columns(fine: tuple[int, int], coarse: tuple[int, ...]) -> Any:
    from scipy.sparse import csr_array, kron

    like = torch.zeros((), dtype=torch.float64)
    z, x = (
        csr_array(upsampling_matrix(small, large, like=like).numpy()) for small, large in zip(coarse, fine, strict=True)
    )
    return csr_array(kron(z, x, format="csr"))


class _Upsampling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, tiles: Tiles) -> Tensor:
        ctx.tiles, ctx.size = tiles, tuple(grid.shape)
        coarse, values = grid.reshape(-1, grid.shape[2]), grid.new_empty(tiles.places.numel())
        for part, group in zip(tiles.parts, tiles.upsampling(ctx.size), strict=True):
            values[part] = ((group.across @ coarse[:, group.rows]) @ group.along.T).view(-1)
        return values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        found = gradient.new_zeros(ctx.size)
        coarse = found.view(-1, ctx.size[2])
        for part, group in zip(ctx.tiles.parts, ctx.tiles.upsampling(ctx.size), strict=True):
            columns = gradient[part].view(-1, group.along.shape[0]) @ group.along
            coarse[:, group.rows] += group.across_transposed @ columns
        return found, None


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, tiles: Tiles) -> Tensor:
        ctx.tiles = tiles
        rays = values.new_empty(tiles.matrices[0][0].shape[0], tiles.shape[2])
        for rows, part, (matrix, _) in zip(tiles.rows, tiles.parts, tiles.matrices, strict=True):
            rays[:, rows] = matrix @ values[part].view(matrix.shape[1], rows.stop - rows.start)
        return rays

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        tiles, found = ctx.tiles, gradient.new_empty(ctx.tiles.places.numel())
        for rows, part, (_, transposed) in zip(tiles.rows, tiles.parts, tiles.matrices, strict=True):
            found[part] = (transposed @ gradient[:, rows].contiguous()).view(-1)
        return found, None


def _neighbours(places: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Where in a list of voxels, their empty neighbours before them, and one empty voxel, each one's neighbours stand.

    Returns:
        (3, N + rim) the next voxel along each axis, or the voxel itself at an edge; (3, N) the one before, or the empty voxel.
    """
    total, steps = math.prod(shape), (shape[1] * shape[2], shape[2], 1)
    first = [axis == 0 for axis in _coordinates(places, shape)]
    is_rim = torch.zeros(total, dtype=torch.bool, device=places.device)
    for step, edge in zip(steps, first, strict=True):
        is_rim[(places - step)[~edge]] = True
    is_rim[places] = False
    everything = torch.cat([places, is_rim.nonzero()[:, 0]])
    empty = everything.numel()
    here = torch.arange(empty, dtype=torch.int32, device=places.device)
    at = torch.full((total,), empty, dtype=torch.int32, device=places.device)
    at[everything] = here
    following = torch.empty(3, empty, dtype=torch.int32, device=places.device)
    preceding = torch.empty(3, places.numel(), dtype=torch.int32, device=places.device)
    coordinates = _coordinates(everything, shape)
    for axis, (step, size) in enumerate(zip(steps, shape, strict=True)):
        torch.index_select(at, 0, (everything + step).clamp_(max=total - 1), out=following[axis])
        torch.where(coordinates[axis] == size - 1, here, following[axis], out=following[axis])
        torch.index_select(at, 0, (places - step).clamp_(min=0), out=preceding[axis])
        preceding[axis].masked_fill_(first[axis], empty)
    return following, preceding


def _coordinates(places: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    _, width, height = shape
    columns = torch.div(places, height, rounding_mode="trunc")
    depths = torch.div(columns, width, rounding_mode="trunc")
    return depths, columns - depths * width, places - columns * height


class _Variation(torch.autograd.Function):
    """The sum over all voxels, of which only listed ones and the empty ones just before them add anything."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, smoothing: float, following: Tensor, preceding: Tensor) -> Tensor:
        count = following.shape[1]
        padded = torch.cat([values, values.new_zeros(count + 1 - values.numel())])
        differences = [padded.index_select(0, following[axis]).sub_(padded[:count]) for axis in range(3)]
        magnitude = torch.full_like(differences[0], smoothing**2)
        for difference in differences:
            magnitude.addcmul_(difference, difference)
        magnitude.sqrt_()
        gradient = torch.zeros_like(values)
        for axis, difference in enumerate(differences):  # minus the divergence of ∇v / |∇v|
            flow = torch.cat([difference.div_(magnitude), values.new_zeros(1)])
            gradient.sub_(flow[: values.numel()]).add_(flow.index_select(0, preceding[axis]))
        ctx.save_for_backward(gradient)
        return (magnitude - smoothing).sum()

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * outer, None, None, None
