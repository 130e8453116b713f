"""The occupied tiles of a voxel grid: projection and regularisation with empty voxels elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import accumulate, pairwise
from typing import Any

import torch
from scipy.sparse import csr_array, kron
from torch import Tensor

from recon.projection.base import Projector, csr_tensor, linear

_TOGETHER, _MOST_TILES = 16, 8
_ALIKE = 32  # slices within 1/32 of the width occupy nearly the same columns; each tile copies a part of the matrix


def slices_of_a_tile(height: int, width: int) -> int:
    """Number of slices per tile, for a voxel grid with this number of slices and columns along x."""
    return max(_TOGETHER, -(-height // _MOST_TILES), width // _ALIKE)


@dataclass(frozen=True)
class Tile:
    """Neighbouring slices `rows` of the voxel grid, with their occupied `columns`.

    Attributes:
        part: range of their values in the list, column by column.
        matrix, transposed: the corresponding part of the projector matrix.
    """

    rows: slice
    columns: Tensor
    part: slice
    matrix: Tensor
    transposed: Tensor

    def of(self, values: Tensor) -> Tensor:
        """The part of a list that belongs to the tile, (columns, slices)."""
        return values[self.part].view(self.columns.numel(), self.rows.stop - self.rows.start)


class Tiles:
    """Occupied columns (z, x) of a voxel grid, by tiles of neighbouring slices.

    Every tile has its own small part of the projector matrix, for the columns that are occupied in any of its slices. Columns are
    listed completely, for contiguous memory access. A list of values represents a volume that is empty at all other voxels.

    Args:
        mask: (depth, width, height) of the voxel grid, True where occupied.
        known: tiles of another mask for the same projector. Their common parts are reused and the rest is released; they
            cannot be used afterwards.

    Attributes:
        filled: (N,) 1 if the listed voxel is occupied, otherwise 0.
    """

    def __init__(self, mask: Tensor, projector: Projector, *, known: Tiles | None = None) -> None:
        self.mask, self.shape = mask.clone(), tuple(mask.shape)
        depth, width, height = self.shape
        together = slices_of_a_tile(height, width)
        if mask.device.type != "cpu":  # the calls of many tiles of less than 2²¹ voxels take longer than empty voxels
            together = max(together, (1 << 21) // (depth * width))
        flat = mask.reshape(depth * width, height)
        rows = [slice(start, min(start + together, height)) for start in range(0, height, together)]
        columns = [flat[:, span].any(1).nonzero()[:, 0] for span in rows]
        sizes = [here.numel() * (span.stop - span.start) for here, span in zip(columns, rows, strict=True)]
        parts = [slice(*ends) for ends in pairwise(accumulate(sizes, initial=0))]
        before: list[Tile] = []
        if known is not None:  # given up, because tiles can be several times the size of the projector matrix
            before = known._tiles
            del known._tiles, known._upsampling
        self._tiles: list[Tile] = []
        for span, here, part in zip(rows, columns, parts, strict=True):
            old = before.pop(0) if before else None
            same = old is not None and torch.equal(here, old.columns)
            matrices = (old.matrix, old.transposed) if old is not None and same else projector.part(here)
            self._tiles.append(Tile(span, here, part, *matrices))
        self._like = self._tiles[0].matrix.values()
        self.filled = self._like.new_empty(parts[-1].stop)
        for tile in self._tiles:
            tile.of(self.filled).copy_(flat[:, tile.rows].index_select(0, tile.columns))
        self._upsampling: tuple[tuple[int, ...], list[_TileUpsampling]] | None = None

    @cached_property
    def occupied(self) -> Tensor:
        """(M,) indices of the occupied voxels in the list."""
        return self.filled.nonzero()[:, 0]

    @cached_property
    def voxels(self) -> Tensor:
        """(M,) flat indices of the occupied voxels in the voxel grid (z, x, y)."""
        height, device = self.shape[2], self.filled.device
        spans = [torch.arange(tile.rows.start, tile.rows.stop, device=device) for tile in self._tiles]
        pairs = zip(self._tiles, spans, strict=True)
        return torch.cat([(tile.columns[:, None] * height + span).reshape(-1) for tile, span in pairs])[self.occupied]

    def project(self, values: Tensor) -> Tensor:
        """Project values (N,) to line integrals (tilts * detector_width, height), in the projector's native order."""
        return linear(values, self._projected)

    def gathered(self, lattice: Tensor) -> Tensor:
        """The list (N,) of a voxel grid (z, x, y)."""
        return linear(lattice, self._gathered)

    def spread(self, values: Tensor) -> Tensor:
        """The voxel grid (z, x, y) of a list: the adjoint of `gathered`."""
        return linear(values, self._gathered, transposed=True)

    def upsampled(self, grid: Tensor) -> Tensor:
        """The list (N,) of a grid (z, x, y) with half the resolution, interpolated as in `recon.fields.kinds.grids.upsample`."""
        return linear(grid, partial(self._upsampled, grid.shape))

    def upsampling(self, size: tuple[int, ...]) -> list[_TileUpsampling]:
        """Interpolation operators from a grid of that size, for every tile."""
        if self._upsampling is None or self._upsampling[0] != size:
            depth, width, height = self.shape
            across = _between_columns((depth, width), size[:2])
            along = upsampling_matrix(size[2], height, self._like.dtype, self._like.device)
            parts = ((across[tile.columns.cpu().numpy()], along[tile.rows]) for tile in self._tiles)
            self._upsampling = size, [_TileUpsampling.of(*part) for part in parts]
        return self._upsampling[1]

    def lattice(self, values: Tensor) -> Tensor:
        """The voxel grid (depth * width, height) of a list, without gradient."""
        return self.spread(values.detach()).view(-1, self.shape[2])

    def _projected(self, given: Tensor, transposed: bool) -> Tensor:
        rays = (self._tiles[0].matrix.shape[0], self.shape[2])
        found = given.new_empty(self.filled.shape if transposed else rays)
        for tile in self._tiles:
            if transposed:
                tile.of(found).copy_(tile.transposed @ given[:, tile.rows].contiguous())
            else:
                found[:, tile.rows] = tile.matrix @ tile.of(given)
        return found

    def _gathered(self, given: Tensor, transposed: bool) -> Tensor:
        found = given.new_zeros(self.shape) if transposed else given.new_empty(self.filled.shape)
        lattice, values = (found, given) if transposed else (given, found)
        for tile in self._tiles:
            part = lattice.reshape(-1, self.shape[2])[:, tile.rows]
            if transposed:
                part.index_copy_(0, tile.columns, tile.of(values))
            else:
                torch.index_select(part, 0, tile.columns, out=tile.of(values))
        return found

    def _upsampled(self, size: tuple[int, ...], given: Tensor, transposed: bool) -> Tensor:
        found = given.new_zeros(size) if transposed else given.new_empty(self.filled.shape)
        coarse = (found if transposed else given).reshape(-1, size[2])
        for tile, up in zip(self._tiles, self.upsampling(size), strict=True):
            if transposed:
                coarse[:, up.rows] += up.across_transposed @ (tile.of(given) @ up.along)
            else:
                torch.mm(up.across @ coarse[:, up.rows], up.along.T, out=tile.of(found))
        return found

    def __iter__(self) -> Iterator[Tile]:
        return iter(self._tiles)


