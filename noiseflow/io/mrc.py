"""MRC files of all variants: byte order, signed bytes, and tilt angles in the extended header (MRC2014, IMOD, SerialEM, FEI)."""

import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mrcfile.constants import VOLUME_STACK_SPACEGROUP
from mrcfile.dtypes import HEADER_DTYPE, get_ext_header_dtype
from numpy.typing import NDArray

from noiseflow.io.checks import Unsupported, exactly_as
from noiseflow.io.image_file import ImageFile, VoxelSize, numbered
from noiseflow.io.mapped import MRC_HEADER_BYTES, create_mrc, finish_mrc, mapped_copy
from noiseflow.io.metadata import axis_in_titles

_TYPES = {0: "i1", 1: "i2", 2: "f4", 6: "u2", 12: "f2"}
_REFUSED = {
    3: "complex numbers (a Fourier transform)",
    4: "complex numbers (a Fourier transform)",
    16: "colour pixels",
    101: "4-bit pixels; unpack them with IMOD: newstack -mode 1 IN OUT",
}
_IMOD_STAMP = int.from_bytes(b"IMOD", "little")
_SERIALEM_BYTES = {1: 2, 2: 6, 4: 4, 8: 2, 16: 2, 32: 4}
"""Bytes per section of each field of SerialEM's extended header, by its flag."""

