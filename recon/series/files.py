"""Tilt series in files: the stack, its angles, its mask, and the flat and dark fields that belong to it."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from noiseflow.io import mapped
from recon.series.masks import filled, squared
from recon.series.tilt_series import Mode, TiltSeries, evenly, sections
from recon.series.views import HARMLESS, angles_in_words


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
    if len(views) < 2:
        raise ValueError(f"{path}: {len(views)} of {count} views are in use; a tilt series needs at least two tilts")
    use = _mask_in(mask, table.angles) if isinstance(mask, str | Path) else mask
    if use is not None and use.shape == image_file.data.shape:
        use = use[views]
    images = sections(image_file.data, evenly(views, count))
    images, use = _masked(flat_fielded(images, image_file, path), use, mask_nan, str(path))
    if height and width and abs(height / width - 1) > HARMLESS["pixel size"]:
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
    named = angles_in_words(series.tilt_angles[empty])
    warnings.warn(f"{int(empty.sum())} tilts have no usable pixels and are excluded: {named}", stacklevel=2)
    return series.select(np.flatnonzero(~empty))


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


def _pixel_size(
    given: float | None, image: io.ImageFile, table: io.TiltTable, path: str | Path
) -> tuple[float, float] | None:
    """Å along y and x: as given, or as in the stack, or as in the file of angles. IMOD writes 1 Å where it knows no size.
    Raises ValueError if the given size is not positive."""
    if given is not None:
        if not 0 < given < np.inf:
            raise ValueError(f"--pixel-size {given:g}: give a positive number of Å")
        return given, given
    if image.voxel_size is None:
        return None if table.pixel_size is None else (table.pixel_size, table.pixel_size)
    y, x = image.voxel_size[1:]
    near = HARMLESS["pixel size"]
    if table.pixel_size is None or abs(table.pixel_size / x - 1) <= near or abs(y / x - 1) > near:
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
    return mapped.mapped_copy(parts, images.shape, np.float32)


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
    use = mapped.temporary_map(images.shape, np.bool_)
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
    return mapped.mapped_copy(map(filled, images, use), images.shape, images.dtype), use
