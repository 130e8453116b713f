"""Base class of projectors: line integrals of a volume, and their adjoint."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from noiseflow.arrays import Given, alike, as_tensor

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Projector(ABC):
    """Base class of linear operators from volumes to the line integrals of a tilt series.

    A subclass defines `project` and `backproject` in the native layout, in which slices are columns and no copies are needed.
    Everything else has defaults; `has_parts` and `half` indicate optional capabilities.

    Attributes:
        tilt_angles: (tilts,) degrees.
        depth, width: voxels along z and x.
        detector_width: pixels along u.
        fixed_height: voxels along y if slices are not projected independently; None if any number of them is accepted.
    """

    tilt_angles: NDArray[np.float64]
    depth: int
    width: int
    detector_width: int
    fixed_height: int | None = None

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of the computation."""

    @property
    @abstractmethod
    def dtype(self) -> torch.dtype:
        """Data type of the computation."""

    @abstractmethod
    def project(self, columns: Tensor) -> Tensor:
        """(depth * width, slices) -> line integrals (tilts * detector_width, slices), differentiable."""

    @abstractmethod
    def backproject(self, rays: Tensor) -> Tensor:
        """The adjoint of `project`: (tilts * detector_width, slices) -> (depth * width, slices)."""

    @property
    def num_tilts(self) -> int:
        """Number of tilts."""
        return int(np.size(self.tilt_angles))

    @property
    def has_parts(self) -> bool:
        """Whether slices are projected independently and `part` returns submatrices. Default: False."""
        return False

    def part(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        """The sparse matrix of some columns of a slice, (n,) indices z·width + x, and its transpose. Raises ValueError if the
        projector does not support submatrices.
        """
        raise ValueError(f"{type(self).__name__} has no parts; check has_parts first")

    def half(self, depth: int, width: int, num_columns: int, first_columns: NDArray[np.int64]) -> Projector | None:
        """The projector of a grid with half the resolution to every second pixel along u; None if not supported.

        Args:
            depth, width: voxels of that grid along z and x.
            num_columns: number of pixels of each image.
            first_columns: (tilts,) index of the first pixel, 0 or 1.
        """
        return None

    def __call__(self, attenuation: Given) -> Given:
        """Project a volume (z, y, x), attenuation per voxel, to line integrals (tilt, y, u)."""
        volume = as_tensor(attenuation, like=self)
        _require(volume, "attenuation (z, y, x)", self.depth, self.width)
        return alike(from_rays(self.project(to_columns(volume)), self.num_tilts), attenuation)

    def T(self, line_integrals: Given) -> Given:  # named like the transposed operator
        """Back-project images (tilt, y, u) to a volume (z, y, x): the exact adjoint of calling the projector."""
        images = as_tensor(line_integrals, like=self)
        _require(images, "line_integrals (tilt, y, u)", self.num_tilts, self.detector_width)
        return alike(from_columns(self.backproject(to_rays(images)), self.depth), line_integrals)


def to_columns(volume: Tensor) -> Tensor:
    """(z, y, x) -> (z * x, y): each slice becomes one column."""
    return volume.transpose(1, 2).reshape(volume.shape[0] * volume.shape[2], volume.shape[1])


def from_columns(columns: Tensor, depth: int) -> Tensor:
    """(z * x, y) -> (z, y, x), a view."""
    return columns.reshape(depth, -1, columns.shape[1]).transpose(1, 2)


to_rays = to_columns
"""(tilt, y, u) -> (tilt * u, y)."""
from_rays = from_columns
"""(tilt * u, y) -> (tilt, y, u), a view."""


def _require(tensor: Tensor, what: str, first: int, last: int) -> None:
    if tensor.ndim != 3 or tensor.shape[0] != first or tensor.shape[2] != last:
        raise ValueError(f"{what} must have shape ({first}, any, {last}), not {tuple(tensor.shape)}")


Multiply = Callable[[Tensor, bool], Tensor]


def linear(dense: Tensor, multiply: Multiply, *, transposed: bool = False) -> Tensor:
    """``multiply(dense, transposed)``, the product with a matrix or with its transpose; its gradient is the other product."""
    result: Tensor = _Linear.apply(dense, multiply, transposed)  # type: ignore[no-untyped-call]
    return result


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dense: Tensor, multiply: Multiply, transposed: bool) -> Tensor:
        ctx.of = multiply, transposed
        return multiply(dense, transposed)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        multiply, transposed = ctx.of
        return linear(gradient, multiply, transposed=not transposed), None, None


class SavedGradient(torch.autograd.Function):
    """A scalar function whose ``forward`` saves the gradient with respect to its first argument, the only differentiable one."""

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * outer, *[None] * (len(ctx.needs_input_grad) - 1)
