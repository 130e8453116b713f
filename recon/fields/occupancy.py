"""Where a volume may hold anything: the rest need not be evaluated, projected or regularised."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from recon.projection.base import Projector

OCCUPIED_MARGIN = 2
"""Voxels around what a rough volume holds that are occupied, too."""

_RETEST_EVERY = 10


class Occupancy(nn.Module):
    """The voxels that may hold something, from a rough volume, and more of them as soon as the data wants them.

    Everything within a margin of what the rough volume holds is occupied. The rest counts as vacuum, and is tested again in every
    tenth step: a block of voxels becomes occupied where the likelihood gains more by raising it than the total variation of its
    faces costs, two times in a row, for a fit that swings wants much at once. Nothing is ever taken out.

    Args:
        rough: (z, y, x) of the same extent and any resolution, in units of the field's scale.
        shape: (depth, height, width) of the voxel grid.
        least: what counts as something in the rough volume.
        margin: voxels of the voxel grid around it.
        block: voxels along the edges of the blocks that are tested.
    """

    mask: Tensor
    wanted: Tensor
    num_steps: Tensor

    def __init__(
        self, rough: Tensor, shape: Sequence[int], *, least: float = 0.2, margin: int = OCCUPIED_MARGIN, block: int = 4
    ) -> None:
        super().__init__()
        self.least, self.block = least, block
        lattice = functional.interpolate(rough.float()[None, None], size=tuple(shape), mode="trilinear")
        self.register_buffer("mask", _grown(lattice[0, 0].transpose(1, 2).contiguous() > least, margin))
        self.register_buffer("wanted", torch.zeros([-(-size // block) for size in self.mask.shape], dtype=torch.bool))
        self.register_buffer("num_steps", torch.zeros((), dtype=torch.long))

    @property
    def share(self) -> float:
        """The share of the voxel grid that is occupied."""
        return float(self.mask.float().mean())

    def rows(self, rows: slice) -> Occupancy:
        """The same for some slices."""
        depth, width, _ = self.mask.shape
        part = Occupancy(
            torch.zeros(1, 1, 1), (depth, rows.stop - rows.start, width), least=self.least, block=self.block
        ).to(self.mask.device)
        part.mask = self.mask[..., rows].clone()
        return part

    def coarser(self, shape: Sequence[int]) -> Occupancy:
        """The same on a voxel grid (depth, height, width) half as fine."""
        part = Occupancy(torch.zeros(1, 1, 1), shape, least=self.least, block=self.block).to(self.mask.device)
        part.mask = functional.adaptive_max_pool3d(self.mask.float()[None], part.mask.shape)[0] > 0
        return part

    @torch.no_grad()
    def wants(self, gradient: Tensor, projector: Projector, cost: float) -> Tensor:
        """The blocks of voxels that the data want occupied; arguments as of `retest`."""
        options: dict[str, Any] = {"ceil_mode": True, "divisor_override": 1}
        # slices are projected one by one: those of a block may be added up before
        depth, width, height = (min(self.block, size) for size in self.mask.shape)  # a thin volume is one block deep
        slabs = functional.avg_pool2d(gradient[None, None], (1, height), **options)[0, 0]
        lattice = projector.backproject(slabs).view(*self.mask.shape[:2], -1)
        gain = -functional.avg_pool3d(lattice[None, None], (depth, width, 1), **options)[0, 0]
        return gain > 6 * self.block**2 * cost

    @torch.no_grad()
    def retest(self, gradient: Tensor, projector: Projector, cost: float) -> None:
        """Occupy the blocks that the data wants, in every tenth call.

        Args:
            gradient: of the loss with respect to the line integrals, (tilts * detector_width, height).
            projector: of the whole voxel grid.
            cost: of the total variation, loss per unit of attenuation and voxel face.
        """
        self.num_steps += 1
        if int(self.num_steps) % _RETEST_EVERY:
            return
        wanted = self.wants(gradient, projector, cost)
        lasting, self.wanted = wanted & self.wanted, wanted
        for axis, size in enumerate(self.mask.shape):
            lasting = lasting.repeat_interleave(self.block, axis).narrow(axis, 0, size)
        if bool((lasting & ~self.mask).any()):
            self.mask |= lasting


def _grown(mask: Tensor, margin: int) -> Tensor:
    """Whatever is within a cube of so many voxels to each side of what is set."""
    for axis, size in enumerate(mask.shape):
        start, mask = mask, mask.clone()
        for step in range(1, min(margin, size - 1) + 1):
            mask.narrow(axis, step, size - step).logical_or_(start.narrow(axis, 0, size - step))
            mask.narrow(axis, 0, size - step).logical_or_(start.narrow(axis, step, size - step))
    return mask
