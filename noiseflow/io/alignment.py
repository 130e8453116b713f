"""IMOD's ``.xf`` files of alignments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, text_lines


def read_transforms(path: str | Path) -> NDArray[np.float64]:
    """Read an IMOD ``.xf`` file.

    Args:
        path: text file, one line ``A11 A12 A21 A22 DX DY`` per section.

    Returns:
        (section, 2, 3): the matrix A and the shift in pixels, in the order (x, y) of IMOD.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a line does not hold six numbers, a matrix is not invertible, or the file is empty.
    """
    path = Path(path)
    rows = []
    for count, line in enumerate(text_lines(path, "alignment file", holds="six numbers per line"), 1):
        if not line.strip():
            continue
        try:
            a11, a12, a21, a22, dx, dy = map(number, line.split())
        except ValueError:
            raise ValueError(f"{path} line {count}: six numbers A11 A12 A21 A22 DX DY are needed") from None
        row = np.array([[a11, a12, dx], [a21, a22, dy]])
        if not np.isfinite(row).all() or abs(np.linalg.det(row[:, :2])) < 1e-6:
            raise ValueError(f"{path} line {count}: this transform is not invertible; check the alignment file")
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} holds no transforms; one line of six numbers per section is required")
    return np.stack(rows)
