"""TIFF files: plain, ImageJ and OME, with voxel sizes."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from tifffile import TiffFile

from noiseflow.io.checks import Unsupported, choose, choose_member, exactly_as, grey, is_colour, require_room
from noiseflow.io.folder import angles_in_names
from noiseflow.io.image_file import ImageFile, VoxelSize, by_axes, numbered
from noiseflow.io.mapped import mapped_copy
from noiseflow.io.metadata import in_angstrom
from noiseflow.runs.ownership import signature

_IMAGEJ_TYPES = (np.uint8, np.uint16, np.float32)
_OUTSIDE_OME = (np.float16, np.int64, np.uint64)
_IMAGEJ_BYTES = 2**32 - 2**20
_FINEST_PRINT = 2e5
"""Å: programs set 72 to 1200 dots per inch, 21 µm and more, without knowing the scale; pixels of microscopes are smaller."""


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read the largest series, such as a position, of a TIFF file.

    Args:
        member: name of a series, or its index if several have the largest size.
        mapped: memory-map the pixels, or a temporary copy if the file is compressed.
    """
    with TiffFile(path) as tiff:
        pages = _pages(tiff)
        compressed = any(getattr(page, "compression", 1) != 1 or page.dtype == bool for page in pages)
        require_room(sum(page.nbytes for page in pages), path, compressed=compressed)
        series, named = _series(tiff, member)
        require_room(series.nbytes, path, compressed=compressed)
        axes = "IYX" if series.axes == "SYX" or (series.axes == "YXS" and not is_colour(series.shape)) else series.axes
        if "S" in series.axes and axes == "IYX":
            planes = f"{path} holds {series.shape[0]} planes tagged as colours"
            warnings.warn(f"{planes}, as some programs tag small stacks; they are read as frames", stacklevel=2)
        elif "S" in axes and not axes.endswith("YXS"):
            raise Unsupported(f"is a colour image (shape {series.shape}); save one colour as a grey image")
        data = _left_on_disk(path, series) if mapped and series.ndim > 2 else series.asarray()
        data, axes = (grey(data), axes[:-1]) if axes.endswith("YXS") else (data, axes)
        if getattr(series.pages[0], "photometric", None) == 0:
            data = _inverted(data, series.pages[0], path)
        voxel_size = _imagej_voxel_size(tiff) if tiff.is_imagej else _ome_voxel_size(tiff)
        tags: Any = tiff.pages.first.tags
        if voxel_size is None and "ResolutionUnit" in tags:
            edges = _edges(tags, in_angstrom(getattr(tags["ResolutionUnit"].value, "name", None)))
            voxel_size = None if edges is None or max(edges) >= _FINEST_PRINT else (edges[1], *edges)
        waves = [f"{wave:g}" for wave in (tiff.stk_metadata or {}).get("Wavelengths", ())] if tiff.is_stk else []
        if len(names := list(dict.fromkeys(waves))) > 1:
            data, named = data[np.equal(waves, names[choose(names, member, "wavelengths")])], True
        image = by_axes(data, axes, _channel_names(tiff), member=None if named else member, named=named)
        # Fiji labels the images of a stack by the names of their files
        labels = [str(label).partition("\n")[0] + ".tif" for label in (tiff.imagej_metadata or {}).get("Labels", ())]
    angles = angles_in_names(labels) if image.data.ndim == 3 and len(labels) == len(image.data) else None
    return replace(image, voxel_size=voxel_size, tilt_angles=angles)


def write(path: Path, data: NDArray[Any], voxel_size: VoxelSize | None) -> NDArray[Any]:
    """Write any real data type unchanged: as ImageJ TIFF if that can store the voxel size, otherwise as OME-TIFF.

    Returns:
        The pixels as stored.
    """
    if voxel_size is None:
        # otherwise a stack of three would be stored as colour
        tifffile.imwrite(path, data, photometric="minisblack", software=signature())
        return data
    z, y, x = voxel_size
    if data.dtype in _OUTSIDE_OME:
        data = exactly_as(data, (np.float32, np.int32, np.uint32, np.float64), "OME-TIFF")
    if data.dtype in _IMAGEJ_TYPES and data.nbytes < _IMAGEJ_BYTES:
        described: dict[str, Any] = {"resolution": (1 / x, 1 / y), "metadata": {"spacing": z, "unit": "angstrom"}}
        tifffile.imwrite(path, data, imagej=True, software=signature(), **described)
        return data
    sizes = {f"PhysicalSize{axis}": size for axis, size in zip("ZYX", voxel_size, strict=True)}
    metadata = {"axes": "ZYX"[-data.ndim :], **sizes, **{f"PhysicalSize{axis}Unit": "Å" for axis in "ZYX"}}
    tifffile.imwrite(path, data, ome=True, photometric="minisblack", metadata=metadata, software=signature())
    return data


