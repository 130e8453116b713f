"""What a regulariser is: a cost of volumes, homogeneous of the first degree, so that its weight does not depend on units."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from recon.projection.tiles import Tiles


class Regulariser(ABC):
    """A cost of a volume, differentiable, that is zero for vacuum."""

    @abstractmethod
    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        """The cost of a whole volume, a scalar.

        Args:
            volume: (z, x, y) attenuation per voxel, not negative.
            scale: attenuation per voxel that counts as one unit; the cost of ``k·volume`` at ``k·scale`` is k times as large.
        """

    def of_tiles(self, values: Tensor, tiles: Tiles, scale: float) -> Tensor:
        """The same of the occupied part of a volume that is empty elsewhere; by default of the whole, laid out.

        Args:
            values: (N,) the list of `tiles`.
            tiles: what is occupied.
            scale: as of a call.
        """
        return self(tiles.spread(values), scale)

    def at_half_resolution(self) -> Regulariser:
        """What takes its place in a fit's first steps, at half the resolution; itself by default."""
        return self

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"
