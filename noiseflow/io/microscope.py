"""Microscope formats, through rosettasciio: DM3, DM4, EMD, SER, hspy (extra ``[formats]``)."""

import importlib
import json
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import hdf5
from noiseflow.io.checks import Unsupported, choose_member, require_room
from noiseflow.io.image_file import ImageFile, VoxelSize
from noiseflow.io.metadata import in_angstrom, in_degrees, leaves_of, recorded_angles, recorded_axis

_PLUGINS = {
    **dict.fromkeys((".dm3", ".dm4"), "digitalmicrograph"),
    **dict.fromkeys((".ser", ".emi"), "tia"),
    ".emd": "emd",
    ".hspy": "hspy",
}
_UNCOMPRESSED = frozenset({"digitalmicrograph", "tia"})

Axes = Sequence[dict[str, Any]]


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read the largest image, stack or volume of a microscope file, with its pixel size and tilt angles.

    Args:
        member: title of the image to read, if the file holds several.
        mapped: ignored; the pixels are read into memory.
    """
    plugin = _PLUGINS[path.suffix.lower()]
    pixel_files = sorted(path.parent.glob(f"{path.stem}_*.ser")) if path.suffix.lower() == ".emi" else []
    if path.suffix.lower() == ".emi" and not pixel_files:
        raise Unsupported(f"holds no pixels: they are in {path.stem}_1.ser; put this file next to it, or give it")
    reader = importlib.import_module(f"rsciio.{plugin}").file_reader
    try:
        signals = reader(str(path), lazy=True)
    except (KeyError, ValueError, OSError):
        if plugin != "emd" or (image := _bare_velox(path, member)) is None:
            raise
        return image
    titles = [str(signal.get("metadata", {}).get("General", {}).get("title", "")) for signal in signals]
    index, used = choose_member(titles, [signal["data"].shape for signal in signals], member)
    signal = signals[index]
    lazy = signal["data"]
    stored = sum(part.stat().st_size for part in (path, *pixel_files))
    require_room(lazy.nbytes, path, compressed=plugin not in _UNCOMPRESSED, size=stored)
    data = np.asarray(lazy.compute(scheduler="single-threaded") if hasattr(lazy, "compute") else lazy)
    data = data.astype(data.dtype.newbyteorder("="), copy=False)
    placed = sorted(enumerate(signal["axes"]), key=lambda pair: pair[1].get("index_in_array", pair[0]))
    axes = [axis for _, axis in placed]
    if len(axes) == 3 and in_degrees(axes[2].get("units")) is not None:  # (x, y, tilt)
        data, axes = data.transpose(), axes[::-1]
    if [str(axis.get("name")).lower() for axis in axes[-2:]] == ["x", "y"]:
        data, axes = data.swapaxes(-1, -2), [*axes[:-2], axes[-1], axes[-2]]
    trees = {name: signal.get(name) for name in ("original_metadata", "metadata")}
    angles = _emd_angles(path, titles[index], len(data)) if plugin == "emd" and data.ndim == 3 else None
    angles = _tilt_angles(trees, axes, data.shape) if angles is None else angles
    return ImageFile(np.ascontiguousarray(data), _voxel_size(axes), angles, recorded_axis(leaves_of(trees)), named=used)


def _voxel_size(axes: Axes) -> VoxelSize | None:
    """Å along (z, y, x); the depth of a section of a tilt series is set to the pixel width."""
    *depth, y, x = [(in_angstrom(axis.get("units")) or 0.0) * abs(float(axis.get("scale", 0))) for axis in axes]
    if not (y > 0 and x > 0):
        return None
    return (depth[0] if depth and depth[0] > 0 else x, y, x)


def _tilt_angles(trees: dict[str, Any], axes: Axes, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Degrees: the recorded stage angle of every section, or the calibration of the first axis of the stack."""
    count = shape[0] if len(shape) == 3 else 1
    recorded = recorded_angles(leaves_of(trees), count)
    unit = in_degrees(axes[0].get("units"))
    if recorded is not None or unit is None or len(shape) != 3:
        return recorded
    if "axis" in axes[0]:  # uneven
        return unit * np.asarray(axes[0]["axis"], dtype=np.float64)
    return unit * (float(axes[0]["offset"]) + float(axes[0]["scale"]) * np.arange(count, dtype=np.float64))


def _emd_angles(path: Path, title: str, count: int) -> NDArray[np.float64] | None:
    """Degrees, of an axis of angles (rosettasciio takes it as even), or the stage's alpha tilt for every frame of a Velox file,
    from the metadata of each (it reads the first); None if their number differs from `count` or the stage did not move."""
    import h5py

    with h5py.File(path, "r") as file:
        found = hdf5.datasets_of(file)
        images = (name for name in found if name.endswith(f"/{title}/data"))
        angles = hdf5.angles_near(next(images, "/"), found, count)
        for name, text in found.items():
            if angles is None and re.match("/Data/Image/[^/]+/Metadata$", name) and text.shape[1:] == (count,):
                require_room(text.nbytes, path, compressed=True)
                angles = _alpha(_frames(np.asarray(text, dtype=np.uint8)), count)
    return angles


def _bare_velox(path: Path, member: str | None) -> ImageFile | None:
    """A Velox image, (y, x, section) in the file, that was copied without some of its metadata or its chunks, which rosettasciio
    needs; None if the file holds none."""
    import h5py

    with h5py.File(path, "r") as file:
        found = {
            name: item for name, item in hdf5.datasets_of(file).items() if re.match("/Data/Image/[^/]+/Data$", name)
        }
        if not found:
            return None
        index, used = choose_member(list(found), [item.shape for item in found.values()], member)
        name, dataset = list(found.items())[index]
        require_room(dataset.nbytes, path, compressed=bool(dataset.compression))
        data = np.moveaxis(np.asarray(dataset, dataset.dtype.newbyteorder("=")), -1, 0)
        texts = file.get(f"{name[: -len('Data')]}Metadata")
        frames = [] if texts is None else _frames(np.asarray(texts, dtype=np.uint8))
    words = f"{path}: the metadata of {name} are incomplete, or it was written by another program than Velox"
    warnings.warn(f"{words}; check the tilt angles and the pixel size", stacklevel=5)
    result = frames[0].get("BinaryResult", {}) if frames else {}
    sides = [(axis, result.get("PixelSize", {}).get(side, 0)) for axis, side in (("Y", "height"), ("X", "width"))]
    axes = [{"units": result.get(f"PixelUnit{axis}"), "scale": scale} for axis, scale in sides]
    return ImageFile(np.ascontiguousarray(data), _voxel_size(axes), _alpha(frames, len(data)), named=used)


def _frames(texts: NDArray[np.uint8]) -> list[dict[str, Any]]:
    """The metadata of every frame, (character, frame); none if they are no text of Velox."""
    try:
        return [json.loads(column.tobytes().partition(b"\0")[0]) for column in texts.T]
    except ValueError:
        return []


def _alpha(frames: list[dict[str, Any]], count: int) -> NDArray[np.float64] | None:
    try:
        radians = np.array([float(frame["Stage"]["AlphaTilt"]) for frame in frames])
    except (ValueError, KeyError, TypeError):
        return None
    if len(radians) != count:
        return None
    told = np.isfinite(radians).all() and np.abs(radians).max() <= np.pi and np.ptp(radians) > 0
    return np.rad2deg(radians) if told else None
