"""The occupied tiles of a voxel grid: projection and regularisation with empty voxels elsewhere."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor

from recon.fields.upsampling import upsampling_matrix
from recon.projection.base import Projector
from recon.projection.sparse import csr_tensor
from recon.projection.tile import Tile, TileVariation, neighbours_of

_TOGETHER, _MOST_TILES = 16, 8
_ALIKE = 32  # slices within 1/32 of the width occupy nearly the same columns; each tile copies a part of the matrix


def slices_of_a_tile(height: int, width: int) -> int:
    """Number of slices per tile, for a voxel grid with this number of slices and columns along x."""
    return max(_TOGETHER, -(-height // _MOST_TILES), width // _ALIKE)


class Tiles:
    """Occupied columns (z, x) of a voxel grid, by tiles of neighbouring slices.

    Every tile has its own small part of the projector matrix, for the columns that are occupied in any of its slices. Columns are
    listed completely, for contiguous memory access. A list of values represents a volume that is empty at all other voxels.

    Args:
        mask: (depth, width, height) of the voxel grid, True where occupied.
        projector: projector of the whole voxel grid.
        known: tiles of another mask for the same projector. Their common parts are reused and the rest is released; they
            cannot be used afterwards.

    Attributes:
        mask: the given mask.
        filled: (N,) 1 if the listed voxel is occupied, otherwise 0.
    """

    def __init__(self, mask: Tensor, projector: Projector, *, known: Tiles | None = None) -> None:
        self.mask, self.shape = mask.clone(), tuple(mask.shape)
        depth, width, height = self.shape
        together = slices_of_a_tile(height, width)
        flat = mask.reshape(depth * width, height)
        rows = [slice(start, min(start + together, height)) for start in range(0, height, together)]
        columns = [flat[:, span].any(1).nonzero()[:, 0] for span in rows]
        sizes = [here.numel() * (span.stop - span.start) for here, span in zip(columns, rows, strict=True)]
        parts = [slice(*ends) for ends in pairwise(accumulate(sizes, initial=0))]
        neighbours = neighbours_of(columns, (depth, width))
        before: list[Tile] = [] if known is None else known._given_up()
        self._tiles: list[Tile] = [
            Tile(span, here, part, near, *_matrices(projector, here, before.pop(0) if before else None))
            for span, here, part, near in zip(rows, columns, parts, neighbours, strict=True)
        ]
        self._like = self._tiles[0].matrix.values()
        self.filled = self._like.new_empty(parts[-1].stop)
        for tile in self._tiles:
            tile.of(self.filled).copy_(flat[:, tile.rows].index_select(0, tile.columns))
        self._upsampling: tuple[tuple[int, ...], list[_TileUpsampling]] | None = None

    @property
    def share(self) -> float:
        """The listed share of the voxel grid."""
        return self.filled.numel() / math.prod(self.shape)

    @cached_property
    def occupied(self) -> Tensor:
        """(M,) indices of the occupied voxels in the list."""
        return self.filled.nonzero()[:, 0]

    @cached_property
    def voxels(self) -> Tensor:
        """(M,) flat indices of the occupied voxels in the voxel grid (z, x, y)."""
        height, device = self.shape[2], self.filled.device
        spans = [torch.arange(tile.rows.start, tile.rows.stop, device=device) for tile in self._tiles]
        listed = [
            (tile.columns[:, None] * height + span).reshape(-1) for tile, span in zip(self._tiles, spans, strict=True)
        ]
        return torch.cat(listed)[self.occupied]

    def project(self, values: Tensor) -> Tensor:
        """Project values (N,) to line integrals (tilts * detector_width, height), in the projector's native order."""
        rays: Tensor = _Projection.apply(values, self)  # type: ignore[no-untyped-call]
        return rays

    def total_variation(self, values: Tensor, *, smoothing: float) -> Tensor:
        """Total variation of the whole voxel grid, see `recon.fields.regularisers.total_variation`."""
        variation: Tensor = TileVariation.apply(values, smoothing, self)  # type: ignore[no-untyped-call]
        return variation

    def gathered(self, lattice: Tensor) -> Tensor:
        """The list (N,) of a voxel grid (z, x, y)."""
        values: Tensor = _Gathering.apply(lattice, self)  # type: ignore[no-untyped-call]
        return values

    def upsampled(self, grid: Tensor) -> Tensor:
        """The list (N,) of a grid (z, x, y) with half the resolution, interpolated as in `recon.fields.upsampling`."""
        values: Tensor = _UpsampledTiles.apply(grid, self)  # type: ignore[no-untyped-call]
        return values

    def upsampling(self, size: tuple[int, ...]) -> list[_TileUpsampling]:
        """Interpolation operators from a grid of that size, for every tile."""
        if self._upsampling is None or self._upsampling[0] != size:
            depth, width, height = self.shape
            across = _between_columns((depth, width), size[:2])
            along = upsampling_matrix(size[2], height, like=self._like)
            upsampling = [
                _TileUpsampling.of(across[tile.columns.cpu().numpy()], along[tile.rows]) for tile in self._tiles
            ]
            self._upsampling = size, upsampling
        return self._upsampling[1]

    def lattice(self, values: Tensor) -> Tensor:
        """The voxel grid (depth * width, height) of a list, without gradient."""
        return self.scattered(values.detach()).view(-1, self.shape[2])

    def spread(self, values: Tensor) -> Tensor:
        """The voxel grid (z, x, y) of a list, differentiable."""
        lattice: Tensor = _Spreading.apply(values, self)  # type: ignore[no-untyped-call]
        return lattice

    def scattered(self, values: Tensor) -> Tensor:
        """The voxel grid (z, x, y) of a list: the adjoint of `gathered`."""
        lattice = values.new_zeros(self.shape)
        for tile in self._tiles:
            lattice.view(-1, self.shape[2])[:, tile.rows].index_copy_(0, tile.columns, tile.of(values))
        return lattice

    def __iter__(self) -> Iterator[Tile]:
        return iter(self._tiles)

    def _given_up(self) -> list[Tile]:
        """Give the tiles to another object; this one cannot be used afterwards. Tiles can be several times the size of the
        projector matrix."""
        tiles = self._tiles
        del self._tiles, self._upsampling
        return tiles


