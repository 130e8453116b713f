"""Panels of a sparse matrix against the dense matrix."""

import numpy as np
import pytest
import torch

from recon.projection.base import PanelledMatrix, index_type


def example(panel: int, shape: tuple[int, int] = (30, 50)) -> tuple[PanelledMatrix, torch.Tensor]:
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(0, shape[0], 400), rng.integers(0, shape[1], 400)  # some of them twice
    values = rng.normal(size=400)
    dense = torch.zeros(shape, dtype=torch.float64)
    dense.index_put_((torch.from_numpy(rows), torch.from_numpy(columns)), torch.from_numpy(values), accumulate=True)
    return PanelledMatrix.of(rows, columns, values, shape, panel=panel), dense


@pytest.mark.parametrize("panel", [1, 7, 25, 50, 1000])
@pytest.mark.parametrize("width", [1, 300])
def test_it_multiplies_as_the_dense_matrix_does(panel: int, width: int) -> None:
    matrix, dense = example(panel)
    factor = torch.randn(width, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).T
    torch.testing.assert_close(matrix @ factor, dense @ factor)
    torch.testing.assert_close(matrix @ factor.contiguous(), dense @ factor)
    assert matrix.shape == (30, 50)


def test_entries_and_rows_are_those_of_the_whole() -> None:
    matrix, dense = example(7)
    rows, columns, values = matrix.entries()
    assert len(values) == int((dense != 0).sum())
    assert np.array_equal(values, dense.numpy()[rows, columns])
    chosen = torch.tensor([3, 4, 17])
    some, transposed = matrix.some_rows(chosen)
    torch.testing.assert_close(some.to_dense(), dense[chosen])
    torch.testing.assert_close(transposed.to_dense(), dense[chosen].T)


def test_a_factor_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="49 rows do not match the 50 columns of the matrix"):
        example(7)[0] @ torch.zeros(49, 2, dtype=torch.float64)


def test_indices_are_wide_where_counts_are() -> None:
    assert index_type(5, 2**31 - 1) is np.int32
    assert index_type(2**31, 3) is np.int64
