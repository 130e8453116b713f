"""Tilt angles in Velox EMD files, from the JSON metadata of every frame (other readers use only the first frame)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import require_room


def stage_angles(path: Path, count: int) -> NDArray[np.float64] | None:
    """Alpha tilt of the stage for every frame, degrees; None if the number differs from `count` or the stage did not move."""
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
