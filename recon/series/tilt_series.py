"""Tilt series, voxel grids and volumes, validated on creation."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from noiseflow import io, statistics
from noiseflow.described import described, size_of
from noiseflow.io import mapped
from noiseflow.io.angles import advice_on_count
from noiseflow.io.mapped import is_mapped

Mode = Literal["transmission", "linear"]
_SAME_SIZE = 0.01
"""Relative difference of pixel sizes that rounding in headers explains."""
_TOUCHED = 0.01
"""Masked share of the area of a pixel that changes its value by less than the noise."""


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
        io.require_contrast(self.images, "the tilt series")
        _require_several_views(self.images)
        if self.axes is not None and np.shape(self.axes) != self.tilt_angles.shape:
            raise ValueError(f"axes needs one direction for each of the {len(self.images)} tilts")
        self._check_angles()

    def __repr__(self) -> str:
        size = "unknown pixel size" if self.pixel_size is None else f"{self.pixel_size:.4g} Å per pixel"
        shape = " x ".join(map(str, self.images.shape))
        low, high = self.tilt_angles.min(), self.tilt_angles.max()
        masked = "" if self.mask is None else f", {np.mean(~self.mask):.2%} masked"
        return f"TiltSeries({shape} {self.images.dtype}, {low:g}° to {high:g}°, {size}, {self.mode}{masked})"

    @property
    def num_tilts(self) -> int:
        """Number of tilts."""
        return len(self.images)

    @property
    def used(self) -> NDArray[np.bool_]:
        """(tilt, y, u), True for pixels to use."""
        return np.ones(self.images.shape, dtype=np.bool_) if self.mask is None else self.mask

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
        images, mask = _sections(self.images, tilts), None if self.mask is None else _sections(self.mask, tilts)
        beam = None if self.beam is None else self.beam[tilts]
        part = self.with_images(images, mask)
        object.__setattr__(part, "tilt_angles", self.tilt_angles[tilts])
        object.__setattr__(part, "beam", beam)
        object.__setattr__(part, "views", (np.arange(self.num_tilts) if self.views is None else self.views)[tilts])
        object.__setattr__(part, "num_views", self.num_views or self.num_tilts)
        object.__setattr__(part, "axes", None if self.axes is None else self.axes[tilts])
        object.__setattr__(part, "dose", None if self.dose is None else self.dose[tilts])
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
            _check_angles(self.tilt_angles[axes == axis])


def _sections(stack: NDArray[Any], chosen: NDArray[Any] | slice) -> NDArray[Any]:
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

        Example:
            >>> import numpy as np, recon
            >>> recon.Volume(np.ones((8, 8, 8), np.float32)).levelled(5.0).attenuation.shape
            (8, 8, 8)
        """
        from scipy.ndimage import affine_transform

        if not x_tilt:
            return self
        cosine, sine = np.cos(np.deg2rad(x_tilt)), np.sin(np.deg2rad(x_tilt))
        turn = np.array([[cosine, sine], [-sine, cosine]])  # (z, y) of the given volume from those of the level one
        middle = (np.array(self.attenuation.shape[:2]) - 1) / 2
        level = mapped.temporary_map(self.attenuation.shape, np.float32, in_memory=mapped.IN_MEMORY)
        for x in range(level.shape[2]):
            level[:, :, x] = affine_transform(self.attenuation[:, :, x], turn, middle - turn @ middle)
        return Volume(level, self.voxel_size)

    def write(self, path: str | Path) -> None:
        """Write to an MRC, TIFF, ``.npy`` or OME-Zarr file with the voxel size. Raises as `noiseflow.io.write`."""
        size = self.voxel_size
        io.write(path, self.attenuation, voxel_size=None if size is None else (size, size, size))