_OLD_FEI_REALS, _OLD_FEI_AXIS = 32, 10
_AGARD = (b"AGAR", b"", b"\0\0\0\0")


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read an MRC file, a stack of volumes as (volume, z, y, x). The header is checked against the file size. If `mapped`, pixels
    in native byte order are memory-mapped, and changes to the array are not written to the file."""
    size = path.stat().st_size
    if size < MRC_HEADER_BYTES:
        raise ValueError(f"an MRC header has {MRC_HEADER_BYTES} bytes, but the file has {size}")
    with path.open("rb") as stream:
        header = _header(stream.read(MRC_HEADER_BYTES), path, size)
        extended = stream.read(int(header["nsymbt"]))
        shape = tuple(int(header[name]) for name in ("nz", "ny", "nx"))
        # bytes and short integers may be unsigned, see `_as_meant`
        dtype: np.dtype[Any] = np.dtype(_TYPES[int(header["mode"])]).newbyteorder(_order(header))
        further = (size - stream.tell()) // (dtype.itemsize * shape[1] * shape[2]) - shape[0]
        if further > 0:
            warnings.warn(
                f"{path}: the header says {shape[0]} sections, and the file has room for {further} more, which are not read; if "
                "they are images, correct the header (alterheader of IMOD)",
                stacklevel=4,
            )
        if mapped:
            data: NDArray[Any] = np.memmap(path, dtype, "c", stream.tell(), shape)
        else:
            data = np.fromfile(stream, dtype, int(np.prod(shape))).reshape(shape)
    data = _as_meant(data.astype(data.dtype.newbyteorder("="), copy=False), header, path, mapped=mapped)
    each = int(header["mz"])  # sections of a volume
    if int(header["ispg"]) >= VOLUME_STACK_SPACEGROUP and 0 < each < len(data) and not len(data) % each:
        names = numbered(len(data) // each)
        return ImageFile(data.reshape(-1, each, *data.shape[1:]), _voxel_size(header), channels=names)
    angles = _tilt_angles(header, extended, len(data))
    if int(header["ispg"]) == 0 and len(data) == 1:
        data = data[0]
    axes = [int(header[name]) for name in ("maps", "mapr", "mapc")]
    if data.ndim == 3 and sorted(axes) == [1, 2, 3] and axes != [3, 2, 1]:
        data = np.ascontiguousarray(data.transpose([axes.index(axis) for axis in (3, 2, 1)]))
    return ImageFile(data, _voxel_size(header), angles, _tilt_axis(header, extended))


def write(path: Path, data: NDArray[Any], voxel_size: VoxelSize | None, *, stack: bool = False) -> NDArray[Any]:
    """Write 8- and 16-bit integers and float32 unchanged; float64 is rounded to float32, wider integers must fit exactly.

    Returns:
        The pixels as stored.
    """
    stored = data.astype(np.float32) if data.dtype == np.float64 else data
    if data.dtype.kind in "iu" and data.dtype.itemsize > 2:
        stored = exactly_as(data, (np.int16, np.uint16, np.float32), "MRC")
    with create_mrc(path, stored.shape, stored.dtype, voxel_size) as file:
        for target, section in zip(file.data, stored, strict=True):
            target[...] = section
    finish_mrc(path, stack=stack and stored.ndim == 3)
    return stored


def _header(raw: bytes, path: Path, size: int) -> np.void:
    """The header in the byte order that gives plausible values; warns if the machine stamp differs."""
    stamped = ">" if raw[212:213] == b"\x11" else "<"
    orders = (stamped, "<" if stamped == ">" else ">")
    headers: list[np.void] = [np.frombuffer(raw, HEADER_DTYPE.newbyteorder(order))[0] for order in orders]
    problems = [_problem(header, size) for header in headers]
    if problems[0] is None:
        return headers[0]
    if problems[1] is None:
        names = {"<": "little", ">": "big"}
        warnings.warn(
            f"{path} is stamped as {names[stamped]}-endian but is {names[orders[1]]}-endian; it is read as such",
            stacklevel=5,
        )
        return headers[1]
    mode = int(headers[0]["mode"])
    if mode in _REFUSED and _problem(headers[0], size, mode_matters=False) is None:
        raise Unsupported(f"holds {_REFUSED[mode]} (MRC mode {mode}); real grey-level images are required")
    if mode not in _TYPES:
        raise ValueError(f"it is not an MRC file: its header says mode {mode}")
    raise ValueError(problems[0])


def _problem(header: np.void, size: int, *, mode_matters: bool = True) -> str | None:
    nx, ny, nz, mode, skipped = (int(header[name]) for name in ("nx", "ny", "nz", "mode", "nsymbt"))
    if mode_matters and mode not in _TYPES:
        return f"its header says mode {mode}"
    expected = nx * ny * nz * np.dtype(_TYPES.get(mode, "i1")).itemsize + MRC_HEADER_BYTES + skipped
    if min(nx, ny, nz) < 1 or skipped < 0 or expected > size:
        return f"its header claims {nx} x {ny} x {nz} pixels, {expected} bytes, but the file has {size}"
    return None


def _order(header: np.void) -> Literal["<", ">"]:
    return ">" if header.dtype["nx"] == np.dtype(">i4") else "<"


def _as_meant(data: NDArray[Any], header: np.void, path: Path, *, mapped: bool) -> NDArray[Any]:
    """Bytes and short integers in the type that their writer meant. IMOD stamps its files and flags bytes that it stored less
    128. Without its stamp, MRC2014 says that they are signed, but unsigned ones are common: statistics or the smoother image
    decide."""
    unsigned = data.view(f"u{data.dtype.itemsize}") if data.dtype.kind == "i" else data
    stamp, flags = np.frombuffer(header["extra2"].tobytes()[40:48], f"{_order(header)}i4")
    if int(header["mode"]) == 0 and stamp == _IMOD_STAMP:
        if not flags & 1:
            return unsigned
        shifted = (section ^ np.uint8(128) for section in unsigned)
        return mapped_copy(shifted, data.shape, np.uint8, in_memory=None if mapped else data.nbytes)
    if data.dtype.kind != "i" or not _is_unsigned(data, unsigned, header):
        return data
    if data.dtype.itemsize > 1:
        warnings.warn(f"{path} holds unsigned integers, read as such; its header says signed", stacklevel=5)
    return unsigned


def _is_unsigned(data: NDArray[Any], unsigned: NDArray[Any], header: np.void, *, much: float = 0.2) -> bool:
    """Whether the smoother image is unsigned; `much` smoother if that contradicts the statistics: wraps make steps of the whole
    range."""
    low, high = float(header["dmin"]), float(header["dmax"])
    if high > np.iinfo(data.dtype).max:
        return True
    some = np.unique([0, len(data) // 2, len(data) - 1])
    signed_steps, unsigned_steps = (
        float(np.abs(np.diff(stack[some].astype(np.float64), axis=-1)).sum()) for stack in (data, unsigned)
    )
    return unsigned_steps < signed_steps * (much if low < 0 and low < high else 1.0)


def _voxel_size(header: np.void) -> VoxelSize | None:
    edges = [float(header["cella"][axis]) / max(int(header[f"m{axis}"]), 1) for axis in "zyx"]
    if not all(0 < edge < np.inf for edge in edges):
        return None
    return edges[0], edges[1], edges[2]


def _extension(header: np.void) -> tuple[bytes, str, int, int]:
    """Kind and byte order of the extended header, and its two counts for each section: integers, and reals or flags."""
    order = _order(header)
    counts = np.frombuffer(header["extra2"].tobytes()[16:20], f"{order}i2")
    return header["exttyp"].item(), order, int(counts[0]), int(counts[1])


def _tilt_angles(header: np.void, extended: bytes, count: int) -> NDArray[np.float64] | None:
    """Degrees, from the extended header of SerialEM (``SERI``), FEI (``FEI1 FEI2``) or Agard's format; otherwise None."""
    kind, order, num_integers, flags = _extension(header)
    serialem = flags & 1 and num_integers == sum(n for bit, n in _SERIALEM_BYTES.items() if flags & bit)
    if kind in (b"FEI1", b"FEI2"):
        record = get_ext_header_dtype(kind, order)
        offset, item, step, unit = record.fields["Alpha tilt"][1], f"{order}f8", 0, 1.0
        step = int(np.frombuffer(extended[:4].ljust(4, b"\0"), f"{order}i4")[0])
    elif serialem:
        offset, item, step, unit = 0, f"{order}i2", num_integers, 0.01
    elif num_integers >= 0 < flags and kind in _AGARD:
        offset, item, step, unit = 4 * num_integers, f"{order}f4", 4 * (num_integers + flags), 1.0
    else:
        return None
    width = np.dtype(item).itemsize
    if step < offset + width or (count - 1) * step + offset + width > len(extended):
        return None
    records = [extended[i * step + offset : i * step + offset + width] for i in range(count)]
    angles: NDArray[np.float64] = np.frombuffer(b"".join(records), item).astype(np.float64) * unit
    told = np.isfinite(angles).all() and np.abs(angles).max() <= 180 and (count == 1 or np.ptp(angles) > 0)
    return angles if told else None


def _tilt_axis(header: np.void, extended: bytes) -> float | None:
    """Degrees, from a title as SerialEM writes it, or from the first record of FEI's extended header, where 0 means unset."""
    titles = (bytes(label).decode("latin-1", "replace") for label in header["label"])
    if (stated := axis_in_titles(titles)) is not None:
        return stated
    kind, order, _, num_reals = _extension(header)
    if kind in (b"FEI1", b"FEI2"):
        item, offset = f"{order}f8", get_ext_header_dtype(kind, order).fields["Tilt axis angle"][1]
    elif kind in _AGARD and num_reals == _OLD_FEI_REALS:
        item, offset = f"{order}f4", 4 * _OLD_FEI_AXIS
    else:
        return None
    found = np.frombuffer(extended[offset : offset + np.dtype(item).itemsize], item)
    return float(found[0]) if found.size and 0 < abs(found[0]) <= 360 else None
