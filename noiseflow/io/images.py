"""Reading and writing of images, stacks and volumes; the suffix determines the format."""

from __future__ import annotations

import bz2
import gzip
import shutil
import tempfile
import zlib
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.installation import install_command
from noiseflow.io.checks import EXPORT, Unsupported, choose, is_colour
from noiseflow.io.image_file import FORMATS, MRC_SUFFIXES, READ_SUFFIXES, TIFF_SUFFIXES, ImageFile, VoxelSize, numbered
from noiseflow.runs.outputs import atomic_folder, atomic_path, check_output, require_whole

if TYPE_CHECKING:
    from torch import Tensor

_ORDER = "check the order and the names of the arguments"
_NO_IMAGES = {
    **dict.fromkeys((".rawtlt", ".tlt", ".mdoc"), f"not an image but a file of tilt angles (--angles); {_ORDER}"),
    ".xf": f"not an image but a file of alignments (--alignment); {_ORDER}",
    ".safetensors": f"not an image but a noise model; {_ORDER}",
    **dict.fromkeys(
        (".jpg", ".jpeg", ".jp2", ".webp", ".heic", ".mp4"),
        "compressed with loss, which replaces the noise by errors of its own, also in a converted copy; use the raw frames",
    ),
    **dict.fromkeys(
        (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf"),
        "a raw file of a camera; write its pixels, neither interpolated nor scaled, as TIFF (LibRaw: unprocessed_raw -T)",
    ),
}
_PACKED = (".gz", ".bz2")


def read(path: str | Path, *, mapped: bool = False, channel: str | int | None = None) -> ImageFile:
    """Read an image, stack or volume.

    Args:
        path: an MRC (``.mrc .mrcs .st .ali .preali .rec .map``), TIFF, ``.npy`` or ``.npz`` file, also packed (``.gz``,
            ``.bz2``), a grey ``.png`` image, or a folder of single images of these formats, PNG only if there are no others;
            with the extra ``[formats]`` also ``.dm3 .dm4 .emd .ser .emi .hspy .zarr`` and HDF5, and the formats of cameras that
            `noiseflow.io.camera_formats` lists. ``FILE::NAME`` selects one image, or one channel, of a file that holds several.
        mapped: memory-map the pixels; changes to the array are not written to the file. Large stacks that cannot be mapped
            (compressed TIFF, HDF5, OME-Zarr) are read in pieces into a temporary file.
        channel: name, or index from zero, of one image or channel of a file that holds several; as ``FILE::NAME``.

    Raises:
        FileNotFoundError: the file does not exist.
        SeveralImages: the file holds several images or channels, and none of them was chosen; a ValueError.
        ValueError: the file is empty, truncated or of an unknown type, or does not hold a real-valued image.
        ModuleNotFoundError: the format needs the extra ``[formats]``, which is not installed.
    """
    from noiseflow.io.folder import read_folder

    name, _, member = str(path).partition("::")
    wanted = None if channel is None else str(channel)
    path = Path(name)
    if path.is_dir() and path.suffix.lower() != ".zarr":
        return read_folder(path, partial(read, channel=channel))
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; check the path")
    if path.is_file() and path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes); copy it again from its source")
    if path.suffix.lower() in _PACKED:
        return _unpacked(path, member or channel)
    format_name = _format_of(path)
    try:
        image: ImageFile = import_module(f"noiseflow.io.{format_name}").read(path, member or wanted, mapped=mapped)
        image = _one_channel(image, (wanted if member else None) if image.named else member or wanted)
    except PermissionError:
        raise
    except ModuleNotFoundError as error:
        extra = "camera-formats" if format_name == "camera_formats" else "formats"
        raise ModuleNotFoundError(
            f"{path}: reading {path.suffix} needs {error.name}; install it with: {install_command(extra)}"
        ) from error
    except Unsupported as error:
        error.args = (f"{path} {error}",)
        raise
    except Exception as error:  # each library raises its own errors for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        cause = "install a package" if "requires the '" in reason else "it may be damaged or truncated"
        raise ValueError(f"{path} cannot be read; {cause} ({reason[:200]})") from error
    return _checked(image, path)


def read_image(path: str | Path) -> NDArray[Any]:
    """Read a 2D image, (y, x); a stack of one section is accepted. Raises as `read`."""
    data = read(path).data
    if data.ndim == 3 and data.shape[0] == 1:
        return np.asarray(data[0])
    if data.ndim != 2:
        raise ValueError(f"{path} holds an array of shape {data.shape}; a single 2D image is required here")
    return data


