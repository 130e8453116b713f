"""One free parameter per voxel."""

from __future__ import annotations

from collections.abc import Sequence

from recon.fields.kinds.grids import MultiresolutionField


class VoxelField(MultiresolutionField):
    """One free parameter per voxel: a sum of grids without the coarse ones.

    Example:
        >>> import recon
        >>> recon.VoxelField((4, 6, 8)).volume().shape  # (z, y, x)
        torch.Size([4, 6, 8])
    """

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0) -> None:
        super().__init__(shape, scale=scale, coarsest=max(shape))


FIELD = VoxelField
