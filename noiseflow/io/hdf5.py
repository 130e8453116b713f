"""HDF5 and NeXus files: the largest numeric array, or a named one (extra ``[formats]``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from noiseflow.io.checks import choose_member, require_room
from noiseflow.io.image_file import ImageFile, VoxelSize
from noiseflow.io.mapped import IN_MEMORY, mapped_copy
from noiseflow.io.metadata import in_degrees, recorded_angles
from noiseflow.io.units import in_angstrom


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read an image, stack or volume. Tilt angles are read from ``theta``, ``rotation_angle`` and similar datasets.

    Args:
        path: the file.
        member: the dataset's full name, such as ``/exchange/data``.
        mapped: read a large array section by section into a temporary file.
    """
    import h5py

    found: dict[str, Any] = {}
    with h5py.File(path, "r") as file:
        file.visititems(
            lambda name, item: found.__setitem__(f"/{name}", item) if isinstance(item, h5py.Dataset) else None
        )
        names = [name for name, item in found.items() if item.ndim in (2, 3) and item.dtype.kind in "iufc"]
        dataset = found[names[choose_member(names, [found[name].shape for name in names], member)]]
        require_room(dataset.nbytes, path, compressed=dataset.compression is not None)
        native = dataset.dtype.newbyteorder("=")
        data = (
            mapped_copy(dataset, dataset.shape, native, in_memory=IN_MEMORY) if mapped else np.asarray(dataset, native)
        )
        lists = [(name, item) for name, item in found.items() if item.ndim == 1 and item.shape == (len(data),)]
        angles = recorded_angles(
            ((name, list(np.asarray(item, float) * _unit(item))) for name, item in lists if item.dtype.kind in "iuf"),
            len(data),
        )
        voxel_size = _voxel_size(dataset)
    return ImageFile(data, voxel_size, angles)


def _unit(dataset: Any) -> float:
    return in_degrees(_text(dataset.attrs.get("units", "deg"))) or 1.0


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _voxel_size(dataset: Any) -> VoxelSize | None:
    """Read ``element_size_um``, (z, y, x) in µm, as written by ilastik and BigDataViewer, or ``voxel_size`` with its unit."""
    sizes = np.asarray(dataset.attrs.get("element_size_um", ()), dtype=float).reshape(-1)
    unit = in_angstrom("µm") or 0.0
    if sizes.size != 3 or not (sizes > 0).all():
        return None
    z, y, x = (float(size) * unit for size in sizes)
    return z, y, x
