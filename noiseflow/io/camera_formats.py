"""Formats of cameras and light microscopes, and PNG, each read by a function of its own, opened only if needed.

FITS, SPE and raw pixels are read here, MATLAB files by SciPy, PNG by Pillow, and the others by the extra ``[camera-formats]``.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import EXPORT, Unsupported, choose_member, grey, require_room
from noiseflow.io.image_file import PNG_SUFFIX, ImageFile

Array = NDArray[Any]

FITS_BLOCK, FITS_CARD = 2880, 80
FITS_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}

SPE_HEADER = 4100
SPE_TYPES = {0: "<f4", 1: "<i4", 2: "<i2", 3: "<u2", 8: "<u4"}

_GREY = {"1": np.uint8, "L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.uint16}
"""Data types of Pillow's grey modes; the mode of 16-bit images depends on its version."""
_COLOURS = ("LA", "RGB", "RGBA")


def fits(path: Path, member: str | None) -> Array:
    """Read the first, or a named or numbered, image of a FITS file (Pence et al., doi:10.1051/0004-6361/201015362)."""
    images: dict[str, Array] = {}
    with path.open("rb") as stream:
        while header := _fits_header(stream):
            axes = [int(header[f"NAXIS{axis}"]) for axis in range(int(header["NAXIS"]), 0, -1)]
            if "ZIMAGE" in header:
                raise Unsupported("holds a compressed image; unpack it with funpack")
            kind, number = np.dtype(FITS_TYPES[int(header["BITPIX"])]), int(np.prod(axes)) if axes else 0
            number = (number + int(header.get("PCOUNT", 0))) * int(header.get("GCOUNT", 1))
            content = stream.read(-(-number * kind.itemsize // FITS_BLOCK) * FITS_BLOCK)
            if number and header.get("XTENSION", "IMAGE").strip("' ") == "IMAGE":
                raw = np.frombuffer(content, kind, number).reshape(axes)
                images[header.get("EXTNAME", str(len(images))).strip("' ")] = _fits_scaled(raw, header)
    names = list(images)
    return images[names[choose_member(names, [image.shape for image in images.values()], member)]]


def _fits_header(stream: Any) -> dict[str, str]:
    """Keywords and values of the next header; empty at the end of the file."""
    header: dict[str, str] = {}
    while block := stream.read(FITS_BLOCK):
        for start in range(0, len(block), FITS_CARD):
            card = block[start : start + FITS_CARD].decode("ascii", "replace")
            if card.startswith("END "):
                return header
            if card[8:9] == "=":
                header[card[:8].strip()] = card[10:].split(" /")[0].strip()
    return {}


def _fits_scaled(raw: Array, header: dict[str, str]) -> Array:
    """Physical values: unsigned integers stay integers, as their zero is half their range."""
    zero, scale = float(header.get("BZERO", 0)), float(header.get("BSCALE", 1))
    if zero == 0 and scale == 1:
        return raw.astype(raw.dtype.newbyteorder("="))
    if scale == 1 and zero.is_integer() and raw.dtype.kind in "iu" and raw.dtype.itemsize < 8:
        whole = raw.astype(np.int64) + int(zero)
        return whole.astype(np.min_scalar_type(int(whole.max(initial=0))) if whole.min(initial=0) >= 0 else np.int64)
    return np.asarray(scale * raw.astype(np.float64) + zero)


def spe(path: Path, member: str | None) -> Array:
    """Read the frames of a Princeton Instruments file, version 2 or 3."""
    with path.open("rb") as stream:
        header = stream.read(SPE_HEADER)
        width, height = (int(np.frombuffer(header, "<u2", 1, place)[0]) for place in (42, 656))
        kind, number = np.frombuffer(header, "<i2", 1, 108)[0], int(np.frombuffer(header, "<i4", 1, 1446)[0])
        pixels = np.frombuffer(
            stream.read(number * height * width * np.dtype(SPE_TYPES[int(kind)]).itemsize), SPE_TYPES[int(kind)]
        )
    return pixels.reshape(number, height, width)


def raw(path: Path, member: str | None) -> Array:
    """Read pixels without a header. ``FILE::FRAMESxHEIGHTxWIDTH:TYPE`` names shape and NumPy type, by default little-endian."""
    found = re.fullmatch(r"(?:(\d+)x)?(\d+)x(\d+):([<>]?[a-z]+\d+)", member or "")
    if not found:
        raise Unsupported(f"has no header; name its shape and type, such as {path.name}::100x512x512:uint16")
    kind = np.dtype(found[4])
    frames, height, width = (int(one or 1) for one in found.groups()[:3])
    least = path.stat().st_size - frames * height * width * kind.itemsize
    if least < 0:
        raise Unsupported(f"is {-least} bytes shorter than {member}")
    # after any header
    return np.fromfile(path, kind, frames * height * width, offset=least).reshape(frames, height, width)


def matlab(path: Path, member: str | None) -> Array:
    """Read the named or largest array of a MATLAB file; frames are its last axis."""
    from scipy.io import loadmat

    try:
        found = {name: one for name, one in loadmat(path).items() if isinstance(one, np.ndarray) and one.ndim in (2, 3)}
    except NotImplementedError:  # version 7.3 is HDF5, with its axes in reverse order
        from noiseflow.io import hdf5

        return np.asarray(hdf5.read(path, member=member).data.swapaxes(-1, -2))
    names = list(found)
    data = found[names[choose_member(names, [one.shape for one in found.values()], member)]]
    return np.moveaxis(data, -1, 0) if data.ndim == 3 else data


def png(path: Path, member: str | None) -> Array:
    """Read a grey image of 1, 8 or 16 bits, or one of 8 bits in equal colours."""
    from PIL import Image

    with Image.open(path, formats=["PNG"]) as image:
        with path.open("rb") as stream:
            depth = stream.read(25)[24]  # Pillow halves colours of 16 bits
        if image.mode not in _GREY and (image.mode not in _COLOURS or depth != 8):
            raise Unsupported(
                f"is a PNG file with colour or transparency (mode {image.mode}); "
                "convert it to one grey channel of 8 or 16 bits first"
            )
        if getattr(image, "n_frames", 1) > 1:
            raise Unsupported("is an animated PNG file; save its images as a TIFF stack")
        require_room(image.width * image.height * len(image.getbands()), path, compressed=True)
        pixels = np.asarray(image)
        return grey(pixels) if image.mode in _COLOURS else pixels.astype(_GREY[image.mode])


def by_library(module: str, call: str, path: Path, member: str | None) -> Array:
    """Read with a function of another library, which returns the array or a tuple that starts with it."""
    found = getattr(importlib.import_module(module), call)(str(path))
    data = np.squeeze(np.asarray(found[0] if isinstance(found, tuple) else found))
    if data.ndim > 4 or (data.ndim == 4 and member is None):
        raise Unsupported(f"holds an array of shape {data.shape}; {EXPORT}, one channel and position a file")
    return data


READERS: dict[str, Callable[[Path, str | None], Array]] = {
    **dict.fromkeys((".fits", ".fit", ".fts"), fits),
    ".spe": spe,
    **dict.fromkeys((".raw", ".bin"), raw),
    ".mat": matlab,
    ".nd2": partial(by_library, "nd2", "imread"),
    ".czi": partial(by_library, "czifile", "imread"),
    **dict.fromkeys((".oib", ".oif"), partial(by_library, "oiffile", "imread")),
    ".lif": partial(by_library, "liffile", "imread"),
    ".sif": partial(by_library, "sif_parser", "np_open"),
    PNG_SUFFIX: png,
}
"""Readers by suffix. Each returns (y, x), (frame, y, x) or (channel, frame, y, x)."""


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read an image or stack of one of `READERS`."""
    suffix = path.suffix.lower()
    return ImageFile(READERS[suffix](path, member), named=suffix != PNG_SUFFIX)