def _matrices(projector: Projector, columns: Tensor, known: Tile | None) -> tuple[Tensor, Tensor]:
    if known is not None and torch.equal(columns, known.columns):
        return known.matrix, known.transposed
    return projector.part(columns)


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


def _between_columns(fine: tuple[int, int], coarse: tuple[int, ...]) -> Any:
    from scipy.sparse import csr_array, kron

    like = torch.zeros((), dtype=torch.float64)
    z, x = (
        csr_array(upsampling_matrix(small, large, like=like).numpy()) for small, large in zip(coarse, fine, strict=True)
    )
    return csr_array(kron(z, x, format="csr"))


class _Gathering(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lattice: Tensor, tiles: Tiles) -> Tensor:
        ctx.tiles = tiles
        columns, values = lattice.reshape(-1, lattice.shape[2]), lattice.new_empty(tiles.filled.numel())
        for tile in tiles:
            torch.index_select(columns[:, tile.rows], 0, tile.columns, out=tile.of(values))
        return values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.tiles.scattered(gradient), None


class _Spreading(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, tiles: Tiles) -> Tensor:
        ctx.tiles = tiles
        return tiles.scattered(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.tiles.gathered(gradient), None


class _UpsampledTiles(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, tiles: Tiles) -> Tensor:
        ctx.tiles, ctx.size = tiles, tuple(grid.shape)
        coarse, values = grid.reshape(-1, grid.shape[2]), grid.new_empty(tiles.filled.numel())
        for tile, up in zip(tiles, tiles.upsampling(ctx.size), strict=True):
            torch.mm(up.across @ coarse[:, up.rows], up.along.T, out=tile.of(values))
        return values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        found = gradient.new_zeros(ctx.size)
        coarse = found.view(-1, ctx.size[2])
        for tile, up in zip(ctx.tiles, ctx.tiles.upsampling(ctx.size), strict=True):
            coarse[:, up.rows] += up.across_transposed @ (tile.of(gradient) @ up.along)
        return found, None


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, tiles: Tiles) -> Tensor:
        ctx.tiles = tiles
        like = next(iter(tiles)).matrix
        rays = values.new_empty(like.shape[0], tiles.shape[2])
        for tile in tiles:
            rays[:, tile.rows] = tile.matrix @ tile.of(values)
        return rays

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        found = gradient.new_empty(ctx.tiles.filled.numel())
        for tile in ctx.tiles:
            tile.of(found).copy_(tile.transposed @ gradient[:, tile.rows].contiguous())
        return found, None
