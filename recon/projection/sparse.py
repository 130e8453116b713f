"""A sparse matrix that is multiplied panel by panel, so that what a row gathers stays within reach."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_WIDEST = 256


class PanelledMatrix:
    """Panels of neighbouring columns in compressed rows, stored one by one; together they are the matrix.

    A row of the whole matrix would gather lines from all over a volume larger than any cache, each from another page of memory.
    A row of a panel gathers from few, and its neighbour gathers from nearly the same ones: at 256³ that is four times faster.

    Args:
        panels: sparse CSR tensors of as many rows, side by side.
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
        """The matrix of some entries, those of the same place added up, in panels of `panel` columns."""
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

    @property
    def num_entries(self) -> int:
        """How many entries are stored."""
        return sum(panel.values().numel() for panel in self.panels)

    def to(self, *, device: torch.device | str, dtype: torch.dtype) -> PanelledMatrix:
        """The same on another device, with numbers of another type."""
        return PanelledMatrix([panel.to(device=device, dtype=dtype) for panel in self.panels])

    def __matmul__(self, dense: Tensor) -> Tensor:
        """(columns, n) -> (rows, n)."""
        if dense.shape[0] != self.shape[1]:
            raise ValueError(f"{dense.shape[0]} rows do not match the matrix's {self.shape[1]} columns")
        result = dense.new_empty(self.shape[0], dense.shape[1])
        widest = _WIDEST if dense.device.type == "cpu" else sys.maxsize
        for start in range(0, dense.shape[1], widest):
            part = result[:, start : start + widest]
            for number, (panel, span) in enumerate(zip(self.panels, self._spans, strict=True)):
                torch.addmm(part, panel, dense[span, start : start + widest], beta=min(number, 1), out=part)
        return result

    def turned(self, panel: int) -> PanelledMatrix:
        """The transpose, in panels of `panel` columns, made panel by panel."""
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
        """The matrix of some rows, (n,) indices, and its transpose; CSR tensors in one piece, for few rows reach few lines."""
        from scipy.sparse import hstack

        whole = hstack([_scipy(panel)[rows.cpu().numpy()] for panel in self.panels], format="csr")
        like = self.panels[0]
        return csr_tensor(whole).to(like), csr_tensor(whole.T.tocsr()).to(like)


Entries = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.floating[Any]]]
"""Row, column and value of entries."""


def panelled_by_groups(
    groups: Iterable[Entries], shape: tuple[int, int], *, panel: int, dtype: torch.dtype
) -> PanelledMatrix:
    """A matrix from groups of entries, whose memory is let go of one by one.

    Args:
        groups: entries of the columns of one panel after the other; columns are counted from the first of the panel.
        shape: rows and columns.
        panel: columns of a panel.
        dtype: of the values.
    """
    from scipy.sparse import csr_array

    kind, panels = torch.empty((), dtype=dtype).numpy().dtype, []
    for start, (rows, columns, values) in zip(range(0, shape[1], panel), groups, strict=True):
        size = (shape[0], min(panel, shape[1] - start))
        panels.append(csr_tensor(csr_array((values.astype(kind), (rows, columns)), shape=size)))
    return PanelledMatrix(panels)


def index_type(*counts: int) -> type[np.signedinteger[Any]]:
    """The smaller type of index that holds all these counts: entries, rows and columns of a large matrix pass 2³¹."""
    return np.int32 if max(counts) < 2**31 else np.int64


def _scipy(matrix: Tensor) -> Any:
    """A CSR tensor as SciPy's, of the same memory where that is the processor's."""
    from scipy.sparse import csr_array

    parts = tuple(part.cpu().numpy() for part in (matrix.values(), matrix.col_indices(), matrix.crow_indices()))
    return csr_array(parts, shape=tuple(matrix.shape))


def csr_tensor(matrix: Any) -> Tensor:
    """A SciPy CSR matrix as a tensor."""
    matrix.sort_indices()
    kind = index_type(matrix.nnz, *matrix.shape)
    with warnings.catch_warnings():  # torch announces that CSR is in beta
        warnings.simplefilter("ignore")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(kind, copy=False)),
            torch.from_numpy(matrix.indices.astype(kind, copy=False)),
            torch.from_numpy(matrix.data),
            size=matrix.shape,
        )
