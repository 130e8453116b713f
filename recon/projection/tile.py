"""A tile: neighbouring slices of a voxel grid with their occupied columns, neighbouring columns, and the total variation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from recon.projection.base import SavedGradient


@dataclass(frozen=True)
class Neighbours:
    """Indices of the neighbours of a tile's columns.

    The columns of the tile come first, followed by its rim: empty columns whose next neighbour is in the tile. The total number C
    is the index of any other empty column.

    Attributes:
        following: (2, C) next column along z and x, or the column itself at an edge.
        preceding: (2, n) previous column of each column of the tile.
        above: (C,) index in the columns of the next tile, whose number denotes an empty column; None at the edge.
        below: (n,) index in the columns and rim of the previous tile; None at the edge.
    """

    following: Tensor
    preceding: Tensor
    above: Tensor | None
    below: Tensor | None


def neighbours_of(columns: Sequence[Tensor], shape: tuple[int, int]) -> list[Neighbours]:
    """The neighbours of every tile, given its columns as flat indices of (depth, width)."""
    total, steps, found, below = math.prod(shape), (shape[1], 1), [], None
    for tile, own in enumerate(columns):
        following_tile = columns[tile + 1] if tile + 1 < len(columns) else None
        first = [own < shape[1], own % shape[1] == 0]
        is_rim = torch.zeros(total, dtype=torch.bool, device=own.device)
        for step, edge in zip(steps, first, strict=True):
            is_rim[(own - step)[~edge]] = True
        if following_tile is not None:
            is_rim[following_tile] = True
        is_rim[own] = False
        everything = torch.cat([own, is_rim.nonzero()[:, 0]])
        here = torch.arange(everything.numel(), device=own.device)
        at = _positions(everything, total)
        last = [everything >= total - shape[1], everything % shape[1] == shape[1] - 1]
        following = [
            torch.where(edge, here, at[(everything + step).clamp(max=total - 1)])
            for step, edge in zip(steps, last, strict=True)
        ]
        preceding = [
            at[(own - step).clamp(min=0)].masked_fill(edge, len(everything))
            for step, edge in zip(steps, first, strict=True)
        ]
        above = None if following_tile is None else _positions(following_tile, total)[everything]
        found.append(
            Neighbours(torch.stack(following), torch.stack(preceding), above, None if below is None else below[own])
        )
        below = at
    return found


def _positions(columns: Tensor, total: int) -> Tensor:
    """(total,) index of each column in `columns`, or their number if it is not among them."""
    at = torch.full((total,), columns.numel(), device=columns.device)
    at[columns] = torch.arange(columns.numel(), device=columns.device)
    return at


@dataclass(frozen=True)
class Tile:
    """Neighbouring slices `rows` of the voxel grid, with their occupied `columns`.

    Attributes:
        part: range of their values in the list, column by column.
        neighbours: neighbours of the columns.
        matrix, transposed: the corresponding part of the projector matrix.
    """

    rows: slice
    columns: Tensor
    part: slice
    neighbours: Neighbours
    matrix: Tensor
    transposed: Tensor

    def of(self, values: Tensor) -> Tensor:
        """The part of a list that belongs to the tile, (columns, slices)."""
        return values[self.part].view(self.columns.numel(), self.rows.stop - self.rows.start)


class TileVariation(SavedGradient):
    """Total variation of a voxel grid given on its occupied tiles; only listed voxels and the empty ones just before them
    contribute."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, smoothing: float, tiles: Iterable[Tile]) -> Tensor:
        gradient, total, below, in_order = torch.empty_like(values), values.new_zeros(()), None, [*tiles]
        for tile, above in zip(in_order, [*in_order[1:], None], strict=True):
            flows, near = _differences(values, tile, above), tile.neighbours
            magnitude = torch.full_like(flows[0], smoothing**2)
            for flow in flows:
                magnitude.addcmul_(flow, flow)
            magnitude.sqrt_()
            total += (magnitude - smoothing).sum()
            found = tile.of(gradient).zero_()  # minus the divergence of ∇v / |∇v|
            for flow in flows:
                found.sub_(flow.div_(magnitude)[: len(found)])
            for flow, before in zip(flows[:2], near.preceding, strict=True):
                found.add_(flow.index_select(0, before))
            found[:, 1:] += flows[2][: len(found), :-1]
            if near.below is not None and below is not None:
                found[:, 0] += below.index_select(0, near.below)
            below = flows[2][:, -1]
        ctx.save_for_backward(gradient)
        return total


def _differences(values: Tensor, tile: Tile, above: Tile | None) -> list[Tensor]:
    """Forward differences along z, x and y of a tile's columns, its rim and finally an empty column, (C + 1, slices) each."""
    near, own = tile.neighbours, tile.of(values)
    count, height = near.following.shape[1], own.shape[1]
    padded = values.new_zeros(count + 1, height + 1)
    padded[: len(own), :height] = own
    if above is None or near.above is None:
        padded[:, height] = padded[:, height - 1]
    else:
        first = above.of(values)[:, 0]
        padded[:-1, height] = torch.cat([first, first.new_zeros(1)]).index_select(0, near.above)
    here = padded[:, :height]
    found = [values.new_zeros(count + 1, height) for _ in range(3)]
    for difference, following in zip(found[:2], near.following, strict=True):
        torch.index_select(here, 0, following, out=difference[:-1]).sub_(here[:-1])
    torch.sub(padded[:, 1:], here, out=found[2])
    return found
