"""Formats of cameras and light microscopes, and PNG, each read by a function of its own, opened only if needed.

FITS, SPE and raw pixels are read here, MATLAB files by SciPy, PNG by Pillow, and the others by the extra ``[camera-formats]``.
"""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from noiseflow.io.checks import EXPORT, Unsupported, choose, choose_member, grey, require_room
from noiseflow.io.image_file import PNG_SUFFIX, ImageFile, by_axes, numbered

Array = NDArray[Any]

FITS_BLOCK, FITS_CARD = 2880, 80

SPE_HEADER = 4100
SPE_TYPES = {0: "<f4", 1: "<i4", 2: "<i2", 3: "<u2", 5: "<f8", 6: "u1", 8: "<u4"}

_GREY = {"1": np.uint8, "L": np.uint8, "I;16": np.uint16, "I;16B": np.uint16, "I": np.uint16}
"""Data types of Pillow's grey modes; the mode of 16-bit images depends on its version."""
_COLOURS = ("LA", "RGB", "RGBA")


def fits(path: Path, member: str | None) -> ImageFile:
    """Read the first, or a named or numbered, image of a FITS file (Pence et al., doi:10.1051/0004-6361/201015362)."""
    images: list[tuple[str, Array]] = []
    with path.open("rb") as stream:
        while header := _fits_header(stream):
            axes = [int(header[f"NAXIS{axis}"]) for axis in range(int(header["NAXIS"]), 0, -1)]
            if "ZIMAGE" in header:
                raise Unsupported("holds a compressed image; unpack it with funpack")
            bits, number = int(header["BITPIX"]), int(np.prod(axes)) if axes else 0
            kind = np.dtype("u1" if bits == 8 else f">{'f' if bits < 0 else 'i'}{abs(bits) // 8}")
            number = (number + int(header.get("PCOUNT", 0))) * int(header.get("GCOUNT", 1))
            content = stream.read(-(-number * kind.itemsize // FITS_BLOCK) * FITS_BLOCK)
            if number and header.get("XTENSION", "IMAGE").strip("' ") == "IMAGE":
                raw = np.frombuffer(content, kind, number).reshape(axes)
                images.append((header.get("EXTNAME", str(len(images))).strip("' "), _fits_scaled(raw, header)))
    return _chosen(images, member)


def _chosen(images: Sequence[tuple[str, Array]], member: str | None) -> ImageFile:
    """The named, or the largest, of some images with their names."""
    names = numbered(len(images), [name for name, _ in images])
    index, used = choose_member(names, [image.shape for _, image in images], member)
    return ImageFile(images[index][1], named=used)


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
    """Physical values: integers whose zero is half their range are of the other sign, and undefined pixels are NaN."""
    raw = raw.astype(raw.dtype.newbyteorder("="))
    zero, scale = (float(header.get(*one).replace("D", "E")) for one in (("BZERO", "0"), ("BSCALE", "1")))
    defined = raw != int(header["BLANK"]) if "BLANK" in header and raw.dtype.kind in "iu" else np.True_
    if np.all(defined) and scale == 1:
        bits, signed = 8 * raw.dtype.itemsize, raw.dtype.kind == "i"
        if zero == 0:
            return raw
        if raw.dtype.kind in "iu" and zero == (1 if signed else -1) * 2 ** (bits - 1):
            raw = raw.view(f"uint{bits}") ^ np.array(2 ** (bits - 1), f"uint{bits}")
            return np.asarray(raw.view(f"{'u' * signed}int{bits}"))
    return np.where(defined, scale * raw.astype(np.float64) + zero, np.nan)


def spe(path: Path, member: str | None) -> ImageFile:
    """Read the frames of a Princeton Instruments file, version 2 or 3; in version 3, metadata may follow each frame."""
    content = np.fromfile(path, np.uint8)
    width, height, kind, number, version, footer = (
        content[place : place + np.dtype(kind).itemsize].view(kind)[0].item()
        for place, kind in ((42, "<u2"), (656, "<u2"), (108, "<i2"), (1446, "<i4"), (1992, "<f4"), (678, "<u8"))
    )
    size = stride = height * width * np.dtype(SPE_TYPES[kind]).itemsize
    end = len(content)
    if version >= 3:
        end = footer or end
        layout = content[end:].tobytes().partition(b"<DataFormat")[2].partition(b"</DataFormat")[0]
        if layout.count(b'type="Region"') > 1:
            raise Unsupported(f"holds several regions of the sensor; {EXPORT}, one region a file")
        frame = re.search(rb'type="Frame"[^>]* stride="(\d+)"', layout)
        stride = int(frame[1]) if frame else size
    found = (end - SPE_HEADER) // stride
    if found < number:
        raise ValueError(f"its header claims {number} frames; the file has {found}")
    frames = content[SPE_HEADER : SPE_HEADER + (number or found) * stride].reshape(-1, stride)[:, :size]
    return ImageFile(np.ascontiguousarray(frames).view(SPE_TYPES[kind]).reshape(-1, height, width))


def raw(path: Path, member: str | None) -> ImageFile:
    """Read pixels without a header. ``FILE::FRAMESxHEIGHTxWIDTH:TYPE`` names shape and NumPy type, by default little-endian."""
    found = re.fullmatch(r"(?:(\d+)x)?(\d+)x(\d+):([<>]?[a-z]+\d+)", member or "")
    if not found:
        raise Unsupported(f"has no header; name its shape and type, such as {path.name}::100x512x512:uint16")
    kind = np.dtype(found[4])
    frames, height, width = (int(one or 1) for one in found.groups()[:3])
    one = height * width * kind.itemsize
    before = path.stat().st_size - frames * one
    if before < 0:
        raise Unsupported(f"is {-before} bytes shorter than {member}")
    if before >= one:
        warnings.warn(f"{path}: skipped {before} bytes, or {before / one:.4g} frames, before {member}", stacklevel=2)
    pixels = np.fromfile(path, kind, frames * height * width, offset=before)
    return ImageFile(pixels.reshape(frames, height, width), named=True)


def matlab(path: Path, member: str | None) -> ImageFile:
    """Read the named or largest array of a MATLAB file, (y, x), (y, x, frame) or (y, x, channel, frame)."""
    from scipy.io import loadmat

    try:
        found = [item for item in loadmat(path).items() if getattr(item[1], "dtype", np.dtype(object)).kind in "iufb"]
        image = _chosen(found, member)
    except NotImplementedError:  # version 7.3 is HDF5, with its axes in reverse order
        from noiseflow.io import hdf5

        image = hdf5.read(path, member=member)
        image = replace(image, data=image.data.T)
    return replace(image, data=np.moveaxis(image.data, (0, 1), (-2, -1)))


def png(path: Path, member: str | None) -> ImageFile:
    """Read a grey image of 1, 8 or 16 bits, or one of 8 bits in equal colours."""
    with Image.open(path, formats=["PNG"]) as image:
        with path.open("rb") as stream:
            depth = stream.read(25)[24]  # Pillow halves colours of 16 bits
        if image.mode not in _GREY and (image.mode not in _COLOURS or depth != 8):
            raise Unsupported(f"has colour or transparency (mode {image.mode}); save one colour as a grey image")
        if getattr(image, "n_frames", 1) > 1:
            raise Unsupported("is an animated PNG file; save its images as a TIFF stack")
        require_room(image.width * image.height * len(image.getbands()), path, compressed=True)
        pixels = np.asarray(image)
        return ImageFile(grey(pixels) if image.mode in _COLOURS else pixels.astype(_GREY[image.mode]))


_Image = tuple[str, Sequence[str], Callable[[], Array], Sequence[str]]
"""Name of an image, letters of its axes, its pixels, and the names of its channels."""


def by_library(
    module: str, reader: str, images_of: Callable[[Any], Sequence[_Image]], path: Path, member: str | None
) -> ImageFile:
    """Read an image with another library, which is imported only here."""
    with getattr(import_module(module), reader)(str(path)) as file:
        images = images_of(file)
        several = len(images) > 1
        names = numbered(len(images), [name for name, _, _, _ in images])
        _, axes, pixels, channels = images[choose(names, member if several else None)]
        return by_axes(pixels(), axes, channels, member=None if several else member, named=several)


def _nd2(file: Any) -> list[_Image]:
    channels = getattr(file.metadata, "channels", None) or ()  # legacy files have other metadata
    return [("", list(file.sizes), file.asarray, [one.channel.name for one in channels])]


def _czi(file: Any) -> list[_Image]:
    axes = file.axes.translate(str.maketrans("SVHIRB0", "PPPPPPS"))  # scenes and other positions; colours
    if any(size > 1 for axis, size in zip(file.axes, file.shape, strict=True) if axis == "S"):
        raise Unsupported(f"holds several scenes; {EXPORT}, one scene a file")
    return [("", axes, file.asarray, ())]


def _oif(file: Any) -> list[_Image]:
    return [(str(k), f"{one.axes}YX", partial(file.asarray, series=k), ()) for k, one in enumerate(file.series)]


def _lif(file: Any) -> list[_Image]:
    return [(one.path, [axis[0] for axis in one.dims], one.asarray, ()) for one in file.images]


def _sif(path: Path, member: str | None) -> ImageFile:
    pixels, _ = import_module("sif_parser").np_open(str(path))
    return by_axes(np.asarray(pixels), "TYX", (), member=member, named=False)


READERS: dict[str, Callable[[Path, str | None], ImageFile]] = {
    **dict.fromkeys((".fits", ".fit", ".fts", ".fz"), fits),
    ".spe": spe,
    **dict.fromkeys((".raw", ".bin"), raw),
    ".mat": matlab,
    ".nd2": partial(by_library, "nd2", "ND2File", _nd2),
    ".czi": partial(by_library, "czifile", "CziFile", _czi),
    **dict.fromkeys((".oib", ".oif"), partial(by_library, "oiffile", "OifFile", _oif)),
    ".lif": partial(by_library, "liffile", "LifFile", _lif),
    ".sif": _sif,
    PNG_SUFFIX: png,
}
"""Readers by suffix. Each returns pixels (y, x), (frame, y, x) or (channel, frame, y, x)."""


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read an image or stack of one of `READERS`."""
    return READERS[path.suffix.lower()](path, member)
