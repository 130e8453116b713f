"""OME-Zarr: multiscale volumes with physical units, OME-NGFF 0.5 (extra ``[formats]``).

Source: https://ngff.openmicroscopy.org/0.5
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.installation import library_version
from noiseflow.io.checks import Unsupported, require_room
from noiseflow.io.hdf5 import largest_of
from noiseflow.io.image_file import ImageFile, VoxelSize, numbered
from noiseflow.io.mapped import let_go, temporary_map
from noiseflow.io.metadata import in_angstrom, leaves_of, recorded_angles
from noiseflow.runs.ownership import MARK
from noiseflow.statistics import block_means

_CHUNK = 128


def write(path: Path, data: NDArray[Any], voxel_size: VoxelSize | None, *, name: str) -> None:
    """Write a named image or volume with a pyramid of coarser levels, each binned by 2, down to 64 pixels at the longest edge."""
    import zarr

    axes = "zyx"[-data.ndim :]
    scale = np.array((voxel_size or (1.0, 1.0, 1.0))[-data.ndim :])
    unit = {} if voxel_size is None else {"unit": "angstrom"}
    group = zarr.open_group(path, mode="w", zarr_format=3)
    datasets: list[dict[str, Any]] = []
    shape, factors = data.shape, np.ones(data.ndim)
    level: Any = None
    while True:
        own, finer = str(len(datasets)), level
        chunks = tuple(min(_CHUNK, edge) for edge in shape)
        level = group.create_array(own, shape=shape, dtype=data.dtype, chunks=chunks, dimension_names=list(axes))
        for part in _parts(shape, chunks):
            # the region of the next finer level that corresponds to this part
            fine = () if finer is None else zip(part, finer.shape, strict=True)
            twice = tuple(slice(2 * p.start, 2 * p.stop) if edge > 1 else p for p, edge in fine)
            level[part] = data[part] if finer is None else _halved(finer[twice])
        transforms = [
            {"type": "scale", "scale": list(scale * factors)},
            {"type": "translation", "translation": list(scale * (factors - 1) / 2)},
        ]
        datasets.append({"path": own, "coordinateTransformations": transforms})
        if 2 * max(shape) <= _CHUNK:
            break
        factors = factors * [2 if edge > 1 else 1 for edge in shape]
        shape = tuple(max(1, edge // 2) for edge in shape)
    multiscale: dict[str, Any] = {"name": name, "type": "mean", "datasets": datasets}
    multiscale["axes"] = [{"name": axis, "type": "space", **unit} for axis in axes]
    group.attrs["ome"] = {"version": "0.5", "multiscales": [multiscale]}
    group.attrs["_creator"] = {"name": MARK, "version": library_version()}


def _parts(shape: tuple[int, ...], chunks: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """The chunks of an array, so that only one is in memory at a time."""
    for number in np.ndindex(*(-(-edge // chunk) for edge, chunk in zip(shape, chunks, strict=True))):
        corner = [index * chunk for index, chunk in zip(number, chunks, strict=True)]
        yield tuple(slice(c, min(c + chunk, edge)) for c, chunk, edge in zip(corner, chunks, shape, strict=True))


def read(path: Path, member: str | None = None, *, mapped: bool = False) -> ImageFile:
    """Read the finest level of OME-Zarr, or the largest array of other Zarr; if `mapped`, large ones into a temporary file."""
    import zarr

    node = zarr.open(path, mode="r")
    attributes: Any = node.attrs.asdict()
    multiscales = attributes.get("ome", attributes).get("multiscales")
    if not isinstance(node, zarr.Group) or not multiscales:
        found = dict(node.members(max_depth=None)) if isinstance(node, zarr.Group) else {"": node}
        arrays: Any = {f"/{name}": each for name, each in found.items() if isinstance(each, zarr.Array)}
        stored = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        return largest_of(arrays, path, member, mapped=mapped, stored=stored)
    first = multiscales[0]
    array = node[first["datasets"][0]["path"]]
    if not isinstance(array, zarr.Array):
        raise Unsupported("is not an OME-Zarr image: its first dataset is not an array")
    require_room(array.nbytes, path, compressed=True, size=int(array.nbytes_stored()))
    data = temporary_map(array.shape, array.dtype, in_memory=None if mapped else array.nbytes)
    for part in _parts(array.shape, array.chunks):
        data[part] = array[part]
        let_go(data)
    keep = [index for index, edge in enumerate(data.shape) if edge > 1 or index >= data.ndim - 2]
    transforms = first["datasets"][0].get("coordinateTransformations", [])
    scale = next((t["scale"] for t in transforms if t.get("type") == "scale"), [0] * data.ndim)
    units = [in_angstrom(axis.get("unit")) or 0.0 for axis in first["axes"]]
    edges = [float(scale[index]) * units[index] for index in keep]
    names = [str(first["axes"][index].get("name")).lower() for index in keep]
    data = data.reshape([data.shape[index] for index in keep])
    channels: tuple[str, ...] = ()
    if data.ndim == 4 and "c" in names:
        data, omero = np.moveaxis(data, names.index("c"), 0), attributes.get("ome", attributes).get("omero", {})
        channels = numbered(len(data), [str(channel.get("label", "")) for channel in omero.get("channels", ())])
        edges.pop(names.index("c"))
    size = (edges[0] or edges[-1], edges[-2], edges[-1]) if len(edges) in (2, 3) and min(edges[-2:]) > 0 else None
    angles = recorded_angles(leaves_of(attributes), (1, *data.shape[:-2])[-1])
    return ImageFile(data, size, angles, channels=channels)


def _halved(data: NDArray[Any]) -> NDArray[Any]:
    """Means of 2 × 2 (× 2) pixels; an odd last row is dropped, an axis of one pixel is kept."""
    mean = block_means(data, *(min(edge, 2) for edge in data.shape))
    return (mean if data.dtype.kind == "f" else np.rint(mean)).astype(data.dtype)
