"""Refusals that name the pixel: what comes after may trust the data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def require_finite(data: NDArray[Any], name: str | Path) -> None:
    """Refuse NaN and infinite pixels, naming how many there are and where the first one is."""
    if not np.issubdtype(data.dtype, np.floating):
        return
    bad = ~np.isfinite(data)
    count = int(bad.sum())
    if count:
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} has {count} NaN or infinite pixels, the first at {where}; replace them or mask them before this step"
        )


def require_contrast(data: NDArray[Any], name: str | Path) -> None:
    """Refuse an image whose pixels are all equal."""
    if data.size and data.min() == data.max():
        raise ValueError(f"{name} is flat: every pixel is {data.flat[0]}; check that the right file was given")


def require_room(claimed: int, path: Path, *, compressed: bool = False) -> None:
    """Refuse pixels that the file cannot hold, before memory is taken for them.

    Args:
        claimed: bytes of pixels that the header promises.
        path: the file.
        compressed: allow a thousand times the file's size; no compression of real images comes near.
    """
    size = path.stat().st_size
    if claimed > (1000 * size if compressed else size):
        raise ValueError(f"its header claims {claimed} bytes of pixels; the file has {size}")
