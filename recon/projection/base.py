"""Base class of projectors: line integrals of a volume, and their adjoint; and the sparse matrix that they multiply with."""

from __future__ import annotations

import sys
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, hstack, vstack
from torch import Tensor

from noiseflow.arrays import Given, alike, as_tensor


class Projector(ABC):
    """Base class of linear operators from volumes to the line integrals of a tilt series.

    A subclass defines `project` and `backproject` in the native layout, in which slices are columns and no copies are needed.
    Everything else has defaults; `has_parts` and `half` indicate optional capabilities.

    Attributes:
        tilt_angles: (tilts,) degrees.
        depth, width: voxels along z and x.
        detector_width: pixels along u.
        fixed_height: voxels along y if slices are not projected independently; None if any number of them is accepted.
        has_parts: whether slices are projected independently and `part` returns submatrices; False by default.
    """

    tilt_angles: NDArray[np.float64]
    depth: int
    width: int
    detector_width: int
    fixed_height: int | None = None
    has_parts: bool = False

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


_WIDEST = 256


class PanelledMatrix:
    """A matrix stored as panels of neighbouring columns, each in CSR format.

    A row of the whole matrix would access elements scattered over a volume larger than the cache, in different memory pages. A
    row of a panel accesses few elements, and its neighbour nearly the same ones. At 256³ this is four times faster.

    Args:
        panels: sparse CSR tensors with equal numbers of rows, side by side.
    """

    def __init__(self, panels: Sequence[Tensor]) -> None:
        self.panels = list(panels)
        ends = accumulate((panel.shape[1] for panel in self.panels), initial=0)
        self._spans = [slice(*span) for span in pairwise(ends)]

    @staticmethod
    def of(
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        values: NDArray[np.floating[Any]],
        shape: tuple[int, ...],
        *,
        panel: int,
    ) -> PanelledMatrix:
        """The matrix of the given entries, in panels of `panel` columns; entries at the same position are added."""
        number, panels = columns // panel, []
        for start in range(0, shape[1], panel):
            here = number == start // panel
            size = (shape[0], min(panel, shape[1] - start))
            panels.append(csr_tensor(csr_array((values[here], (rows[here], columns[here] - start)), shape=size)))
        return PanelledMatrix(panels)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.panels[0].shape[0], self._spans[-1].stop

    def to(self, *, device: torch.device | str, dtype: torch.dtype) -> PanelledMatrix:
        """A copy on another device, with another data type."""
        return PanelledMatrix([panel.to(device=device, dtype=dtype) for panel in self.panels])

    def __matmul__(self, dense: Tensor) -> Tensor:
        """(columns, n) -> (rows, n)."""
        if dense.shape[0] != self.shape[1]:
            raise ValueError(f"{dense.shape[0]} rows do not match the {self.shape[1]} columns of the matrix")
        result = dense.new_empty(self.shape[0], dense.shape[1])
        widest = _WIDEST if dense.device.type == "cpu" else sys.maxsize
        for start in range(0, dense.shape[1], widest):
            part = result[:, start : start + widest]
            for number, (panel, span) in enumerate(zip(self.panels, self._spans, strict=True)):
                torch.addmm(part, panel, dense[span, start : start + widest], beta=min(number, 1), out=part)
        return result

    def turned(self, panel: int) -> PanelledMatrix:
        """The transpose in panels of `panel` columns, built panel by panel."""
        own = [_scipy(each) for each in self.panels]
        starts = range(0, self.shape[0], panel)
        parts = (vstack([each[at : at + panel].T.tocsr() for each in own], format="csr") for at in starts)
        return PanelledMatrix([csr_tensor(part).to(self.panels[0].device) for part in parts])

    def entries(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Row, column and value of every entry."""
        found = []
        for panel, span in zip(self.panels, self._spans, strict=True):
            rows = np.repeat(np.arange(self.shape[0]), panel.crow_indices().diff().cpu().numpy())
            found.append((rows, panel.col_indices().cpu().numpy() + np.int64(span.start), panel.values().cpu().numpy()))
        rows, columns, values = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return rows, columns, values.astype(np.float64)

    def some_rows(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """The submatrix of some rows, (n,) indices, and its transpose, as single CSR tensors."""
        whole = hstack([_scipy(panel)[rows.cpu().numpy()] for panel in self.panels], format="csr")
        like = self.panels[0]
        return csr_tensor(whole).to(like), csr_tensor(whole.T.tocsr()).to(like)


def index_type(*counts: int) -> type[np.signedinteger[Any]]:
    """The smallest index type for these counts; large matrices exceed 2³¹."""
    return np.int32 if max(counts) < 2**31 else np.int64


def _scipy(matrix: Tensor) -> Any:
    """Convert a CSR tensor to a SciPy matrix, with shared memory on the CPU."""
    parts = tuple(part.cpu().numpy() for part in (matrix.values(), matrix.col_indices(), matrix.crow_indices()))
    return csr_array(parts, shape=tuple(matrix.shape))


def csr_tensor(matrix: Any) -> Tensor:
    """Convert a SciPy CSR matrix to a tensor."""
    matrix.sort_indices()
    kind = index_type(matrix.nnz, *matrix.shape)
    with warnings.catch_warnings():  # torch warns that CSR is in beta
        warnings.simplefilter("ignore")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(kind, copy=False)),
            torch.from_numpy(matrix.indices.astype(kind, copy=False)),
            torch.from_numpy(matrix.data),
            size=matrix.shape,
        )
