"""Tilt series, voxel grids and volumes, validated on creation."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy  # its packages load when they are first used
from numpy.typing import NDArray

from noiseflow import io
from noiseflow.described import described, size_of
from noiseflow.io import mapped
from noiseflow.io.angles import advice_on_count
from noiseflow.io.mapped import is_mapped

Mode = Literal["transmission", "linear"]


@dataclass(frozen=True)
class TiltSeries:
    """Images of one object at several tilts, in raw detector units.

    Attributes:
        images: (tilt, y, u), any real type, array or tensor; the tilt axis is along y through the centre of u.
        tilt_angles: (tilt,) degrees.
        pixel_size: Å, or None if unknown.
        mode: ``transmission`` (bright field: I0·exp(−line integral)) or ``linear`` (HAADF, EDX: gain·line integral).
        mask: (tilt, y, u), True for pixels to use; None for all. Methods exclude the other pixels; WBP replaces them by
            projections of a volume of the used ones.
        beam: (tilt,) incident intensity relative to the median if the beam drifts; the initial value of a fit.
        axes: (tilt,) direction of each tilt axis in the specimen, degrees from y towards −x, if there are two: 0, or a number
            near 90 for images whose axis is along x; None if all are along y. All images show the specimen in the same
            orientation at zero tilt. See `recon.DualAxisProjector`.
        dose: (tilt,) dose before each image, or its time, in any unit; None if unknown. Used for shrinkage only.
        x_tilt: degrees by which the specimen is turned about x according to its files; commands level their volumes by it, see
            `Volume.levelled`.
        tilt_axis: direction of the tilt axis in raw images according to their file, degrees from y towards −x, or None; used
            only as the initial value of an alignment.
        views: (tilt,) index of each image among the `num_views` of its file, if some of these were left out; else None.
        num_views: number of images of the file, if some were left out.

    Raises:
        ValueError: `images` is not a stack or is constant, angles, mask or beam do not match it, or pixels or angles are not
            finite.

    Example:
        >>> import numpy as np, recon
        >>> series = recon.TiltSeries(np.random.default_rng(0).random((3, 8, 8)), [-30.0, 0.0, 30.0], mode="linear")
        >>> series.images.shape
        (3, 8, 8)
    """

    images: NDArray[Any]
    tilt_angles: NDArray[np.float64]
    pixel_size: float | None = None
    mode: Mode = "transmission"
    mask: NDArray[np.bool_] | None = None
    beam: NDArray[np.float64] | None = None
    tilt_axis: float | None = None
    axes: NDArray[np.float64] | None = None
    views: NDArray[np.int64] | None = None
    num_views: int | None = None
    dose: NDArray[np.float64] | None = None
    x_tilt: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "images", io.as_array(self.images))
        object.__setattr__(self, "tilt_angles", np.asarray(self.tilt_angles, dtype=np.float64).reshape(-1))
        if self.mode not in ("transmission", "linear"):
            raise ValueError(f"mode '{self.mode}': choose transmission (bright field) or linear (HAADF, EDX)")
        if self.images.ndim != 3:
            raise ValueError(f"a tilt series is a stack (tilt, y, x); this array has shape {self.images.shape}")
        if len(self.images) != len(self.tilt_angles):
            raise ValueError(
                f"the stack has {len(self.images)} images, but there are {len(self.tilt_angles)} tilt angles; "
                f"{advice_on_count(self.images.shape, len(self.tilt_angles))}"
            )
        if len(self.images) < 2:
            raise ValueError("a tilt series needs at least two tilts")
        if self.mask is not None and (self.mask.shape != self.images.shape or self.mask.dtype != np.bool_):
            raise ValueError(
                f"the mask is {self.mask.dtype} of shape {self.mask.shape}; it must be boolean, shaped {self.images.shape}"
            )
        if self.beam is not None and (self.beam.shape != self.tilt_angles.shape or not (self.beam > 0).all()):
            raise ValueError(f"beam needs one positive number for each of the {len(self.images)} tilts")
        if self.mask is not None and not self.mask.any():
            raise ValueError("the mask excludes every pixel; it must be True for pixels to use")
        io.require_finite(self.images, "the tilt series")
        io.require_finite(self.tilt_angles, "the list of tilt angles")
        ends = [(part.min(), part.max()) for part in self.values() if part.size]
        io.require_contrast(np.array(ends), "the tilt series")
        shown = sum(bool(image.min() < image.max()) for image in self.images)
        if shown < 2 <= len(self.images):
            raise ValueError(
                f"{len(self.images) - shown} of {len(self.images)} images are constant; a tilt series needs at least two that "
                "are not: check that the right file was given"
            )
        if self.axes is not None and np.shape(self.axes) != self.tilt_angles.shape:
            raise ValueError(f"axes needs one direction for each of the {len(self.images)} tilts")
        self._check_angles()

    def __repr__(self) -> str:
        size = "unknown pixel size" if self.pixel_size is None else f"{self.pixel_size:.4g} Å per pixel"
        low, high = self.tilt_angles.min(), self.tilt_angles.max()
        masked = "" if self.mask is None else f", {np.mean(~self.mask):.2%} masked"
        return f"TiltSeries({size_of(self.images)}, {low:g}° to {high:g}°, {size}, {self.mode}{masked})"

    @property
    def num_tilts(self) -> int:
        """Number of tilts."""
        return len(self.images)

    @property
    def used(self) -> NDArray[np.bool_]:
        """(tilt, y, u), True for pixels to use."""
        return np.ones(self.images.shape, dtype=np.bool_) if self.mask is None else self.mask

    def values(self) -> Iterator[NDArray[Any]]:
        """Yield the used pixel values of each image, (N,)."""
        for number, image in enumerate(self.images):
            yield image.reshape(-1) if self.mask is None else image[self.mask[number]]

    def rows(self, rows: slice | NDArray[np.int64]) -> TiltSeries:
        """Some rows (y) of all images; they may be constant. Of a series about two axes, all rows belong together."""
        return self.with_images(self.images[:, rows], None if self.mask is None else self.mask[:, rows])

    def with_images(self, images: NDArray[Any], mask: NDArray[np.bool_] | None) -> TiltSeries:
        """The same series with parts or copies of its images, without new checks."""
        part = copy.copy(self)
        object.__setattr__(part, "images", images)
        object.__setattr__(part, "mask", mask)
        return part

    def select(self, tilts: NDArray[Any] | slice) -> TiltSeries:
        """Some of the tilts, by index, boolean mask or slice; they may be constant.

        Evenly spaced tilts are views of the images, so that mapped images stay on the disk. Other selections of large mapped
        images are copied to a temporary file.
        """
        tilts = evenly(tilts, self.num_tilts)
        images, mask = sections(self.images, tilts), None if self.mask is None else sections(self.mask, tilts)
        part = self.with_images(images, mask)
        for name in ("tilt_angles", "beam", "axes", "dose"):
            value = getattr(self, name)
            object.__setattr__(part, name, None if value is None else value[tilts])
        object.__setattr__(part, "views", (np.arange(self.num_tilts) if self.views is None else self.views)[tilts])
        object.__setattr__(part, "num_views", self.num_views or self.num_tilts)
        part._check_angles()
        return part

    @property
    def rising(self) -> NDArray[np.int64]:
        """Indices of the tilts by axis, then by rising angle; stable."""
        axes = np.zeros(self.num_tilts) if self.axes is None else self.axes
        return np.lexsort((self.tilt_angles, axes))

    def _check_angles(self) -> None:
        axes = np.zeros(self.num_tilts) if self.axes is None else self.axes
        for axis in np.unique(axes):
            angles = self.tilt_angles[axes == axis]
            if (largest := np.abs(angles).max()) > io.LARGEST_ANGLE:
                raise ValueError(f"a tilt angle of {largest:g}° is impossible; give degrees within ±{io.LARGEST_ANGLE}")
            if np.allclose(angles, angles[0]):
                raise ValueError(f"all {len(angles)} tilt angles are {angles[0]:g}°; give several different angles")


def sections(stack: NDArray[Any], chosen: NDArray[Any] | slice) -> NDArray[Any]:
    """Some images of a stack; those of a large mapped stack are copied to a temporary file, unless they are evenly spaced."""
    if isinstance(chosen, slice) or not is_mapped(stack) or stack.nbytes <= mapped.IN_MEMORY:
        return stack[chosen]
    numbers = np.arange(len(stack))[chosen]
    return mapped.mapped_copy((stack[number] for number in numbers), (len(numbers), *stack.shape[1:]), stack.dtype)


@described(depth="voxels", height="voxels", width="voxels", voxel_size="Å")
@dataclass(frozen=True)
class VolumeGrid:
    """The voxel grid of a reconstruction, centred on the tilt axis.

    Attributes:
        depth, height, width: voxels along z (the beam at zero tilt), y (the tilt axis) and x.
        voxel_size: Å, or None if unknown.

    Example:
        >>> import recon
        >>> recon.VolumeGrid(depth=32, height=64, width=64, voxel_size=2.5).depth
        32
    """

    depth: int
    height: int
    width: int
    voxel_size: float | None = None

    def __post_init__(self) -> None:
        if min(self.shape) < 1:
            raise ValueError(f"a volume of {self.shape} voxels is empty; give a positive thickness")

    @property
    def shape(self) -> tuple[int, int, int]:
        """(depth, height, width)."""
        return self.depth, self.height, self.width

    @classmethod
    def of(cls, tilt_series: TiltSeries, thickness: int | None = None) -> VolumeGrid:
        """A grid with one voxel per pixel: height and width of the images, depth `thickness` voxels (the width if None)."""
        _, height, width = tilt_series.images.shape
        if thickness is not None and thickness > 2 * max(height, width):
            raise ValueError(
                f"--thickness {thickness} is more than twice the images' {max(height, width)} pixels, too thick to stay in view "
                "when tilted; give it in voxels, which have the size of pixels"
            )
        return cls(width if thickness is None else thickness, height, width, tilt_series.pixel_size)


def central(volume: Any, width: int) -> Any:
    """The central `width` voxels along x of a volume, (z, y, x), array or tensor."""
    first = (volume.shape[2] - width) // 2
    return volume[:, :, first : first + width]


@dataclass(frozen=True)
class Volume:
    """A reconstruction.

    Attributes:
        attenuation: (z, y, x), attenuation per voxel, array or tensor.
        voxel_size: Å, or None if unknown.

    Example:
        >>> import numpy as np, recon
        >>> volume = recon.Volume(np.zeros((4, 6, 8)), voxel_size=10.0)
        >>> volume.attenuation.shape, volume.voxel_size
        ((4, 6, 8), 10.0)
    """

    attenuation: NDArray[np.float32]
    voxel_size: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "attenuation", io.as_array(self.attenuation))

    def __repr__(self) -> str:
        size = "unknown voxel size" if self.voxel_size is None else f"{self.voxel_size:.4g} Å per voxel"
        return f"Volume({size_of(self.attenuation)}, {size})"

    def levelled(self, x_tilt: float) -> Volume:
        """The volume of a specimen that is turned about x, turned back about its centre by cubic interpolation.

        Args:
            x_tilt: degrees; positive if z of a flat specimen rises with y, as IMOD's ``XAXISTILT``.
        """
        if not x_tilt:
            return self
        cosine, sine = np.cos(np.deg2rad(x_tilt)), np.sin(np.deg2rad(x_tilt))
        turn = np.array([[cosine, sine], [-sine, cosine]])  # (z, y) of the given volume from those of the level one
        middle = (np.array(self.attenuation.shape[:2]) - 1) / 2
        level = mapped.temporary_map(self.attenuation.shape, np.float32)
        for x in range(level.shape[2]):
            level[:, :, x] = scipy.ndimage.affine_transform(self.attenuation[:, :, x], turn, middle - turn @ middle)
        return Volume(level, self.voxel_size)

    @classmethod
    def read(cls, path: str | Path, *, mapped: bool = False) -> Volume:
        """Read a file, with the size of its voxels along x. Raises as `noiseflow.io.read`; ValueError if it is not a volume."""
        image = io.read(path, mapped=mapped)
        if image.data.ndim != 3:
            raise ValueError(f"{path} has shape {image.data.shape}; give a volume (z, y, x), with three axes")
        return cls(image.data, None if image.voxel_size is None else image.voxel_size[2])

    def write(self, path: str | Path) -> None:
        """Write to an MRC, TIFF, ``.npy`` or OME-Zarr file with the voxel size. Raises as `noiseflow.io.write`."""
        size = self.voxel_size
        io.write(path, self.attenuation, voxel_size=None if size is None else (size, size, size))


def evenly(tilts: NDArray[Any] | slice, count: int) -> NDArray[Any] | slice:
    """The same tilts as a slice if they are evenly spaced and ascending."""
    if isinstance(tilts, slice):
        return tilts
    numbers = np.arange(count)[tilts]
    steps = np.unique(np.diff(numbers))
    if len(numbers) < 2 or len(steps) != 1 or steps[0] < 1:
        return tilts
    return slice(int(numbers[0]), int(numbers[-1]) + 1, int(steps[0]))


def as_if_in_radians(tilt_angles: NDArray[np.float64]) -> bool:
    """Whether angles lie within ±90°, or span a half or a full turn in ten or more steps, only if they are in radians."""
    span, largest, steps = float(np.ptp(tilt_angles)), float(np.abs(tilt_angles).max()), 10
    turns = (turn - turn / steps < span and max(span, largest) < 1.01 * turn for turn in (np.pi, 2 * np.pi))
    return largest < 1.6 or (len(tilt_angles) >= steps and any(turns))