def read_tilt_series(
    path: str | Path,
    *,
    angles: str | Path | None = None,
    mode: Mode = "transmission",
    mask: NDArray[np.bool_] | str | Path | None = None,
    mask_nan: bool = False,
    mapped: bool = False,
    channel: str | int | None = None,
    pixel_size: float | None = None,
    exclude_views: str = "",
) -> TiltSeries:
    """Read a stack and its tilt angles. Flat and dark fields in the file are applied; a warning says so.

    Args:
        path: the stack, in any format that `noiseflow.io.read` supports.
        angles: a file that `noiseflow.io.read_tilts` reads; by default the ``.rawtlt``, ``.tlt`` or ``.mdoc`` next to the
            stack, or else the angles in the stack file. For the rules that join images and angles, see `noiseflow.io.tilts_of`.
        mode: image formation.
        mask: True for pixels to use, (tilt, y, u), or (y, u) for all tilts; or an image file or folder with 0 for the others,
            joined to the images by tilt angle if it has angles, else by order.
        mask_nan: mask NaN and infinite pixels instead of raising an error.
        mapped: memory-map the images, see `noiseflow.io.read`; not with a mask or NaNs.
        channel: name, or index from zero, of the channel of a hyperstack, or of the image of a file that holds several.
        pixel_size: Å, in place of that of the files.
        exclude_views: images to leave out, numbered from 1 in the order of the file as in IMOD, such as ``1,5-8``.

    Raises:
        noiseflow.io.SeveralImages: there are several channels and none was chosen; a ValueError with their names.
        FileNotFoundError: the file does not exist, or there are no angles in or next to the stack.
        ValueError: a file cannot be read, the mask does not match, or the stack is not a valid `TiltSeries`.

    Example:
        >>> import noiseflow, pathlib, recon
        >>> needle = pathlib.Path(noiseflow.__file__).parent / "data" / "tilt_needle" / "needle_aligned.mrc"
        >>> recon.read_tilt_series(needle, mode="linear").images.shape
        (91, 64, 64)
    """
    image_file = io.read(path, mapped=mapped, channel=channel)
    if image_file.data.ndim != 3:
        raise ValueError(
            f"{path} holds one image of shape {image_file.data.shape}; a tilt series (tilt, y, x) is required"
        )
    table, count = io.tilts_of(path, image_file, angles), len(image_file.data)
    height, width = _pixel_size(pixel_size, image_file, table, path) or (None, None)
    excluded = {*table.excluded, *io.parse_views(exclude_views, count, "--exclude-views")}
    views = np.setdiff1d(np.arange(count), sorted(excluded))
    if excluded and len(views) < 2:
        raise ValueError(f"{len(excluded)} of {count} views of {path} are excluded; a tilt series needs at least two")
    use = _mask_in(mask, table.angles) if isinstance(mask, str | Path) else mask
    if use is not None and use.shape == image_file.data.shape:
        use = use[views]
    images = _sections(image_file.data, evenly(views, count))
    images, use = _masked(flat_fielded(images, image_file, path), use, mask_nan, str(path))
    if height and width and abs(height / width - 1) > _SAME_SIZE:
        images, use = squared(images, use, height / width)
        warnings.warn(
            f"{path} has pixels of {width:.5g} x {height:.5g} Å (x, y), which are averaged to {max(height, width):.5g} Å; if the "
            "header is wrong, give the size with --pixel-size",
            stacklevel=2,
        )
    io.require_contrast(images, path)
    tilt_axis = io.tilt_axis_of(path, image_file)
    square = None if height is None or width is None else max(height, width)
    series = TiltSeries(
        images,
        table.angles[views],
        square,
        mode,
        use,
        tilt_axis=table.tilt_axis if tilt_axis is None else tilt_axis,
        views=views if excluded else None,
        num_views=count if excluded else None,
        dose=None if table.acquired is None else table.acquired[views],
        x_tilt=table.x_tilt,
    )
    empty = np.zeros(len(images), np.bool_) if use is None else ~use.any((1, 2))
    if not empty.any():
        return series
    named = ", ".join(f"{angle:g}°" for angle in series.tilt_angles[empty][:8])
    warnings.warn(f"{int(empty.sum())} tilts have no usable pixels and are excluded: {named}", stacklevel=2)
    return series.select(np.flatnonzero(~empty))


def _pixel_size(
    given: float | None, image: io.ImageFile, table: io.TiltTable, path: str | Path
) -> tuple[float, float] | None:
    """Å along y and x: as given, or as in the stack, or as in the file of angles. IMOD writes 1 Å where it knows no size.

    Raises:
        ValueError: the given size is not positive.
    """
    if given is not None:
        if not 0 < given < np.inf:
            raise ValueError(f"--pixel-size {given:g}: give a positive number of Å")
        return given, given
    if image.voxel_size is None:
        return None if table.pixel_size is None else (table.pixel_size, table.pixel_size)
    y, x = image.voxel_size[1:]
    if table.pixel_size is None or abs(table.pixel_size / x - 1) <= _SAME_SIZE or abs(y / x - 1) > _SAME_SIZE:
        return y, x
    chosen = table.pixel_size if x == 1 else x
    warnings.warn(
        f"{path} states pixels of {x:.5g} Å, and the file of its angles {table.pixel_size:.5g} Å; {chosen:.5g} Å are used: "
        "give --pixel-size if this is wrong",
        stacklevel=3,
    )
    return chosen, chosen


