"""Folders of single images or movies as one stack, in natural order, with the tilt angle of each file."""

import re
import warnings
from collections import Counter
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tifffile import natural_sorted

from noiseflow.io import angles
from noiseflow.io.image_file import PNG_SUFFIX, SUFFIXES, ImageFile, TiltTable

_NUMBER = re.compile(r"((?<![a-z])(?:(?:minus|neg|plus|pos)_?|[mnp])|[-+]*)(\d+(?:\.\d+)?)", re.IGNORECASE)
_ANGLE_WORD = re.compile(r"(tilt|angle|alpha|theta|deg)[\s_=]*$", re.IGNORECASE)


def read_folder(folder: Path, read: Callable[[Path], ImageFile]) -> ImageFile:
    """Stack the images of a folder. Files of other types than the most common one are ignored. Raises ValueError if there are
    fewer than two images, their sizes differ, or stacks cannot be movies of one tilt each. Movies (stacks of frames, one for each
    tilt) are summed if each has its own angle: an mdoc, or its name."""
    files = files_of(folder)
    if len(files) < 2:
        others = sorted({file.suffix for file in folder.iterdir() if file.suffix})
        held = f" (it holds {', '.join(others[:5])})" if others else ""
        found = f"with only one image, {files[0].name}" if files else f"without images that noiseflow reads{held}"
        raise ValueError(f"{folder} is a folder {found}; give an image file, or a folder of images")
    names = tuple(file.name for file in files)
    # what a file next to one image says of it
    beside = (next((one for one in angles.beside(f) if one.is_file() and one.suffix != ".star"), None) for f in files)
    tables = [None if own is None else angles.read_tilts(own) for own in beside]
    images = (read(file) for file in files)
    first = next(images)
    sections: list[NDArray[Any]] = []
    inside: list[float] = []
    frames: set[int] = set()
    for file, table, image in zip(files, tables, chain([first], images), strict=True):
        if image.data.ndim == 3 and len(image.data) > 1:
            _require_movie(file, image, table, folder, names)
            frames.add(len(image.data))
        section = _summed(image.data)
        if sections and section.shape != sections[0].shape:
            raise ValueError(
                f"{file} is {section.shape} and {names[0]} {sections[0].shape}; images of a folder must have the same size"
            )
        sections.append(section)
        told = image.tilt_angles if table is None else table.angles
        inside += [] if told is None or len(told) != 1 else list(told)
    if frames:
        counts = f"{min(frames)}" if len(frames) == 1 else f"{min(frames)} to {max(frames)}"
        warnings.warn(f"{folder} holds movies of {counts} frames, which are summed without an alignment", stacklevel=4)
    own = next((table for table in tables if table is not None), None)
    size, stated = None if own is None else own.pixel_size, first.voxel_size
    if size is not None and (stated is None or stated[2] == 1):  # 1 Å: programs write it where they know no size
        stated = size, size, size
    return ImageFile(
        np.stack(sections),
        stated,
        np.array(inside) if len(inside) == len(files) else angles_in_names(list(names)),
        first.tilt_axis,
        names=names,
    )


def _require_movie(file: Path, image: ImageFile, table: TiltTable | None, folder: Path, names: tuple[str, ...]) -> None:
    """Check that a stack in a folder is the movie of one tilt. Raises ValueError if it may be a tilt series, because its angle
    is not known by its name.
    """
    listed = angles.angle_file_of(folder)
    known = (
        angles_in_names(list(names)) is not None
        or (table is not None and len(table.angles) == 1)
        or (listed is not None and angles.names_images(listed, names))
    )
    if not known or (table is not None and len(table.angles) > 1):
        raise ValueError(
            f"{file} holds a stack of shape {image.data.shape}; a folder must hold single images, or movies that an mdoc or "
            "their names join to tilt angles: give the stack itself, or move it to another folder"
        )


def _summed(data: NDArray[Any]) -> NDArray[Any]:
    """One image: the sum of the frames of a movie, in the narrowest type that holds it."""
    if data.ndim == 2:
        return data
    if len(data) == 1:
        return np.asarray(data[0])
    if data.dtype.kind == "f":
        return np.asarray(data.sum(0, dtype=np.float64).astype(np.float32))
    total = data.sum(0, dtype=np.int64)
    return np.asarray(total.astype(np.result_type(np.min_scalar_type(total.min()), np.min_scalar_type(total.max()))))


def files_of(path: str | Path) -> list[Path]:
    """The files that `read` opens: images of the most common type in a folder, in natural order; all files of a ``.zarr``."""
    path = Path(str(path).partition("::")[0])
    if not path.is_dir():
        return [path]
    if path.suffix.lower() == ".zarr":
        return sorted(file for file in path.rglob("*") if file.is_file())
    plain = [f for f in path.iterdir() if f.is_file() and not f.name.startswith(".")]
    files = [f for f in plain if f.suffix.lower() in SUFFIXES] or [f for f in plain if f.suffix.lower() == PNG_SUFFIX]
    suffixes = Counter(file.suffix.lower() for file in files).most_common(1)
    return [path / name for name in natural_sorted(f.name for f in files if f.suffix.lower() == suffixes[0][0])]


def angles_in_names(names: list[str]) -> NDArray[np.float64] | None:
    """Tilt angles in file names, degrees, or None if there are none or they are ambiguous. A number in the name is taken as the
    angle if it has decimals or a sign in some names, or follows a word such as ``tilt``, and if it differs between names and is
    within ±180. A minus in front of all numbers is a hyphen. The letters or words ``m``, ``n``, ``neg`` and ``minus`` in front of
    some of the numbers are a minus."""
    rows = [list(_NUMBER.finditer(name.rsplit(".", 1)[0])) for name in names]
    if len(names) < 2 or len({len(row) for row in rows}) != 1:
        return None
    found = [values for column in zip(*rows, strict=True) if (values := _angle_column(list(column))) is not None]
    return found[0] if len(found) == 1 else None


def _angle_column(numbers: list[re.Match[str]]) -> NDArray[np.float64] | None:
    words = [number[1][:1].lower() for number in numbers]
    minus = {word in ("m", "n") for word in words} == {False, True} and not {"-", "+"} & set(words)
    letters = {"m": "-", "n": "-", "p": "+"} if minus else dict.fromkeys("mnp", "")
    signs = [letters.get(word, number[1]) for word, number in zip(words, numbers, strict=True)]
    hyphen = all(sign.startswith("-") for sign in signs)
    signs = [sign[1:] if hyphen else sign for sign in signs]
    named = all(_ANGLE_WORD.search(n.string[: n.start()]) for n in numbers)
    telling = any(signs) or any("." in number[2] for number in numbers)
    if not (named or telling) or any(len(sign) > 1 for sign in signs) or (hyphen and not any(signs)):
        return None
    values = np.array([(-1.0 if s == "-" else 1.0) * float(n[2]) for s, n in zip(signs, numbers, strict=True)])
    return values if len(np.unique(values)) == len(values) and np.abs(values).max() <= 180 else None
