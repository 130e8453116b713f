"""Reader and writer of the napari plugin."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from noiseflow import io
from noiseflow.io.mapped import is_large
from recon.uncertainty.result import error_bar_paths

LayerData = tuple[Any, dict[str, Any], str]


def get_reader(path: str | list[str]) -> Callable[[str | list[str]], list[LayerData]] | None:
    """The reader for a path, or None if noiseflow cannot read it; only single paths are supported."""
    if not isinstance(path, str) or Path(path).suffix.lower() not in io.SUFFIXES:
        return None
    return read_layers


def read_layers(path: str | list[str]) -> list[LayerData]:
    """Read an image, tilt series or volume as a layer, with its voxel size in Å; error bars next to it become hidden layers.
    Raises FileNotFoundError, ValueError as `noiseflow.io.read`.

    Tilt angles in or next to the file are stored in the metadata of the layer as ``tilt_angles``, degrees. The tilt axis of the
    stack counts images, in the unit of the others: napari ignores all units unless those of its layers agree.
    """
    source = path if isinstance(path, str) else path[0]
    image = _read(source)
    metadata: dict[str, Any] = {"source": source}
    axes = axes_of(image.voxel_size, image.data.ndim)
    if image.data.ndim == 3:
        try:
            metadata["tilt_angles"] = io.tilt_angles_of(source, image)
        except (FileNotFoundError, ValueError):  # no tilt series, or a list of angles of another one
            pass
        else:
            axes |= {"scale": (1.0, *axes["scale"][1:]), "axis_labels": ("tilt", "y", "x")}
    if image.voxel_size is not None:
        metadata["voxel_size"] = image.voxel_size
    own = (image.data, {"name": Path(source).stem, "metadata": metadata, **axes}, "image")
    beside = [path for path in error_bar_paths(source).values() if path.exists()]
    return [own, *(error_bar_layer(_read(path).data, path.stem, own[1]) for path in beside)]


def axes_of(voxel_size: Sequence[float] | None, dimensions: int = 3) -> dict[str, Any]:
    """Scale, units and names of the axes of a layer: Å where the size of a voxel (z, y, x) is known, otherwise pixels."""
    unit, size = ("pixel", (1.0, 1.0, 1.0)) if voxel_size is None else ("angstrom", voxel_size)
    names = ("z", "y", "x")[-dimensions:]
    return {"scale": tuple(size[-dimensions:]), "units": (unit,) * dimensions, "axis_labels": names}


def _read(path: str | Path) -> io.ImageFile:
    """Read a file; large files are memory-mapped."""
    return io.read(path, mapped=is_large(path))


def error_bar_layer(values: Any, name: str, volume: Mapping[str, Any]) -> LayerData:
    """A hidden layer of standard deviations or biases at the position of its volume, with a diverging colour map."""
    reach = max(float(np.abs(section).max()) for section in values) or 1.0
    look = {"name": name, "visible": False, "colormap": "PiYG", "contrast_limits": (-reach, reach)}
    axes = {name: volume[name] for name in ("scale", "units", "axis_labels")}
    return values, {**look, **axes, "metadata": dict(volume["metadata"])}, "image"


def write_image(path: str, data: Any, attributes: Mapping[str, Any]) -> list[str]:
    """Write one layer as MRC, TIFF, NumPy or OME-Zarr, and return the path. Raises ValueError if the suffix is unknown, or the
    format cannot store the pixels.
    """
    pixels = np.asarray(data)
    size = attributes.get("metadata", {}).get("voxel_size")
    io.write(path, pixels, voxel_size=None if size is None else tuple(size))
    return [path]
