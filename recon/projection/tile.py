"""A few neighbouring slices of a voxel grid, those of its columns that hold anything there, and where their neighbours stand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Neighbours:
    """Where the neighbours of a tile's columns stand, its own first and then the rim: empty ones from which a difference leads to
    a listed one. The number of all these, C, stands for an empty one that is not among them.

    Attributes:
        following: (2, C) the next one along z and x, or the column itself at an edge.
        preceding: (2, n) the one before each of its own.
        above: (C,) among the next tile's own, whose number stands for an empty one; None at the edge.
        below: (n,) among the tile's before, own and rim; None at the edge.
    """

    following: Tensor
    preceding: Tensor
    above: Tensor | None
    below: Tensor | None


def neighbours_of(columns: Sequence[Tensor], shape: tuple[int, int]) -> list[Neighbours]:
    """Of every tile, given its columns, indices of the flat (depth, width)."""
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
    """(total,) where each column stands among `columns`, or their number."""
    at = torch.full((total,), columns.numel(), device=columns.device)
    at[columns] = torch.arange(columns.numel(), device=columns.device)
    return at


@dataclass(frozen=True)
class Tile:
    """Neighbouring slices `rows` of the voxel grid, and those of its `columns` that hold anything there.

    Attributes:
        part: where in the list their values stand, column by column.
        neighbours: of its columns.
        matrix, transposed: the projector's part.
    """

    rows: slice
    columns: Tensor
    part: slice
    neighbours: Neighbours
    matrix: Tensor
    transposed: Tensor

    def of(self, values: Tensor) -> Tensor:
        """The tile's part of a list as (columns, slices)."""
        return values[self.part].view(self.columns.numel(), self.rows.stop - self.rows.start)
