"""Occupied voxels of a volume; all others are not evaluated, projected or regularised."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from recon.projection.base import Projector

OCCUPIED_MARGIN = 2
"""Margin, voxels, around the contents of a rough volume that is also occupied."""


class Occupancy(nn.Module):
    """The voxels that may be non-empty, from a rough volume; voxels are added if the data require it.

    All voxels within a margin around the contents of the rough volume are occupied. The others are treated as vacuum and tested
    again in every tenth step. A block of voxels becomes occupied if raising it increases the likelihood by more than the total
    variation of its faces costs. This must hold in two tests in a row, because an oscillating fit makes many blocks pass once.
    Occupied voxels are never removed.

    Args:
        rough: (z, y, x) volume of the same extent and any resolution, in units of the field's scale.
        least: threshold of non-empty voxels in the rough volume.
        margin: margin around them, voxels of the voxel grid.
        block: edge length of the tested blocks, voxels.
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
        occupied = (lattice[0, 0].transpose(1, 2) > least).cpu().numpy()
        grown = ndimage.maximum_filter(occupied, 2 * margin + 1, mode="constant")
        self.register_buffer("mask", torch.from_numpy(grown).to(rough.device))
        self.register_buffer("wanted", self._no_blocks(self.mask))
        self.register_buffer("num_steps", torch.zeros((), dtype=torch.long))

    @property
    def share(self) -> float:
        """The occupied share of the voxel grid."""
        return float(self.mask.float().mean())

    def _with(self, mask: Tensor) -> Occupancy:
        part = Occupancy(torch.zeros(1, 1, 1), (1, 1, 1), least=self.least, block=self.block).to(mask.device)
        part.mask, part.wanted = mask, self._no_blocks(mask)
        return part

    def _no_blocks(self, mask: Tensor) -> Tensor:
        return mask.new_zeros([-(-size // self.block) for size in mask.shape])

    def rows(self, rows: slice) -> Occupancy:
        """The occupancy of some slices."""
        return self._with(self.mask[..., rows].clone())

    def coarser(self, shape: Sequence[int]) -> Occupancy:
        """The occupancy on a voxel grid (depth, height, width) with half the resolution."""
        depth, height, width = shape
        return self._with(functional.adaptive_max_pool3d(self.mask.float()[None], (depth, width, height))[0] > 0)

    @torch.no_grad()
    def wants(self, gradient: Tensor, projector: Projector, cost: float) -> Tensor:
        """The blocks of voxels that pass the test for occupation; arguments as for `retest`."""
        options: dict[str, Any] = {"ceil_mode": True, "divisor_override": 1}
        # slices are projected independently, so those of a block can be summed first
        depth, width, height = (min(self.block, size) for size in self.mask.shape)  # a thin volume is one block deep
        slabs = functional.avg_pool2d(gradient[None, None], (1, height), **options)[0, 0]
        lattice = projector.backproject(slabs).view(*self.mask.shape[:2], -1)
        gain = -functional.avg_pool3d(lattice[None, None], (depth, width, 1), **options)[0, 0]
        return gain > 6 * self.block**2 * cost

    @torch.no_grad()
    def retest(self, gradient: Tensor, projector: Projector, cost: float, *, every: int = 10) -> None:
        """In every tenth call, test unoccupied blocks and occupy those that pass.

        Args:
            gradient: gradient of the loss with respect to the line integrals, (tilts * detector_width, height).
            cost: cost of the total variation, loss per unit of attenuation and voxel face.
        """
        self.num_steps += 1
        if int(self.num_steps) % every:
            return
        wanted = self.wants(gradient, projector, cost)
        lasting, self.wanted = wanted & self.wanted, wanted
        for axis, size in enumerate(self.mask.shape):
            lasting = lasting.repeat_interleave(self.block, axis).narrow(axis, 0, size)
        if bool((lasting & ~self.mask).any()):
            self.mask |= lasting
