"""What an image file holds, and the suffixes of the formats that are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MRC_SUFFIXES = frozenset({".mrc", ".mrcs", ".st", ".ali", ".rec", ".map"})
TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
MICROSCOPE_SUFFIXES = frozenset({".dm3", ".dm4", ".emd", ".ser", ".emi", ".hspy"})
HDF5_SUFFIXES = frozenset({".h5", ".hdf5", ".nxs"})
WRITE_SUFFIXES = MRC_SUFFIXES | TIFF_SUFFIXES | {".npy", ".zarr"}
SUFFIXES = WRITE_SUFFIXES | {".npz"} | MICROSCOPE_SUFFIXES | HDF5_SUFFIXES
PNG_SUFFIX = ".png"
"""Read as a single image; apart from `SUFFIXES`, as the PNG files beside data are pictures of them."""

VoxelSize = tuple[float, float, float]


@dataclass(frozen=True)
class ImageFile:
    """What an image file holds.

    Attributes:
        data: the pixels in the file's own number type, (y, x) or (section, y, x).
        voxel_size: Å along each axis of ``data``'s (z, y, x), or None where the file does not say.
        tilt_angles: (section,) degrees, or None where the file does not say.
        tilt_axis: its direction in the images, degrees from y towards −x, or None where the file does not say.
    """

    data: NDArray[Any]
    voxel_size: VoxelSize | None = None
    tilt_angles: NDArray[np.float64] | None = None
    tilt_axis: float | None = None

    def __repr__(self) -> str:
        size = "unknown" if self.voxel_size is None else " x ".join(f"{edge:.5g}" for edge in self.voxel_size) + " Å"
        angles = self.tilt_angles
        tilts = "" if angles is None else f", tilts {angles.min():g}° to {angles.max():g}°"
        shape = " x ".join(map(str, self.data.shape))
        return f"ImageFile({shape} {self.data.dtype}, voxel size {size}{tilts})"
