"""Images and stacks in and out: MRC, TIFF, NumPy. Every output is written beside its target and renamed into place."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MRC_SUFFIXES = frozenset({".mrc", ".mrcs", ".st", ".ali", ".rec", ".map"})
TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
SUFFIXES = MRC_SUFFIXES | TIFF_SUFFIXES | {".npy"}


@dataclass(frozen=True)
class ImageFile:
    """What an image file holds.

    Attributes:
        data: the pixels in the file's own number type, (y, x) or (section, y, x).
        voxel_size: Å along each axis of ``data``'s (z, y, x), or None where the file does not say.
    """

    data: NDArray[Any]
    voxel_size: tuple[float, float, float] | None = None


def read(path: str | Path) -> ImageFile:
    """Read an image, stack or volume.

    Args:
        path: an MRC (``.mrc .mrcs .st .ali .rec .map``), TIFF or ``.npy`` file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is empty, truncated, of an unknown kind, or holds something that is not a real image.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the image file inside it")
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; check the path")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes); copy it again from its source")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: unknown file type '{suffix}'; noiseflow reads {', '.join(sorted(SUFFIXES))}")
    reader = _read_mrc if suffix in MRC_SUFFIXES else _read_tiff if suffix in TIFF_SUFFIXES else _read_npy
    try:
        image: ImageFile = reader(path)
    except PermissionError:
        raise
    except Exception as error:  # each library raises its own types on damaged bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path} cannot be read; it may be damaged or truncated ({reason[:200]})") from error
    return _checked(image, path)


def read_image(path: str | Path) -> NDArray[Any]:
    """Read one 2D image, (y, x); a stack of one section counts as one image. Raises as `read`."""
    data = read(path).data
    if data.ndim == 3 and data.shape[0] == 1:
        return np.asarray(data[0])
    if data.ndim != 2:
        raise ValueError(f"{path} holds an array of shape {data.shape}; a single 2D image is needed here")
    return data


def write(path: str | Path, data: NDArray[Any], *, voxel_size: tuple[float, float, float] | None = None) -> None:
    """Write an image, stack or volume in the format of the path's suffix.

    Args:
        path: target; ``.mrc``-like, ``.tif`` or ``.npy``. An existing file is replaced only once the new one is whole.
        data: (y, x) or (z, y, x).
        voxel_size: Å along (z, y, x).

    Raises:
        ValueError: unknown suffix, or a number type the format cannot hold.
    """
    path = Path(path)
    check_output(path)
    suffix = path.suffix.lower()
    with atomic_path(path) as partial:
        if suffix in MRC_SUFFIXES:
            _write_mrc(partial, data, voxel_size)
        elif suffix in TIFF_SUFFIXES:
            _write_tiff(partial, data, voxel_size)
        else:
            with partial.open("wb") as stream:
                np.save(stream, data, allow_pickle=False)


def check_output(path: str | Path, *, suffixes: frozenset[str] = SUFFIXES) -> Path:
    """Fail now, before long work, where a result could not be written; returns the path."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f"{path}: cannot write '{path.suffix}'; name the output with one of {', '.join(sorted(suffixes))}"
        )
    if path.is_dir():
        raise ValueError(f"{path} is a folder; name an output file")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} does not exist; create the folder first")
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"{path.parent} is not writable; choose another output folder")
    return path


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, renamed onto it when the block succeeds and removed when it fails."""
    path = Path(path)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        umask = os.umask(0)
        os.umask(umask)
        partial.chmod(0o666 & ~umask)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def require_finite(data: NDArray[Any], name: str | Path) -> None:
    """Refuse NaN and infinite pixels, naming how many there are and where the first one is."""
    if not np.issubdtype(data.dtype, np.floating):
        return
    bad = ~np.isfinite(data)
    count = int(bad.sum())
    if count:
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} has {count} NaN or infinite pixels, the first at {where}; replace them or mask them before this step"
        )


