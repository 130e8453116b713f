"""The occupied part of a lattice: projected, and regularised, as if all the rest were there and empty."""

from __future__ import annotations

import math
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor

from recon.projector import SliceProjector

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
    """

    def __init__(self, mask: Tensor, projector: SliceProjector) -> None:
        self.mask, self.shape = mask.clone(), tuple(mask.shape)
        depth, width, height = self.shape
        together = max(_TOGETHER, -(-height // _MOST_GROUPS))
        flat = mask.reshape(depth * width, height)
        self.rows = [slice(start, min(start + together, height)) for start in range(0, height, together)]
        columns = [flat[:, rows].any(1).nonzero()[:, 0] for rows in self.rows]
        spans = [torch.arange(rows.start, rows.stop, device=mask.device) for rows in self.rows]
        listed = [(part[:, None] * height + span).reshape(-1) for part, span in zip(columns, spans, strict=True)]
        self.places = torch.cat(listed)
        self.occupied = mask.reshape(-1)[self.places].nonzero()[:, 0]
        self.parts = [slice(*ends) for ends in pairwise(accumulate(map(len, listed), initial=0))]
        self.matrices = [projector.part(part) for part in columns]
        self._neighbours = _neighbours(self.places, self.shape)

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

    def lattice(self, values: Tensor) -> Tensor:
        """The whole lattice, (depth * width, height), without gradient."""
        depth, width, height = self.shape
        empty = values.new_zeros(depth * width * height)
        return empty.index_copy(0, self.places, values.detach()).view(depth * width, height)


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
    depth, width, height = shape
    total, steps = depth * width * height, (width * height, height, 1)
    at = torch.full((total,), -1, dtype=torch.long, device=places.device)
    at[places] = torch.arange(places.numel(), device=places.device)
    coordinates = _coordinates(places, shape)
    before = [(places - step)[axis > 0] for step, axis in zip(steps, coordinates, strict=True)]
    rim = torch.unique(torch.cat(before))
    rim = rim[at[rim] < 0]
    everything = torch.cat([places, rim])
    at[rim] = places.numel() + torch.arange(rim.numel(), device=places.device)
    empty, here = everything.numel(), torch.arange(everything.numel(), device=places.device)
    following, preceding = [], []
    for step, size, axis, first in zip(steps, shape, _coordinates(everything, shape), coordinates, strict=True):
        found = at[(everything + step).clamp_max(total - 1)]
        following.append(torch.where(axis == size - 1, here, torch.where(found < 0, empty, found)))
        preceding.append(torch.where(first == 0, empty, at[(places - step).clamp_min(0)]))
    return torch.stack(following).int(), torch.stack(preceding).int()


def _coordinates(places: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    _, width, height = shape
    return places // (width * height), places // height % width, places % height


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
