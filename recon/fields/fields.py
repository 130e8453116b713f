"""Volume parameterisations (fields): ``field()`` returns the attenuation on the voxel grid in the projector's layout."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.models.base import Described
from recon.fields.upsampling import upsample
from recon.projection.projector import from_columns
from recon.projection.tiles import Tiles

_COARSE = 16  # voxels along each axis for the comparison of a field with its initial volume
_MUCH_NEARER = 0.25  # ratio of squared distances; detail lost by a smooth field contributes equally to both
_LEAST = 0.003  # attenuation of an empty field, in units of its scale; low, because a haze would be fitted as a brighter beam


class Field(Described, ABC):
    """Base class of fields: trainable volumes of non-negative attenuation.

    Args:
        shape: (depth, height, width) of the voxel grid, voxels along (z, y, x).
        scale: attenuation per voxel of one unit; a guess within a factor of ten suffices.

    Example:
        >>> import recon, torch
        >>> field = recon.VoxelField((4, 6, 8))
        >>> isinstance(field, recon.Field), field.volume().shape
        (True, torch.Size([4, 6, 8]))
    """

    measured_in = "attenuation per voxel"
    scale: Tensor
    relative_rate = 1.0
    """Learning rate of the field relative to that of a voxel field."""

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0) -> None:
        super().__init__()
        if len(shape) != 3 or min(shape) < 1:
            raise ValueError(f"shape {tuple(shape)}: give three sizes (depth, height, width) of at least one voxel")
        if not 0 < scale < math.inf:
            raise ValueError(f"scale {scale} must be positive and finite")
        self.depth, self.height, self.width = shape
        self.register_buffer("scale", torch.tensor(float(scale)))

    @abstractmethod
    def units(self) -> Tensor:
        """Non-negative attenuation in units of the scale, (depth, width, height)."""

    def at(self, places: Tensor) -> Tensor:
        """Attenuation, in units of the scale, at (N,) flat indices of the voxel grid (z, x, y)."""
        return self.units().reshape(-1).index_select(0, places)

    def on(self, tiles: Tiles) -> Tensor:
        """Attenuation on the list of `tiles`, (N,), in units of the scale; zero at unoccupied voxels."""
        values = self.at(tiles.voxels)
        return values.new_zeros(tiles.filled.numel()).index_copy(0, tiles.occupied, values)

    @abstractmethod
    def start_from(self, volume: Tensor) -> None:
        """Initialise with a rough volume (z, y, x) of the same extent and any resolution, with vacuum raised slightly."""

    @torch.no_grad()
    def check_axes(self, volume: Tensor) -> None:
        """Check the order of axes by a coarse comparison with the volume (z, y, x) that initialised the field.

        Raises:
            ValueError: the field has y and x swapped, which shapes cannot reveal if slices are square.
        """
        held = self.volume()
        if self.height != self.width:
            return
        depth, height, width = (min(_COARSE, *pair) for pair in zip(held.shape, volume.shape, strict=True))
        size = (depth, height, width)
        held, given = (functional.adaptive_avg_pool3d(each[None, None].float(), size) for each in (held, volume))
        straight, swapped = (float((held - each).square().sum()) for each in (given, given.transpose(-1, -2)))
        if swapped < _MUCH_NEARER * straight:
            raise ValueError(
                f"{type(self).__name__} was initialised with a volume and has y and x swapped; units() has the axes "
                "(z, x, y), volumes have (z, y, x): transpose in start_from() or in units()"
            )

    @property
    def has_coarser(self) -> bool:
        """Whether `coarser` returns a field."""
        return False

    def coarser(self) -> Field | None:
        """This field on a voxel grid with half the resolution, with shared parameters. None if there is no such grid."""
        return None

    def _raw_of(self, volume: Tensor, shape: Sequence[int]) -> Tensor:
        """Unconstrained values of a volume (z, y, x) resampled to `shape`, (depth, width, height)."""
        lattice = volume.transpose(1, 2)[None, None] / self.scale
        pooled = functional.adaptive_avg_pool3d(lattice, (shape[0], shape[1], shape[2]))[0, 0]
        return torch.log(torch.expm1(pooled.clamp(_LEAST, 20)))

    def forward(self) -> Tensor:
        """Attenuation per voxel, (depth * width, height)."""
        values = self.units() * self.scale
        expected = (self.depth, self.width, self.height)
        if values.shape != expected:
            raise ValueError(
                f"{type(self).__name__}.units() has shape {tuple(values.shape)}; give (depth, width, height) = {expected}"
            )
        return values.reshape(self.depth * self.width, self.height)

    def extra_repr(self) -> str:
        """Voxel grid and scale."""
        return f"{self.depth} x {self.height} x {self.width} voxels (z, y, x), scale={float(self.scale):.4g}"

    def volume(self) -> Tensor:
        """The attenuation as (z, y, x), detached."""
        with torch.no_grad():
            return from_columns(self(), self.depth).contiguous()


class VoxelField(Field):
    """One free parameter per voxel.

    Example:
        >>> import recon
        >>> recon.VoxelField((4, 6, 8)).volume().shape  # (z, y, x)
        torch.Size([4, 6, 8])
    """

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0) -> None:
        super().__init__(shape, scale=scale)
        empty = math.log(math.expm1(_LEAST))
        self.values = nn.Parameter(torch.full((self.depth, self.width, self.height), empty))

    def start_from(self, volume: Tensor) -> None:
        with torch.no_grad():
            self.values.copy_(self._raw_of(volume, self.values.shape))

    def units(self) -> Tensor:
        return functional.softplus(self.values)

    def on(self, tiles: Tiles) -> Tensor:
        return functional.softplus(tiles.gathered(self.values)) * tiles.filled


class MultiresolutionField(Field):
    """The sum of dense grids at doubling resolutions: as general as `VoxelField`, but much better conditioned.

    The coarse grids act as a multigrid preconditioner: one step of Adam changes all wavelengths.

    Args:
        coarsest: minimum number of voxels along the longest side of the coarsest grid.

    Example:
        >>> import recon
        >>> field = recon.MultiresolutionField((8, 8, 8))
        >>> field.volume().shape, len(list(field.parameters()))
        (torch.Size([8, 8, 8]), 2)
    """

    def __init__(self, shape: Sequence[int], *, scale: float = 1.0, coarsest: int = 3) -> None:
        super().__init__(shape, scale=scale)
        if coarsest < 1:
            raise ValueError(f"coarsest {coarsest} must be at least one voxel")
        sizes = [(self.depth, self.width, self.height)]
        while max(sizes[0]) >= 2 * coarsest:
            sizes.insert(0, tuple((size + 1) // 2 for size in sizes[0]))  # type: ignore[arg-type]
        self.grids = nn.ParameterList(nn.Parameter(torch.zeros(size)) for size in sizes)
        nn.init.constant_(self.grids[0], math.log(math.expm1(_LEAST)))

    def start_from(self, volume: Tensor) -> None:
        """Initialise a grid four times coarser than the voxel grid, because finer detail of the volume is noise."""
        with torch.no_grad():
            for grid in self.grids:
                grid.zero_()
            grid = self.grids[max(0, len(self.grids) - 3)]
            grid.copy_(self._raw_of(volume, grid.shape))

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
        return functional.softplus(_sum(list(self.grids)))

    def on(self, tiles: Tiles) -> Tensor:
        *coarse, finest = self.grids
        values = tiles.gathered(finest)
        if coarse:
            values = values + tiles.upsampled(_sum(coarse))
        return functional.softplus(values) * tiles.filled


def _sum(grids: Sequence[Tensor]) -> Tensor:
    total, *finer = grids
    for grid in finer:
        total = upsample(total, grid.shape, plus=grid)
    return total