def write(
    path: str | Path, data: NDArray[Any] | Tensor, *, voxel_size: VoxelSize | None = None, stack: bool = False
) -> None:
    """Write an image, stack or volume in the format of the path's suffix.

    Args:
        path: target; an MRC suffix, ``.tif``, ``.npy`` or, with the extra ``[formats]``, ``.zarr`` (OME-Zarr). An existing
            file is replaced only when the new one is complete.
        data: (y, x) or (z, y, x), array or tensor; ``.npy`` files may have more axes.
        voxel_size: Å along (z, y, x).
        stack: the sections are images, not slices of a volume; MRC headers say so.

    Raises:
        ValueError: the suffix is unknown, the data is not an image, or the format cannot store its type.
    """
    from noiseflow.arrays import as_array
    from noiseflow.io import mapped, mrc, ome_zarr, tiff

    path = check_output(path)
    data = as_array(data)
    suffix = path.suffix.lower()
    if data.dtype.kind not in "iuf" or data.ndim < 2 or (data.ndim > 3 and suffix != ".npy"):
        raise ValueError(
            f"{path}: an array of {data.dtype} and shape {data.shape} is not an image; give a 2D or 3D numeric array "
            "(.npy files may have more axes)"
        )
    if suffix == ".zarr":
        with atomic_folder(path) as folder:
            ome_zarr.write(folder, data, voxel_size, name=path.name.split(".")[0])
        return
    with atomic_path(path) as target:
        if suffix in MRC_SUFFIXES:
            stored = mrc.write(target, data, voxel_size, stack=stack)
        elif suffix in TIFF_SUFFIXES:
            stored = tiff.write(target, data, voxel_size)
        else:
            stored = mapped.write(target, data)
        require_whole(target, stored.nbytes)


def _format_of(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix in _NO_IMAGES:
        raise ValueError(f"{path} is {_NO_IMAGES[suffix]}")
    if suffix not in READ_SUFFIXES:
        raise ValueError(
            f"{path}: unknown file type '{suffix}'; noiseflow reads {', '.join(sorted(READ_SUFFIXES))}; of any other "
            f"image, {EXPORT}"
        )
    return next((name for name, suffixes in FORMATS.items() if suffix in suffixes), "camera_formats")


def _unpacked(path: Path, channel: str | int | None) -> ImageFile:
    """The image in a file that gzip or bzip2 packed, such as ``.mrc.gz``; it is unpacked to a temporary file first."""
    opener = gzip.open if path.suffix.lower() == ".gz" else bz2.open
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / path.stem
        try:
            with opener(path, "rb") as packed, plain.open("wb") as target:
                shutil.copyfileobj(packed, target)
            image = read(plain, channel=channel)
        except (EOFError, OSError, zlib.error) as error:
            if getattr(error, "errno", None) is not None:  # of the disk
                raise
            raise ValueError(f"{path} cannot be read; it may be damaged or truncated ({error})") from error
        except ValueError as error:
            error.args = (str(error).replace(str(plain), str(path)),)
            raise
    return image


def _one_channel(image: ImageFile, wanted: str | None) -> ImageFile:
    """The chosen channel of (channel, section, y, x); readers of formats with named images have chosen already."""
    # channels alone, without names, are a stack if none is wanted
    if image.data.ndim == 4 or image.channels not in ((), () if wanted else numbered(len(np.atleast_1d(image.data)))):
        # axes without names: there are fewer channels than tilts, and another number of angles is refused
        swapped = not image.channels and image.data.shape[0] > image.data.shape[1]
        data = np.moveaxis(image.data, 1, 0) if swapped else image.data
        return replace(image, data=data[choose(image.channels or numbered(len(data)), wanted, "channels")])
    if wanted not in (None, "0") and not image.named:
        raise Unsupported(f"holds one image; remove ::{wanted} or --channel {wanted}")
    return image


def _checked(image: ImageFile, path: Path) -> ImageFile:
    data = image.data
    if data.size == 0:
        raise ValueError(f"{path} holds no pixels (shape {data.shape})")
    if data.dtype == np.bool_:  # masks
        return _checked(replace(image, data=data.view(np.uint8)), path)
    if data.dtype.kind not in "iuf":
        raise ValueError(f"{path} holds {data.dtype} values; integers or real floating-point numbers are required")
    if is_colour(data.shape) and data.dtype == np.uint8:
        raise ValueError(f"{path} is a colour image (shape {data.shape}); save one colour as a grey image")
    if data.ndim not in (2, 3):
        raise ValueError(f"{path} has {data.ndim} dimensions (shape {data.shape}); 2 or 3 are required")
    return image