def require_contrast(data: NDArray[Any], name: str | Path) -> None:
    """Refuse an image whose pixels are all equal."""
    if data.size and data.min() == data.max():
        raise ValueError(f"{name} is flat: every pixel is {data.flat[0]}; check that the right file was given")


def _checked(image: ImageFile, path: Path) -> ImageFile:
    data = image.data
    if data.size == 0:
        raise ValueError(f"{path} holds no pixels (shape {data.shape})")
    if data.dtype.kind not in "iuf":
        raise ValueError(f"{path} holds {data.dtype} values; real integers or floats are needed")
    if data.ndim == 3 and data.shape[-1] in (3, 4) and data.dtype == np.uint8 and data.shape[0] > 4:
        raise ValueError(f"{path} is a colour image (shape {data.shape}); convert it to one grey channel first")
    if data.ndim not in (2, 3):
        raise ValueError(f"{path} has {data.ndim} dimensions (shape {data.shape}); 2 or 3 are needed")
    return image


def _read_mrc(path: Path) -> ImageFile:
    import mrcfile

    with mrcfile.open(path, header_only=True) as header_only:
        header = header_only.header
        count = int(header.nx) * int(header.ny) * int(header.nz)
        mode = mrcfile.utils.data_dtype_from_header(header)
        expected = count * mode.itemsize + 1024 + int(header.nsymbt)
    size = path.stat().st_size
    if min(header.nx, header.ny, header.nz) < 1 or expected > size:
        raise ValueError(
            f"its header claims {header.nx} x {header.ny} x {header.nz} pixels, {expected} bytes; the file has {size}"
        )
    with mrcfile.open(path) as mrc:
        data = np.array(mrc.data)
        x, y, z = (float(mrc.voxel_size[axis]) for axis in "xyz")
    return ImageFile(data, (z, y, x) if min(x, y, z) > 0 else None)


def _read_tiff(path: Path) -> ImageFile:
    import tifffile

    with tifffile.TiffFile(path) as tiff:
        claimed = sum(page.nbytes for page in tiff.pages)
        limit = 1000 * path.stat().st_size + 2**20  # no compression of real images comes near
        if claimed > limit:
            raise ValueError(f"its header claims {claimed} bytes of pixels")
        series = tiff.series[0]
        data = series.asarray()
        spacing = (tiff.imagej_metadata or {}).get("spacing")
        unit = (tiff.imagej_metadata or {}).get("unit")
        page = tiff.pages[0]
        tags: Any = page.tags if isinstance(page, tifffile.TiffPage) else {}
        resolution = [tags[name].value for name in ("YResolution", "XResolution") if name in tags]
    if unit == "angstrom" and spacing and len(resolution) == 2:
        y, x = (denominator / numerator for numerator, denominator in resolution)
        return ImageFile(data, (float(spacing), y, x))
    return ImageFile(data)


def _read_npy(path: Path) -> ImageFile:
    return ImageFile(np.array(np.load(path, mmap_mode="r", allow_pickle=False)))


def _write_mrc(path: Path, data: NDArray[Any], voxel_size: tuple[float, float, float] | None) -> None:
    import mrcfile

    if data.dtype in (np.float64, np.int32, np.int64, np.uint32):
        data = data.astype(np.float32)
    with mrcfile.new(path, data=np.ascontiguousarray(data), overwrite=True) as mrc:
        if voxel_size is not None:
            mrc.voxel_size = voxel_size[::-1]


def _write_tiff(path: Path, data: NDArray[Any], voxel_size: tuple[float, float, float] | None) -> None:
    import tifffile

    if voxel_size is None:
        tifffile.imwrite(path, data, photometric="minisblack")  # or a stack of three would be stored as colour
        return
    if data.dtype == np.float64:
        data = data.astype(np.float32)
    z, y, x = voxel_size
    tifffile.imwrite(path, data, imagej=True, resolution=(1 / x, 1 / y), metadata={"spacing": z, "unit": "angstrom"})
