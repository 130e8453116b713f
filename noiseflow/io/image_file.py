"""Contents of an image file, and the suffixes of supported formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MRC_SUFFIXES = frozenset({".mrc", ".mrcs", ".st", ".ali", ".preali", ".rec", ".map"})
TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
TIFF_LIKE_SUFFIXES = frozenset({".lsm", ".stk"})
CAMERA_SUFFIXES = frozenset(
    {".fits", ".fit", ".fts", ".spe", ".raw", ".bin", ".mat", ".nd2", ".czi", ".oib", ".oif", ".lif", ".sif"}
)
MICROSCOPE_SUFFIXES = frozenset({".dm3", ".dm4", ".emd", ".ser", ".emi", ".hspy"})
HDF5_SUFFIXES = frozenset({".h5", ".hdf5", ".hdf", ".nxs"})
PACKED_SUFFIXES = frozenset({".gz", ".bz2"})
WRITE_SUFFIXES = MRC_SUFFIXES | TIFF_SUFFIXES | {".npy", ".zarr"}
SUFFIXES = WRITE_SUFFIXES | {".npz"} | MICROSCOPE_SUFFIXES | HDF5_SUFFIXES | TIFF_LIKE_SUFFIXES | CAMERA_SUFFIXES
PNG_SUFFIX = ".png"
"""Suffix of PNG files, read as single images. Not in `SUFFIXES`, because PNG files next to data are usually previews."""

VoxelSize = tuple[float, float, float]


@dataclass(frozen=True)
class ImageFile:
    """Contents of an image file.

    Attributes:
        data: pixels in the data type of the file, (y, x) or (section, y, x); readers may return (channel, section, y, x),
            of which `read` chooses one channel.
        voxel_size: Å along (z, y, x), or None if the file does not state it.
        tilt_angles: (section,) degrees, or None if the file does not state them.
        tilt_axis: direction of the tilt axis in the images, degrees from y towards −x, or None if the file does not state it.
        channels: names of the channels, if the file holds several.
        named: whether the file held several images, of which this one was chosen.
        names: (section,) names of the files of a folder.
        flat, dark: (y, x) mean exposures without a specimen and without a beam, if the file holds them; not applied.
    """

    data: NDArray[Any]
    voxel_size: VoxelSize | None = None
    tilt_angles: NDArray[np.float64] | None = None
    tilt_axis: float | None = None
    channels: tuple[str, ...] = ()
    named: bool = False
    names: tuple[str, ...] = ()
    flat: NDArray[np.float64] | None = None
    dark: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        size = "unknown" if self.voxel_size is None else " x ".join(f"{edge:.5g}" for edge in self.voxel_size) + " Å"
        angles = self.tilt_angles
        tilts = "" if angles is None else f", tilts {angles.min():g}° to {angles.max():g}°"
        shape = " x ".join(map(str, self.data.shape))
        return f"ImageFile({shape} {self.data.dtype}, voxel size {size}{tilts})"


def numbered(count: int, names: Sequence[str] = ()) -> tuple[str, ...]:
    """The names of channels, or their numbers from zero if they do not have a name each."""
    return tuple(names) if len(set(names)) == count else tuple(str(index) for index in range(count))
