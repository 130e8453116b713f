"""Tilt angles in Velox's EMD files: every frame has its own JSON text of metadata, of which other readers look at the first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import require_room


def stage_angles(path: Path, count: int) -> NDArray[np.float64] | None:
    """The stage's alpha tilt of every frame, degrees; None where the file does not tell so many, or it stood still."""
    import h5py

    with h5py.File(path, "r") as file:
        images = file.get("Data/Image")
        groups = images.values() if isinstance(images, h5py.Group) else ()
        texts = [group["Metadata"] for group in groups if isinstance(group, h5py.Group) and "Metadata" in group]
        for text in texts:
            if text.ndim == 2 and text.shape[1] == count:
                require_room(text.nbytes, path, compressed=True)
                return _alpha(np.asarray(text, dtype=np.uint8))
    return None


def _alpha(texts: NDArray[np.uint8]) -> NDArray[np.float64] | None:
    try:
        frames: list[dict[str, Any]] = [json.loads(column.tobytes().partition(b"\0")[0]) for column in texts.T]
        radians = np.array([float(frame["Stage"]["AlphaTilt"]) for frame in frames])
    except (ValueError, KeyError, TypeError):
        return None
    told = np.isfinite(radians).all() and np.abs(radians).max() <= np.pi and np.ptp(radians) > 0
    return np.rad2deg(radians) if told else None
