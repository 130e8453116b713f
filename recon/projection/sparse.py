"""A sparse matrix that is multiplied panel by panel for better cache use."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
        from scipy.sparse import csr_array

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
        from scipy.sparse import vstack

        own = [_scipy(each) for each in self.panels]
        starts = range(0, self.shape[0], panel)
        return PanelledMatrix(
            [csr_tensor(vstack([each[at : at + panel].T.tocsr() for each in own], format="csr")) for at in starts]
        )

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
        from scipy.sparse import hstack

        whole = hstack([_scipy(panel)[rows.cpu().numpy()] for panel in self.panels], format="csr")
        like = self.panels[0]
        return csr_tensor(whole).to(like), csr_tensor(whole.T.tocsr()).to(like)


def index_type(*counts: int) -> type[np.signedinteger[Any]]:
    """The smallest index type for these counts; large matrices exceed 2³¹."""
    return np.int32 if max(counts) < 2**31 else np.int64


def _scipy(matrix: Tensor) -> Any:
    """Convert a CSR tensor to a SciPy matrix, with shared memory on the CPU."""
    from scipy.sparse import csr_array

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