def _series(tiff: TiffFile, member: str | None) -> tuple[Any, bool]:
    series = [one for one in tiff.series if not one.keyframe.is_reduced] or tiff.series  # without previews
    first = series[0]
    like = ("shaped", "", first.shape, first.dtype)
    if (
        len(series) > 1
        and first.ndim == 2
        and all((one.kind, one.name, one.shape, one.dtype) == like for one in series)
    ):
        # frames that tifffile appended one by one
        pages = [one.keyframe for one in series]
        series = [tifffile.TiffPageSeries(pages, (len(pages), *first.shape), first.dtype, "IYX", parent=tiff)]
    if len(series) == 1:
        return series[0], False
    names = numbered(len(series), [one.name for one in series])
    chosen, used = choose_member(names, [one.shape[-4:] for one in series], member)
    return series[chosen], used


def _left_on_disk(path: Path, series: Any) -> NDArray[Any]:
    """Memory-map the pixels of a stack if they are contiguous and in native byte order."""
    begin, native = series.dataoffset, series.dtype.newbyteorder("=")
    kind = series.dtype.newbyteorder(series.parent.byteorder)
    if begin is not None and kind == native:
        return np.memmap(path, native, "c", begin, series.shape)
    if len(series.pages) != series.shape[0]:
        return np.asarray(series.asarray())
    return mapped_copy((page.asarray() for page in series.pages), series.shape, native)


def _inverted(data: NDArray[Any], page: Any, path: Path) -> NDArray[Any]:
    """Pixels whose files count from white (MINISWHITE) as counts from black. Raises Unsupported if white has no value, because
    the pixels are not unsigned integers.
    """
    if data.dtype == bool:
        # tifffile says so of all images of one bit, and stores them as they are
        return data if page.software.startswith("tifffile") else ~data
    if data.dtype.kind != "u":
        raise Unsupported(f"counts {data.dtype} pixels from white (MINISWHITE), which needs unsigned integers")
    warnings.warn(f"{path} counts from white (MINISWHITE); its pixels are inverted", stacklevel=5)
    white = data.dtype.type(2 ** int(page.bitspersample) - 1)
    return mapped_copy((white - part for part in data), data.shape, data.dtype)


def _edges(tags: Any, unit: float | None) -> tuple[float, float] | None:
    """Height and width of a pixel by the tags of resolution, Å; None if a tag is missing or is zero, or the unit is unknown."""
    rates = [tags[name].value for name in ("YResolution", "XResolution") if name in tags]
    if unit is None or len(rates) < 2 or not all(numerator and denominator for numerator, denominator in rates):
        return None
    y, x = (unit * denominator / numerator for numerator, denominator in rates)
    return y, x


def _channel_names(tiff: TiffFile) -> list[str]:
    """Names of the channels in the metadata of OME or LSM, or the labels of the first images of an ImageJ hyperstack."""
    if tiff.is_imagej:
        metadata = tiff.imagej_metadata or {}
        return [str(label) for label in metadata.get("Labels", ())[: int(metadata.get("channels", 0))]]
    if tiff.is_lsm:
        return [f"channel {index}" for index in range((tiff.lsm_metadata or {})["DimensionChannels"])]
    channels = _ome_pixels(tiff).get("Channel", [])
    return [str(channel.get("Name", "")) for channel in (channels if isinstance(channels, list) else [channels])]


def _pages(tiff: TiffFile) -> list[Any]:
    pages: dict[int, Any] = {}
    for page in tiff.pages:
        if page.offset in pages:
            raise ValueError("its list of pages is circular")
        pages[page.offset] = page
    return list(pages.values())


def _imagej_voxel_size(tiff: TiffFile) -> VoxelSize | None:
    metadata = tiff.imagej_metadata or {}
    unit, edges = in_angstrom(metadata.get("unit")), None
    if unit is None or (edges := _edges(tiff.pages.first.tags, unit)) is None:
        return None
    spacing = float(metadata.get("spacing") or 0)
    return (unit * spacing if spacing > 0 else edges[1], *edges)


def _ome_pixels(tiff: TiffFile) -> dict[str, Any]:
    image = tifffile.xml2dict(tiff.ome_metadata).get("OME", {}).get("Image", {}) if tiff.ome_metadata else {}
    pixels: dict[str, Any] = (image[0] if isinstance(image, list) else image).get("Pixels", {})
    return pixels


def _ome_voxel_size(tiff: TiffFile) -> VoxelSize | None:
    pixels = _ome_pixels(tiff)
    units = (in_angstrom(pixels.get(f"PhysicalSize{axis}Unit", "µm")) or 0 for axis in "ZYX")
    z, y, x = (float(pixels.get(f"PhysicalSize{axis}", 0)) * unit for axis, unit in zip("ZYX", units, strict=True))
    return (z if z > 0 else x, y, x) if y > 0 and x > 0 else None
