"""NumPy files, and memory-mapped arrays: temporary ones, and output files that are written in parts."""

from __future__ import annotations

import math
import mmap
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mrcfile
import numpy as np
from mrcfile.dtypes import HEADER_DTYPE
from mrcfile.utils import mode_from_dtype
from numpy.typing import NDArray

from noiseflow.io.checks import choose_member, require_room
from noiseflow.io.image_file import MRC_SUFFIXES, ImageFile, VoxelSize
from noiseflow.io.metadata import recorded_angles
from noiseflow.runs.outputs import reserve_room
from noiseflow.runs.ownership import NPY_HEADER_BYTES, npy_start, signature

MRC_HEADER_BYTES = HEADER_DTYPE.itemsize
IN_MEMORY = 2**28
"""Size in bytes up to which a temporary array is kept in memory, because a file would be slower."""
PART = IN_MEMORY // 4
"""Size in bytes of a part of a large array that is computed at a time: several fit into memory."""


def is_large(path: str | Path) -> bool:
    """Whether a file is large enough to be memory-mapped."""
    file = Path(str(path).partition("::")[0])
    parts = file.rglob("*") if file.suffix.lower() == ".zarr" else [file]
    return sum(part.stat().st_size for part in parts if part.is_file()) > IN_MEMORY


def is_mapped(array: NDArray[Any]) -> bool:
    """Whether an array, or its base, is memory-mapped."""
    return any(isinstance(base, np.memmap) for base in _bases(array))


def let_go(array: NDArray[Any]) -> None:
    """Release the memory of mapped pages; their contents remain in the file. Not for copy-on-write maps, which would lose
    their changes."""
    for base in _bases(array):
        if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
            base.madvise(mmap.MADV_DONTNEED)


def _bases(array: Any) -> Iterator[Any]:
    """An array, the one that it is a view of, and so on, down to its buffer."""
    while array is not None:
        yield array
        array = getattr(array, "base", None)


def temporary_map(
    shape: Sequence[int], dtype: Any, *, folder: str | Path | None = None, in_memory: int | None = None
) -> NDArray[Any]:
    """An array of zeros in an unnamed temporary file, which is deleted with the array. Raises OSError if the disk does not have
    enough space.

    Args:
        folder: folder of the file; by default the system's temporary folder (``TMPDIR``).
        in_memory: size in bytes up to which memory is used instead of a file; `IN_MEMORY` by default.
    """
    num_bytes = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
    if num_bytes <= max(IN_MEMORY if in_memory is None else in_memory, 1):  # an empty file cannot be mapped
        return np.zeros(tuple(shape), dtype)
    with tempfile.TemporaryFile(dir=folder) as file:
        reserve_room(file.fileno(), num_bytes)
        return np.memmap(file, dtype, "r+", shape=tuple(shape))


def mapped_copy(
    sections: Iterable[NDArray[Any]], shape: Sequence[int], dtype: Any, *, in_memory: int | None = None
) -> NDArray[Any]:
    """Copy sections one by one to a temporary file. Arguments and errors as for `temporary_map`."""
    result = temporary_map(shape, dtype, in_memory=in_memory)
    for target, section in zip(result, sections, strict=True):
        target[...] = section
    return result


def is_filled_by_parts(path: Path) -> bool:
    """Whether `create_volume` supports files with this suffix."""
    return path.suffix.lower() in MRC_SUFFIXES | {".npy"}


def create_volume(path: Path, shape: tuple[int, ...], voxel_size: VoxelSize | None = None) -> NDArray[np.float32]:
    """Create a memory-mapped MRC or ``.npy`` file of float32 zeros, with its disk space allocated. Raises OSError if the disk
    does not have enough space, and ValueError if the suffix is not supported. The statistics in an MRC header are set by
    `finish_volume`."""
    if not is_filled_by_parts(path):
        raise ValueError(f"{path}: only .npy and MRC files can be written in parts")
    begin = MRC_HEADER_BYTES
    if path.suffix.lower() == ".npy":
        begin = path.write_bytes(npy_header(np.dtype("<f4"), shape))
        _reserve(path, begin + 4 * int(np.prod(shape, dtype=object)))
    else:
        create_mrc(path, shape, np.dtype(np.float32), voxel_size).close()
    return np.memmap(path, "<f4", "r+", begin, shape)


def _reserve(path: Path, num_bytes: int) -> None:
    with path.open("r+b") as stream:
        reserve_room(stream.fileno(), num_bytes)


def create_mrc(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any], voxel_size: VoxelSize | None = None) -> Any:
    """An open, memory-mapped MRC file whose ``data`` are to be filled; `finish_mrc` completes its header. Raises OSError if the
    disk does not have enough space."""
    file = mrcfile.new_mmap(path, shape, mrc_mode=mode_from_dtype(dtype), fill=None, overwrite=True)
    _reserve(path, path.stat().st_size)
    file.add_label(signature())
    if voxel_size is not None:
        file.voxel_size = voxel_size[::-1]
    return file


def finish_volume(path: Path, volume: NDArray[np.float32]) -> None:
    """Flush a volume to its file, and write the statistics of an MRC header."""
    if isinstance(volume, np.memmap):
        volume.flush()
    if path.suffix.lower() in MRC_SUFFIXES:
        finish_mrc(path)


def finish_mrc(path: Path, *, stack: bool = False) -> None:
    """Write the statistics of a complete MRC file to its header, and whether it is a stack of images."""
    with mrcfile.mmap(path, "r+") as file:
        low, high, mean, squares, count = math.inf, -math.inf, 0.0, 0.0, 0
        for part in file.data:  # one pass over the file: mean and sum of squared deviations, part by part
            low, high = min(low, float(part.min())), max(high, float(part.max()))
            own = float(part.mean(dtype=np.float64))
            squares += float(np.sum((part - own) ** 2, dtype=np.float64))
            squares += (own - mean) ** 2 * count * part.size / (count + part.size)
            mean, count = mean + (own - mean) * part.size / (count + part.size), count + part.size
            let_go(file.data)
        file.header.dmin, file.header.dmax, file.header.dmean = low, high, mean
        file.header.rms = math.sqrt(squares / count)
        if stack:
            size = file.voxel_size.item()
            file.set_image_stack()  # changes the number of sections that the header divides its lengths by
            file.voxel_size = size


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
                major, minor = np.lib.format.read_magic(stream)
                read_header = getattr(np.lib.format, f"read_array_header_{major}_{minor}")
                shape, _, dtype = read_header(stream)
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
        stream.write(npy_header(data.dtype, data.shape))
        for section in data:
            stream.write(np.ascontiguousarray(section).data)
    return data


def npy_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """The header of a ``.npy`` file, with the mark of `noiseflow.runs.ownership`."""
    described = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    start = npy_start()
    return start + repr(described).encode().ljust(NPY_HEADER_BYTES - len(start) - 1) + b"\n"
