"""Folders of single images as one stack, in natural order, with tilt angles from the file names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.image_file import SUFFIXES, ImageFile

_NUMBER = re.compile(r"([-+]*)(\d+(?:\.\d+)?)")
_ANGLE_WORD = re.compile(r"(tilt|angle|alpha|theta|deg)[\s_=]*$", re.IGNORECASE)


def read_folder(folder: Path, read: Callable[[Path], ImageFile]) -> ImageFile:
    """Stack the images of a folder. Files of other types than the most common one are ignored.

    Args:
        folder: the folder of images.
        read: function that reads one image.

    Raises:
        ValueError: there are fewer than two images, or their sizes differ.
    """
    files = files_of(folder)
    if len(files) < 2:
        found = f"with only one image, {files[0].name}" if files else "without images"
        raise ValueError(f"{folder} is a folder {found}; give an image file, or a folder of images")
    names = [file.name for file in files]
    images = [read(file) for file in files]
    sections: list[NDArray[Any]] = []
    for name, image in zip(names, images, strict=True):
        section = image.data[0] if image.data.ndim == 3 and len(image.data) == 1 else image.data
        if section.ndim != 2:
            raise ValueError(
                f"{folder / name} holds a stack of shape {image.data.shape}; a folder must hold single "
                "images: give the stack itself, or move it to another folder"
            )
        if sections and section.shape != sections[0].shape:
            raise ValueError(
                f"{folder / name} is {section.shape} and {names[0]} is {sections[0].shape} pixels; "
                "all images of a folder must have the same size"
            )
        sections.append(section)
    angles = [image.tilt_angles for image in images if image.tilt_angles is not None]
    inside = np.concatenate(angles) if len(angles) == len(images) else None
    return ImageFile(np.stack(sections), images[0].voxel_size, inside if inside is not None else angles_in_names(names))


def files_of(path: str | Path) -> list[Path]:
    """The files that `read` opens: images of the most common type in a folder, in natural order; all files of a ``.zarr``."""
    from tifffile import natural_sorted

    path = Path(str(path).partition("::")[0])
    if not path.is_dir():
        return [path]
    if path.suffix.lower() == ".zarr":
        return sorted(file for file in path.rglob("*") if file.is_file())
    files = [f for f in path.iterdir() if f.is_file() and f.suffix.lower() in SUFFIXES and not f.name.startswith(".")]
    suffixes = Counter(file.suffix.lower() for file in files).most_common(1)
    return [path / name for name in natural_sorted(f.name for f in files if f.suffix.lower() == suffixes[0][0])]


def angles_in_names(names: list[str]) -> NDArray[np.float64] | None:
    """Tilt angles in file names, degrees, or None if there are none or they are ambiguous.

    A number in the name is taken as the angle if it has decimals or a sign in some names, or follows a word such as
    ``tilt``, and if it differs between names and is within ±180. A minus in front of all numbers is a hyphen.
    """
    rows = [list(_NUMBER.finditer(name.rsplit(".", 1)[0])) for name in names]
    if len(names) < 2 or len({len(row) for row in rows}) != 1:
        return None
    found = [values for column in zip(*rows, strict=True) if (values := _angle_column(list(column))) is not None]
    return found[0] if len(found) == 1 else None


def _angle_column(numbers: list[re.Match[str]]) -> NDArray[np.float64] | None:
    signs = [number[1] for number in numbers]
    hyphen = all(sign.startswith("-") for sign in signs)
    signs = [sign[1:] if hyphen else sign for sign in signs]
    named = all(_ANGLE_WORD.search(n.string[: n.start()]) for n in numbers)
    telling = any(signs) or any("." in number[2] for number in numbers)
    if not (named or telling) or any(len(sign) > 1 for sign in signs):
        return None
    if hyphen and not any(signs):
        return None
    values = np.array([(-1.0 if s == "-" else 1.0) * float(n[2]) for s, n in zip(signs, numbers, strict=True)])
    return values if len(np.unique(values)) == len(values) and np.abs(values).max() <= 180 else None
