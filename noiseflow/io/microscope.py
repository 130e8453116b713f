"""The microscopes' own formats, through rosettasciio: DM3, DM4, EMD, SER, hspy, NeXus (extra ``[formats]``)."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import require_room
from noiseflow.io.images import ImageFile, VoxelSize

_PLUGINS = {
    ".dm3": "digitalmicrograph",
    ".dm4": "digitalmicrograph",
    ".emd": "emd",
    ".ser": "tia",
    ".emi": "tia",
    ".hspy": "hspy",
    ".nxs": "nexus",
    ".h5": "nexus",
    ".hdf5": "nexus",
}
_UNCOMPRESSED = frozenset({"digitalmicrograph", "tia"})
_ANGSTROM = {"å": 1.0, "a": 1.0, "angstrom": 1.0, "pm": 0.01, "nm": 10.0, "µm": 1e4, "μm": 1e4, "um": 1e4, "m": 1e10}
_DEGREES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0, "rad": 180 / np.pi, "radian": 180 / np.pi}
_ANGLE_NAME = re.compile(r"stage angle|tilt|theta|rotation.?angle|(stage.*alpha)", re.IGNORECASE)


def read(path: Path) -> ImageFile:
    """Read the largest image, stack or volume of a microscope's file, with its pixel size and tilt angles."""
    plugin = _PLUGINS[path.suffix.lower()]
    try:
        reader = importlib.import_module(f"rsciio.{plugin}").file_reader
        signals = reader(str(path), lazy=True)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path}: reading {path.suffix} needs {error.name}, which is not installed; "
            "install it with: pip install 'noiseflow[formats]'"
        ) from error
    images = [signal for signal in signals if signal["data"].ndim in (2, 3)]
    if not images:
        raise ValueError("it holds no image or stack")
    signal = max(images, key=lambda found: (found["data"].ndim, found["data"].size))
    lazy = signal["data"]
    require_room(lazy.nbytes, path, compressed=plugin not in _UNCOMPRESSED)
    data = np.asarray(lazy.compute(scheduler="single-threaded") if hasattr(lazy, "compute") else lazy)
    data = data.astype(data.dtype.newbyteorder("="), copy=False)
    axes = sorted(signal["axes"], key=lambda axis: axis["index_in_array"])
    return ImageFile(data, _voxel_size(axes), _tilt_angles(signal, axes, len(data)) if data.ndim == 3 else None)


def _voxel_size(axes: list[dict[str, Any]]) -> VoxelSize | None:
    """Å along (z, y, x); a section of a tilt series counts as deep as a pixel is wide."""
    edges = [_ANGSTROM.get(str(axis.get("units")).lower(), 0.0) * abs(float(axis["scale"])) for axis in axes]
    *depth, y, x = edges
    if not (y > 0 and x > 0):
        return None
    return (depth[0] if depth and depth[0] > 0 else x, y, x)


def _tilt_angles(signal: Mapping[str, Any], axes: list[dict[str, Any]], count: int) -> NDArray[np.float64] | None:
    """Degrees: the stage's own readings for every section, or the calibration of the stack's first axis."""
    recorded: dict[str, list[float]] = {}
    for tree in (signal.get("original_metadata"), signal.get("metadata")):
        for name, value in _leaves(tree):
            if _ANGLE_NAME.search(name):
                recorded.setdefault(re.sub(r"\d+", "#", name), []).extend(value)
    for values in recorded.values():
        if len(values) == count and np.ptp(values) > 1 and max(map(abs, values)) <= 180:
            return np.array(values)
    unit = _DEGREES.get(str(axes[0].get("units")).lower())
    if unit is None:
        return None
    steps = np.arange(count, dtype=np.float64)
    return unit * (float(axes[0]["offset"]) + float(axes[0]["scale"]) * steps)


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, list[float]]]:
    """(name, numbers) of every numeric leaf of a tree of metadata."""
    if isinstance(tree, Mapping):
        for name, child in tree.items():
            yield from _leaves(child, f"{path}/{name}")
        return
    values = (
        np.asarray(tree) if isinstance(tree, (int, float, list, tuple, np.ndarray, np.generic)) else np.zeros(0, str)
    )
    if values.dtype.kind in "iuf":
        yield path, [float(value) for value in values.reshape(-1)]
