"""The sum of dense grids at doubling resolutions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from recon.fields.fields import EMPTY, Field
from recon.fields.upsampling import upsample
from recon.projection.gradients import SavedGradient
from recon.projection.tiles import Tiles

# Half width of the bend of `positive`, units. Softplus bends over several units: the slope of vacuum is a thousandth of that of
# the object, and L-BFGS needs many times the steps. At 0.1, vacuum keeps a haze of 6 % of the mass of a particle, and the mass is
# 4 % too large (`tests/recon/joint/test_counts.py`); at 0.03, filaments lose 0.1 dB.
_BEND = 0.03
# Units at the start of a fit, where vacuum is less than 1 % of the object but can still move.
_LEAST, _MOST = 0.008, 20.0
# Scale of the values of the finest grid, units: the largest change by the first step of a fit.
_STEP = 0.3


class MultiresolutionField(Field):
    """The sum of dense grids at doubling resolutions: as general as `VoxelField`, but much better conditioned.

    The coarse grids act as a multigrid preconditioner: one step changes all wavelengths.

    Args:
        coarsest: minimum number of voxels along the longest side of the coarsest grid.

    Example:
        >>> import recon
        >>> field = recon.MultiresolutionField((8, 8, 8))
        >>> field.volume().shape, len(list(field.parameters()))
        (torch.Size([8, 8, 8]), 2)
    """

    quasi_newton = True

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0, coarsest: int = 3) -> None:
        super().__init__(shape, scale=scale)
        if coarsest < 1:
            raise ValueError(f"coarsest {coarsest} must be at least one voxel")
        sizes = [(self.depth, self.width, self.height)]
        while max(sizes[0]) >= 2 * coarsest:
            sizes.insert(0, tuple((size + 1) // 2 for size in sizes[0]))  # type: ignore[arg-type]
        self.grids = nn.ParameterList(nn.Parameter(torch.zeros(size)) for size in sizes)
        nn.init.constant_(self.grids[0], float(unconstrained(torch.tensor(EMPTY))))

    def start_from(self, volume: Tensor) -> None:
        """Initialise a grid four times coarser than the voxel grid, because finer detail of the volume is noise."""
        with torch.no_grad():
            for grid in self.grids:
                grid.zero_()
            grid = self.grids[max(0, len(self.grids) - 3)]
            grid.copy_(unconstrained(self._units_of(volume, grid.shape).clamp(_LEAST, _MOST)))

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The grids, finest first. A step by the gradient alone changes a grid by the square of its scale: scales that decrease
        by √2 per level correct long wavelengths first. With a factor of 2, fits to outliers follow single pixels (48³: -0.7 dB
        on shells); with a factor of 1, filaments need twice the steps."""
        return [{"params": [grid], "lr": _STEP / 2 ** (level / 2)} for level, grid in enumerate(reversed(self.grids))]

    @property
    def has_coarser(self) -> bool:
        return len(self.grids) > 1 and type(self) is MultiresolutionField

    def coarser(self) -> Field | None:
        """The sum of all grids except the finest; None for derived classes that compute their volume differently."""
        if not self.has_coarser:
            return None
        depth, width, height = self.grids[-2].shape
        field = MultiresolutionField((depth, height, width), scale=2 * float(self.scale)).to(self.scale.device)
        field.grids = self.grids[:-1]
        return field

    def units(self) -> Tensor:
        return positive(_sum(list(self.grids)))

    def on(self, tiles: Tiles) -> Tensor:
        *coarse, finest = self.grids
        values = tiles.gathered(finest)
        if coarse:
            values = values + tiles.upsampled(_sum(coarse))
        return positive(values) * tiles.filled


def positive(values: Tensor) -> Tensor:
    """(v + √(v² + 4b²)) / 2, a hyperbola between 0 and v, with bend b."""
    found: Tensor = _Hyperbola.apply(values)  # type: ignore[no-untyped-call]
    return found


def unconstrained(units: Tensor) -> Tensor:
    """The inverse of `positive`."""
    return units - _BEND**2 / units


class _Hyperbola(SavedGradient):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        root = torch.addcmul(values.new_tensor(4 * _BEND**2), values, values).sqrt_()
        found = torch.add(values, root).mul_(0.5)
        ctx.save_for_backward(torch.div(found, root, out=root))
        return found


def _sum(grids: Sequence[Tensor]) -> Tensor:
    total, *finer = grids
    for grid in finer:
        total = upsample(total, grid.shape, plus=grid)
    return total


FIELD = MultiresolutionField
