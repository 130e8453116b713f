"""Total variation of a voxel grid given on its occupied tiles, with empty voxels elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from recon.projection.saved_gradient import SavedGradient
from recon.projection.tile import Tile


class TileVariation(SavedGradient):
    """The sum over all voxels; only listed voxels and the empty ones just before them contribute."""

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
