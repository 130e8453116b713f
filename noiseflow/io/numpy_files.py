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


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read an array, or the named or largest image, stack or volume of an archive. Tilt angles of an archive are read from
    ``tilt_angles`` and similar names."""
    if path.suffix.lower() == ".npy":
        # the memory map checks the claimed size against the file
        data: NDArray[Any] = np.load(path, mmap_mode="c", allow_pickle=False)
        return ImageFile(data if mapped else np.array(data))
    with np.load(path, allow_pickle=False) as archive:
        names = list(archive.files)
        shapes = []
        for name in names:
            with archive.zip.open(f"{name}.npy") as stream:
                version = np.lib.format.read_magic(stream)
                shape, _, dtype = _HEADERS[version](cast(IO[bytes], stream))
            require_room(int(np.prod(shape, dtype=object)) * dtype.itemsize, path, compressed=True)
            shapes.append(tuple(shape))
        index, used = choose_member(names, shapes, member)
        name = names[index]
        data = archive[name]
        lists = [n for n, shape in zip(names, shapes, strict=True) if shape == (len(data),)]
        angles = recorded_angles(((n, [float(value) for value in archive[n]]) for n in lists), len(data))
    return ImageFile(data, None, angles, named=used)


def write(path: Path, data: NDArray[Any]) -> NDArray[Any]:
    """Write an array of any data type unchanged, section by section, with the mark of `noiseflow.runs.ownership`.

    Returns:
        The pixels as stored.
    """
    with path.open("wb") as stream:
        stream.write(header(data.dtype, data.shape))
        for section in data:
            stream.write(np.ascontiguousarray(section).data)
    return data


def header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """The header of a ``.npy`` file, with the mark of `noiseflow.runs.ownership`."""
    described = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    start = npy_start()
    return start + repr(described).encode().ljust(NPY_HEADER_BYTES - len(start) - 1) + b"\n"
