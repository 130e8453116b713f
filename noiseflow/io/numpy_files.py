"""NumPy files: ``.npy`` with one array, ``.npz`` with several named arrays."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import choose_member, require_room
from noiseflow.io.image_file import ImageFile
from noiseflow.io.metadata import recorded_angles
from noiseflow.runs.ownership import NPY_HEADER_BYTES, npy_start

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npy(path: Path, *, mapped: bool = False) -> ImageFile:
    """Read the array, or memory-map it if `mapped`; the memory map checks the claimed size against the file."""
    data = np.load(path, mmap_mode="c", allow_pickle=False)
    return ImageFile(data if mapped else np.array(data))


def read_npz(path: Path, member: str | None = None) -> ImageFile:
    """Read the named or largest image, stack or volume. Tilt angles are read from ``tilt_angles`` and similar names."""
    with np.load(path, allow_pickle=False) as archive:
        names = list(archive.files)
        shapes = [_claim(archive, name, path) for name in names]
        name = names[choose_member(names, shapes, member)]
        data: NDArray[Any] = archive[name]
        lists = [n for n, shape in zip(names, shapes, strict=True) if shape == (len(data),)]
        angles = recorded_angles(((n, [float(value) for value in archive[n]]) for n in lists), len(data))
    return ImageFile(data, None, angles)


def write(path: Path, data: NDArray[Any]) -> NDArray[Any]:
    """Write an array of any data type unchanged, section by section, with the mark of `noiseflow.runs.ownership`.

    Returns:
        The pixels as stored.
    """
    described = {"descr": np.lib.format.dtype_to_descr(data.dtype), "fortran_order": False, "shape": data.shape}
    start = npy_start()
    with path.open("wb") as stream:
        stream.write(start + repr(described).encode().ljust(NPY_HEADER_BYTES - len(start) - 1) + b"\n")
        for section in data:
            stream.write(np.ascontiguousarray(section).data)
    return data


def _claim(archive: Any, name: str, path: Path) -> tuple[int, ...]:
    """The shape in an array's header; raises ValueError if the file cannot hold it."""
    with archive.zip.open(f"{name}.npy") as stream:
        version = np.lib.format.read_magic(stream)
        shape, _, dtype = _HEADERS[version](cast(IO[bytes], stream))
    require_room(int(np.prod(shape, dtype=object)) * dtype.itemsize, path, compressed=True)
    return tuple(shape)