def flat_fielded(images: NDArray[Any], image_file: io.ImageFile, path: str | Path) -> NDArray[Any]:
    """Images with the flat and dark fields of their file applied: (image − dark) / (flat − dark); NaN where that is unknown.

    Args:
        images: (tilt, y, x), raw.
        image_file: the file with its fields; without them, the images are returned unchanged.
        path: its name, for the warning that says what was applied.
    """
    flat, dark = image_file.flat, image_file.dark
    if flat is None and dark is None:
        return images
    black = np.zeros(images.shape[1:]) if dark is None else dark
    scale = np.ones(images.shape[1:]) if flat is None else np.where(flat > black, flat - black, np.nan)
    names = [name for name, field in (("flat", flat), ("dark", dark)) if field is not None]
    warnings.warn(f"the {' and '.join(names)} fields of {path} are applied to its images", stacklevel=3)
    parts = (((image - black) / scale).astype(np.float32) for image in images)
    return mapped.mapped_copy(parts, images.shape, np.float32, in_memory=mapped.IN_MEMORY)


def _mask_in(path: str | Path, tilt_angles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The mask in a file, in the order of the tilts, or one for all of them."""
    file = io.read(path)
    io.require_finite(file.data, path)
    use: NDArray[np.bool_] = np.asarray(file.data != 0)
    if file.tilt_angles is not None and len(use) == len(tilt_angles):
        rows = io.angles.by_angle(file.tilt_angles, tilt_angles)
        return use if rows is None else use[rows]
    return use[0] if use.ndim == 3 and len(use) == 1 else use


def _masked(
    images: NDArray[Any], mask: NDArray[np.bool_] | None, mask_nan: bool, name: str
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Images whose unused pixels are replaced by the nearest used value, and the mask of used pixels."""
    if mask is None and all(np.isfinite(image).all() for image in images):
        return images, None
    if mask is not None and mask.shape not in (images.shape, images.shape[1:]):
        raise ValueError(f"the mask has shape {mask.shape}; {name} needs {images.shape}, or {images.shape[1:]} for all")
    wanted = np.broadcast_to(True if mask is None else mask, images.shape)
    use = mapped.temporary_map(images.shape, np.bool_, in_memory=mapped.IN_MEMORY)
    bad, first = 0, (0, 0, 0)
    for number, (image, part) in enumerate(zip(images, wanted, strict=True)):
        finite = np.isfinite(image)
        use[number] = part & finite
        wrong = part & ~finite
        if wrong.any() and not bad:
            row, column = np.argwhere(wrong)[0]
            first = (number, int(row), int(column))
        bad += int(wrong.sum())
    if bad and not mask_nan:
        raise ValueError(f"{name} has {bad} NaN or infinite pixels, the first at {first}; exclude them with --mask-nan")
    if use.all():
        warnings.warn(f"the mask of {name} excludes no pixel; pixels to exclude must be 0 in a mask file", stacklevel=3)
        return images, None
    if not use.any():
        raise ValueError(f"{name} has no usable pixels: all are masked, NaN or infinite")
    whole = (filled(image, part) for image, part in zip(images, use, strict=True))
    return mapped.mapped_copy(whole, images.shape, images.dtype, in_memory=mapped.IN_MEMORY), use


def filled(image: NDArray[Any], use: NDArray[np.bool_]) -> NDArray[Any]:
    """A (y, u) image whose unused pixels are replaced by the nearest used value; zero if there is none."""
    from scipy.ndimage import distance_transform_edt

    if use.all():
        return image
    if not use.any():
        return np.zeros_like(image)
    nearest = distance_transform_edt(~use, return_distances=False, return_indices=True)
    return np.asarray(image[tuple(nearest)])


def block_mean(image: NDArray[Any], down: int, across: int) -> NDArray[np.float32]:
    """Means of blocks of pixels of an image (y, u); incomplete blocks are dropped, evenly at both edges."""
    inner = image[image.shape[0] % down // 2 :, image.shape[1] % across // 2 :].astype(np.float64)
    return statistics.block_means(inner, down, across).astype(np.float32)


def squared(
    images: NDArray[Any], mask: NDArray[np.bool_] | None, ratio: float
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Images and their mask with square pixels of the larger edge; the centre stays in place.

    Pixels are averaged by the areas that they share with the new ones; whole numbers of integers are added, because sums of
    counts are counts. Pixels that a mask touches are masked.

    Args:
        images: (tilt, y, u).
        mask: of their shape, or None.
        ratio: height of a pixel over its width.
    """
    axis, factor = (2, ratio) if ratio > 1 else (1, 1 / ratio)
    factor = float(round(factor)) if abs(factor / round(factor) - 1) <= _SAME_SIZE else factor
    shared = _shared(images.shape[axis], factor)
    counts = factor.is_integer() and images.dtype.kind in "iu"
    kind = np.int32 if counts else np.float32
    shape = list(images.shape)
    shape[axis] = len(shared)
    weights = shared if counts else shared / factor

    def moved(stack: NDArray[Any], by: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        return (by @ image if axis == 1 else image @ by.T for image in stack)

    whole = mapped.mapped_copy(moved(images, weights), shape, kind, in_memory=mapped.IN_MEMORY)
    if mask is None:
        return whole, None
    used = (share > 1 - _TOUCHED for share in moved(mask, shared / factor))
    return whole, mapped.mapped_copy(used, shape, np.bool_, in_memory=mapped.IN_MEMORY)


def _shared(count: int, factor: float) -> NDArray[np.float64]:
    """(new, old) overlap of old pixels and of `factor` times larger ones around the same centre, in old pixels."""
    number = int(count / factor + 1e-9)
    start = (count - number * factor) / 2 + factor * np.arange(number)[:, None]
    left, right = np.maximum(start, np.arange(count)), np.minimum(start + factor, np.arange(count) + 1)
    overlap: NDArray[np.float64] = np.maximum(right - left, 0.0)
    return overlap


def write_tilt_series(path: str | Path, tilt_series: TiltSeries) -> Path:
    """Write the stack, and its angles to a ``.rawtlt`` file next to it. Return the path of the angle file.

    Example:
        >>> import numpy as np, pathlib, recon, tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> series = recon.TiltSeries(np.random.default_rng(0).random((3, 8, 8)), [-30.0, 0.0, 30.0], mode="linear")
        >>> _ = recon.write_tilt_series(folder / "tilts.mrc", series)
        >>> recon.read_tilt_series(folder / "tilts.mrc", mode="linear").tilt_angles.tolist()
        [-30.0, 0.0, 30.0]
    """
    path = Path(path)
    size = tilt_series.pixel_size
    io.write(path, tilt_series.images, voxel_size=None if size is None else (size, size, size), stack=True)
    return write_angles(path.with_suffix(".rawtlt"), tilt_series.tilt_angles)


def write_angles(path: Path, tilt_angles: NDArray[np.floating[Any]]) -> Path:
    """Write tilt angles, degrees, one per line, and return the path."""
    with io.atomic_path(path) as partial:
        partial.write_text("".join(f"{angle:.4f}\n" for angle in tilt_angles), encoding="utf-8")
    return path


def evenly(tilts: NDArray[Any] | slice, count: int) -> NDArray[Any] | slice:
    """The same tilts as a slice if they are evenly spaced and ascending."""
    if isinstance(tilts, slice):
        return tilts
    numbers = np.arange(count)[tilts]
    steps = np.unique(np.diff(numbers))
    if len(numbers) < 2 or len(steps) != 1 or steps[0] < 1:
        return tilts
    return slice(int(numbers[0]), int(numbers[-1]) + 1, int(steps[0]))


def _require_several_views(images: NDArray[Any]) -> None:
    shown = sum(bool(image.min() < image.max()) for image in images)
    if shown < 2 <= len(images):
        raise ValueError(
            f"{len(images) - shown} of {len(images)} images are constant; a tilt series needs at least two that "
            "are not: check that the right file was given"
        )


def _check_angles(angles: Sequence[float] | NDArray[np.float64]) -> None:
    largest = np.abs(angles).max()
    if largest > io.LARGEST_ANGLE:
        raise ValueError(f"a tilt angle of {largest:g}° is impossible; give degrees within ±{io.LARGEST_ANGLE}")
    values, counts = np.unique(np.round(angles, 6), return_counts=True)
    if len(values) < 2:
        raise ValueError(f"all {len(angles)} tilt angles are {values[0]:g}°; a tilt series needs different angles")
    if counts.max() > 1:
        repeated = ", ".join(f"{value:g}°" for value in values[counts > 1][:5])
        warnings.warn(
            f"some tilt angles occur more than once ({repeated}); each image is used as a separate view", stacklevel=5
        )
    span = float(np.ptp(angles))
    # ±90° is ±1.57 in radians; a half and a full turn lack at most one of ten or more steps
    if np.abs(angles).max() < 1.6 or 0.9 * np.pi < span < 1.01 * np.pi or 0.9 < span / (2 * np.pi) < 1.01:
        warnings.warn(
            f"the tilt angles span {span:.2f}, as if in radians; give them in degrees",
            stacklevel=5,
        )
