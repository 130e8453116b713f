"""HDF5 and NeXus files, and Zarr without multiscales: the largest numeric array, or a named one (extra ``[formats]``).

Sources: NXtomo, https://manual.nexusformat.org/classes/applications/NXtomo.html; Data Exchange,
https://dxfile.readthedocs.io
"""

import re
import warnings
from os.path import commonpath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import choose_member, require_room
from noiseflow.io.image_file import ImageFile, VoxelSize, numbered
from noiseflow.io.mapped import mapped_copy
from noiseflow.io.metadata import in_angstrom, in_degrees, leaves_of, recorded_angles

_FLATS = re.compile(r"/(data_white|data_flat|flats?|flat_?fields?|white)$", re.IGNORECASE)
_DARKS = re.compile(r"/(data_dark|darks?|dark_?fields?)$", re.IGNORECASE)
_SIZES = tuple(rf"/(sample_)?{axis}_(magnified_)?pixel_size$|/pixel_size(_{axis})?$" for axis in "yx")

Datasets = dict[str, Any]


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read an image, stack or volume. Tilt angles, of any axis, are read from ``theta`` and similar datasets or attributes.

    Frames that ``image_key`` marks as flat, dark or invalid are no images of the specimen; flat and dark frames, also of
    ``data_white`` and ``data_dark``, become the fields of the image file.

    Args:
        member: the dataset's full name, such as ``/exchange/data``.
        mapped: read a large array section by section into a temporary file.
    """
    import h5py

    with h5py.File(path, "r") as file:
        return largest_of(datasets_of(file), path, member, mapped=mapped)


def largest_of(
    found: Datasets, path: Path, member: str | None, *, mapped: bool, stored: int | None = None
) -> ImageFile:
    """The largest array of a file, or the named one; arguments as of `read`, and the bytes that its arrays are `stored` in."""
    names = [name for name, item in found.items() if item.ndim in (2, 3, 4) and item.dtype.kind in "iufcb"]
    names = [name for name in names if name == member or not (_FLATS.search(name) or _DARKS.search(name))] or names
    index, used = choose_member(names, [found[name].shape for name in names], member)
    name = names[index]
    dataset = found[name]
    require_room(dataset.nbytes, path, compressed=bool(stored or dataset.compression), size=stored)
    # the tilts of maps (element, tilt, y, x) are the second axis, unless only the first has angles
    axes = (1, 0) if dataset.ndim == 4 else tuple(range(1 + 2 * (dataset.ndim > 2)))
    listed = [angles_near(name, found, dataset.shape[axis]) for axis in axes]
    axis, angles = next((pair for pair in zip(axes, listed, strict=True) if pair[1] is not None), (axes[0], None))
    if axis > axes[0]:
        warnings.warn(f"{path}: the tilts of {name} are along its axis {axis}, which becomes the first", stacklevel=2)
    kinds = _kinds(name, dataset, found)
    data = _pixels(dataset, kinds == 0, axis, mapped=mapped)
    flat = _field(name, dataset, found, kinds == 1, _FLATS)
    dark = _field(name, dataset, found, kinds == 2, _DARKS)
    voxel_size = _voxel_size(name, dataset, found)
    if angles is not None and len(kinds) == len(angles):
        angles = angles[kinds == 0]
    channels = numbered(len(data)) if data.ndim == 4 and angles is not None else ()
    return ImageFile(data, voxel_size, angles, channels=channels, named=used, flat=flat, dark=dark)


def datasets_of(file: Any) -> Datasets:
    """The datasets of an open file by their full names."""
    found: Datasets = {}
    file.visititems(lambda name, item: found.__setitem__(f"/{name}", item) if hasattr(item, "dtype") else None)
    return found


def angles_near(place: str, found: Datasets, count: int) -> NDArray[np.float64] | None:
    """Degrees, of the list whose name begins most like that of the images, or of their attributes; EMD names axes beside them."""
    lists = [name for name, item in found.items() if item.size == max(item.shape, default=0) == count]
    for name in sorted(lists, key=lambda name: -len(commonpath([name, place]))):
        item, called = found[name], _text(found[name].attrs.get("name", ""))
        if item.dtype.kind in "iuf":
            values = np.ravel(item) * (in_degrees(_unit_of(item, "deg")) or 1.0)
            if (angles := recorded_angles([(f"{name}/{called}".rstrip("/"), values.tolist())], count)) is not None:
                return angles
    return recorded_angles(leaves_of(dict(found[place].attrs)), count) if place in found else None


def _kinds(name: str, dataset: Any, found: Datasets) -> NDArray[np.int64]:
    """``image_key`` of every frame: 0 of the specimen (all without it), 1 flat, 2 dark, others invalid."""
    keys = [
        np.asarray(item, dtype=np.int64)
        for other, item in found.items()
        if other.split("/")[1] == name.split("/")[1]
        and other.rpartition("/")[2] in ("image_key", "image_key_control")
        and item.shape == dataset.shape[:1]
    ]
    kinds = np.zeros(dataset.shape[0] if dataset.ndim == 3 else 0, dtype=np.int64)
    for key in keys:
        kinds = np.where(kinds == 0, key, kinds)
    return kinds


def _pixels(dataset: Any, sample: NDArray[np.bool_], axis: int, *, mapped: bool) -> NDArray[Any]:
    native = dataset.dtype.newbyteorder("=")
    first = 1 - axis if dataset.ndim == 4 else axis
    if dataset.ndim != 3 or first or (sample.all() and not mapped):
        return np.moveaxis(np.asarray(dataset, native), first, 0)
    chosen = np.flatnonzero(sample)
    parts = (np.asarray(dataset[index], native) for index in chosen)
    return mapped_copy(parts, (len(chosen), *dataset.shape[1:]), native, in_memory=None if mapped else dataset.nbytes)


def _field(
    name: str, dataset: Any, found: Datasets, own: NDArray[np.bool_], names: re.Pattern[str]
) -> NDArray[np.float64] | None:
    """The mean of the flat or of the dark frames that belong to a stack; None if there are none."""
    if dataset.ndim != 3 or names.search(name):
        return None
    frames = [np.asarray(dataset[index], float) for index in np.flatnonzero(own)]
    group = name.rpartition("/")[0]
    for other, item in found.items():
        fits = item.ndim in (2, 3) and item.shape[-2:] == dataset.shape[1:]
        if fits and names.search(other) and other.startswith(group):
            frames += list(np.asarray(item, float).reshape(-1, *dataset.shape[1:]))
    return np.mean(frames, axis=0) if frames else None


def _unit_of(dataset: Any, usual: str) -> str:
    return _text(dataset.attrs.get("units", dataset.attrs.get("unit", usual)))


def _text(value: Any) -> str:
    value = value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _voxel_size(name: str, dataset: Any, found: Datasets) -> VoxelSize | None:
    """Read ``element_size_um``, (z, y, x) in µm, as written by ilastik and BigDataViewer, or the pixel sizes of NeXus with their
    units."""
    sizes = np.asarray(dataset.attrs.get("element_size_um", ()), dtype=float).reshape(-1)
    unit = in_angstrom("µm") or 0.0
    if sizes.size == 3 and (sizes > 0).all():
        z, y, x = (float(size) * unit for size in sizes)
        return z, y, x
    edges = [_length(pattern, name, found) for pattern in _SIZES]
    height, width = edges[0] or edges[1], edges[1] or edges[0]
    return None if height is None or width is None else (width, height, width)


def _length(pattern: str, name: str, found: Datasets) -> float | None:
    """Å, from the dataset of such a name, first in the group of the images; magnified sizes before those of the detector."""
    group = name.rpartition("/")[0]
    matches = [other for other, item in found.items() if re.search(pattern, other) and item.size == 1]
    matches.sort(key=lambda other: ("magnified" not in other and "sample_" not in other, not other.startswith(group)))
    for other in matches:
        unit = in_angstrom(_unit_of(found[other], ""))
        value = float(np.asarray(found[other], float).reshape(-1)[0])
        if unit is not None and 0 < value < np.inf:
            return value * unit
    return None