@dataclass(frozen=True)
class _TileUpsampling:
    """Interpolation from a coarse grid to the columns of a tile: sparse matrix across columns, small dense one along them."""

    across: Tensor
    across_transposed: Tensor
    along: Tensor
    rows: slice

    @staticmethod
    def of(across: Any, along: Tensor) -> _TileUpsampling:
        needed = along.any(0).nonzero()[:, 0]
        rows = slice(int(needed[0]), int(needed[-1]) + 1)
        forward, back = (csr_tensor(matrix).to(along) for matrix in (across, across.T.tocsr()))
        return _TileUpsampling(forward, back, along[:, rows].contiguous(), rows)


def _between_columns(fine: tuple[int, ...], coarse: tuple[int, ...]) -> Any:
    kind, sizes = (torch.float64, torch.device("cpu")), zip(coarse, fine, strict=True)
    z, x = (csr_array(upsampling_matrix(small, large, *kind).numpy()) for small, large in sizes)
    return csr_array(kron(z, x, format="csr"))


def upsampling_matrix(coarse: int, fine: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (fine, coarse) of linear interpolation to twice the size along one axis, with aligned cell centres."""
    if coarse == fine:
        return torch.eye(fine, dtype=dtype, device=device)
    position = ((torch.arange(fine, dtype=dtype, device=device) - 0.5) / 2).clamp(0, coarse - 1)
    return (1 - (position[:, None] - torch.arange(coarse, dtype=dtype, device=device)).abs()).clamp_min(0)


@lru_cache(maxsize=32)  # a volume has up to ten grids, and its slab and its halves have others
def upsampling(
    coarse: tuple[int, ...], fine: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """The sparse matrix across columns (z, x), its transpose, and the small dense one along them, (fine, coarse)."""
    matrix = _between_columns(fine[:2], coarse[:2])
    across, back = (csr_tensor(each).to(device=device, dtype=dtype) for each in (matrix, matrix.T.tocsr()))
    return across, back, upsampling_matrix(coarse[2], fine[2], dtype, device)
