"""What files hold: an image with its metadata, and a table of tilts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import Unsupported, choose

MRC_SUFFIXES = frozenset({".mrc", ".mrcs", ".st", ".ali", ".preali", ".rec", ".map"})
TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
FORMATS: dict[str, frozenset[str]] = {
    "mrc": MRC_SUFFIXES,
    "tiff": TIFF_SUFFIXES | {".lsm", ".stk"},
    "mapped": frozenset({".npy", ".npz"}),
    "ome_zarr": frozenset({".zarr"}),
    "hdf5": frozenset({".h5", ".hdf5", ".hdf", ".nxs"}),
    "microscope": frozenset({".dm3", ".dm4", ".emd", ".ser", ".emi", ".hspy"}),
    "camera_formats": frozenset(
        {".fits", ".fit", ".fts", ".fz", ".spe", ".raw", ".bin", ".mat", ".nd2", ".czi", ".oib", ".oif", ".lif", ".sif"}
    ),
}
"""Suffixes by module of `noiseflow.io`, whose ``read(path, member, mapped=…)`` returns an `ImageFile`."""
SUFFIXES = frozenset[str]().union(*FORMATS.values())
WRITE_SUFFIXES = MRC_SUFFIXES | TIFF_SUFFIXES | {".npy", ".zarr"}
PNG_SUFFIX = ".png"
"""Suffix of PNG files, read as single images. Not in `SUFFIXES`, because PNG files next to data are usually previews."""
READ_SUFFIXES = SUFFIXES | {PNG_SUFFIX}

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
        named: whether the reader chose this image, among those of the file, by the name or index that it was given.
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


def by_axes(
    data: NDArray[Any],
    axes: Sequence[str],
    channels: Sequence[str] = (),
    *,
    member: str | None = None,
    named: bool = False,
) -> ImageFile:
    """Pixels (channel, frame, y, x) of an array whose axes have names; those of one pixel are left out.

    Args:
        axes: letter of each axis: Y, X, C of channels, S of colours, P and M of positions, of which `member` chooses one; all
            others count frames.
        channels: names of the channels.
        named: see `ImageFile`.
    """
    keep = [place for place, axis in enumerate(axes) if data.shape[place] > 1 or axis in "YX"]
    data, axes = data.reshape([data.shape[place] for place in keep]), [axes[place] for place in keep]
    if "S" in axes:
        raise Unsupported(f"is a colour image (shape {data.shape}); save one colour as a grey image")
    positions = [place for place, axis in enumerate(axes) if axis in "PM"]
    if positions:
        data = np.moveaxis(data, positions, range(len(positions)))
        data = data.reshape(-1, *data.shape[len(positions) :])
        data, named = data[choose(numbered(len(data)), member, "positions")], True
        axes = [axis for axis in axes if axis not in "PM"]
    if "C" not in axes:
        return ImageFile(data, named=named)
    data = np.moveaxis(data, axes.index("C"), 0)
    return ImageFile(data, channels=numbered(len(data), channels), named=named)


LARGEST_ANGLE = 720
"""Largest plausible tilt angle, degrees: two full turns, more than any stage reports."""


@dataclass(frozen=True)
class TiltTable:
    """Rows of a file that describes the images of a tilt series.

    Attributes:
        angles: (row,) degrees.
        names: (row,) file of each image; empty if the table does not name them.
        sections: (row,) index of each image in its stack as written, from 0 or 1; None if the rows are all images in order.
        transforms: (row, 2, 3) of IMOD, from raw to aligned (x, y); None if the table is not an alignment.
        in_angstrom: whether the shifts of the transforms are in Å, not pixels of the stack.
        image_shape: (y, x) of the images that the transforms refer to; None if unknown.
        pixel_size: Å, or None if unknown.
        tilt_axis: degrees from y towards −x, or None if unknown.
        excluded: rows to leave out, from 0.
        x_tilt: degrees by which the specimen is turned about x, as IMOD's ``XAXISTILT``: z of a flat specimen rises with y.
        acquired: (row,) dose before each image, or its time, in any unit; None if unknown.
    """

    angles: NDArray[np.float64]
    names: tuple[str, ...] = ()
    sections: NDArray[np.int64] | None = None
    transforms: NDArray[np.float64] | None = None
    in_angstrom: bool = False
    image_shape: tuple[int, int] | None = None
    pixel_size: float | None = None
    tilt_axis: float | None = None
    excluded: tuple[int, ...] = ()
    x_tilt: float = 0.0
    acquired: NDArray[np.float64] | None = None

    def rows(self, chosen: Sequence[int]) -> TiltTable:
        """Some of the rows, in this order."""
        order = np.asarray(chosen, dtype=np.int64)
        columns = ((name, getattr(self, name)) for name in ("angles", "sections", "transforms", "acquired"))
        kept: dict[str, Any] = {name: None if column is None else column[order] for name, column in columns}
        return replace(
            self,
            names=tuple(self.names[row] for row in order) if self.names else (),
            excluded=tuple(place for place, row in enumerate(order) if row in self.excluded),
            **kept,
        )


def rotations(tilt_axes: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """(row, 2, 3) transforms of IMOD for images whose axis and centre were found in the raw images.

    Args:
        tilt_axes: (row,) degrees from y towards −x.
        shifts: (row, 2) shift (x, y) of the aligned centre from the raw centre, pixels.
    """
    theta = np.deg2rad(tilt_axes)
    matrices = np.stack([np.cos(theta), np.sin(theta), -np.sin(theta), np.cos(theta)], 1).reshape(-1, 2, 2)
    return np.concatenate([matrices, -matrices @ shifts[:, :, None]], 2)
