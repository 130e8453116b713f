"""Tilt angles from text files, from SerialEM's ``.mdoc`` files, and from the angle file next to a stack."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import ImageFile

RAW_FIRST = (".rawtlt", ".tlt")
REFINED_FIRST = (".tlt", ".rawtlt")
LARGEST_ANGLE = 720
"""Largest plausible tilt angle, degrees: two full turns, more than any stage reports."""


def read_angles(path: str | Path) -> NDArray[np.float64]:
    """Read tilt angles in degrees, in the order of the stack.

    Args:
        path: a text file with one angle per line (``.rawtlt``, ``.tlt``; blank lines are skipped), or an ``.mdoc`` file.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a line is not a number, or the file is empty.
    """
    path = Path(path)
    lines = text_lines(path, "angle file", holds="one angle in degrees per line")
    values = _mdoc_angles(lines, path) if path.suffix.lower() == ".mdoc" else _angle_lines(lines, path)
    if not values:
        raise ValueError(f"{path} holds no angles; one angle in degrees per line is required")
    return np.array(values)


def tilt_angles_of(stack: str | Path, image: ImageFile) -> NDArray[np.float64]:
    """The tilt angles of a stack, from the angle file next to it or else from the file itself.

    Args:
        stack: the file the stack was read from. For ``name.st``, the files ``name.rawtlt``, ``name.tlt``, ``name.st.mdoc``
            and ``name.mdoc`` are tried; for an aligned stack (``.ali``), the refined ``.tlt`` first. For a folder of images, a
            single such file inside the folder is used, too.
        image: the image file that was read.

    Returns:
        (section,) degrees.

    Raises:
        FileNotFoundError: there are no angles in either place.
        ValueError: the angle file cannot be read.
    """
    if (angle_file := angle_file_of(stack)) is not None:
        angles = read_angles(angle_file)
        _compare(angles, image.tilt_angles, angle_file, Path(stack))
        return angles
    if image.tilt_angles is not None:
        return image.tilt_angles
    names = ", ".join(candidate.name for candidate in _candidates(stack)[:2])
    raise FileNotFoundError(
        f"no tilt angles: {stack} holds none and there is no {names} or .mdoc next to it; give a file with --angles"
    )


def angle_file_of(stack: str | Path) -> Path | None:
    """The angle file that `tilt_angles_of` uses; None if there is none."""
    return next((candidate for candidate in _candidates(stack) if candidate.is_file()), None)


def _candidates(stack: str | Path) -> list[Path]:
    stack = Path(str(stack).partition("::")[0])
    if not stack.is_dir():
        return beside(stack)
    stack = stack.resolve()
    inside = [file for suffix in (*RAW_FIRST, ".mdoc") for file in stack.glob(f"*{suffix}")]
    return [*beside(stack), *(inside if len(inside) == 1 else [])]


def beside(stack: Path) -> list[Path]:
    """Possible angle files of a stack, most likely first."""
    refined = stack.suffix.lower() == ".ali" or stack.stem.endswith("_ali")
    stem = stack.with_name(stack.name.removesuffix(stack.suffix).removesuffix("_ali") + ".x")
    texts = [stem.with_suffix(suffix) for suffix in (REFINED_FIRST if refined else RAW_FIRST)]
    return [*texts, stack.with_name(stack.name + ".mdoc"), stem.with_suffix(".mdoc")]


def _compare(angles: NDArray[np.float64], inside: NDArray[np.float64] | None, angle_file: Path, stack: Path) -> None:
    if inside is None or len(inside) != len(angles) or np.abs(inside - angles).max() <= 2:
        return
    worst = int(np.abs(inside - angles).argmax())
    warnings.warn(
        f"{angle_file} says {angles[worst]:g}° for section {worst}, {stack} itself {inside[worst]:g}°; "
        "the angle file is used",
        stacklevel=3,
    )


def _angle_lines(lines: list[str], path: Path) -> list[float]:
    values = []
    for count, line in enumerate(lines, 1):
        if line.strip():
            try:
                values.append(number(line.strip()))
            except ValueError:
                raise ValueError(f"{path} line {count}: '{line.strip()[:40]}' is not an angle in degrees") from None
            if not abs(values[-1]) <= LARGEST_ANGLE:
                raise ValueError(
                    f"{path} line {count}: {line.strip()[:40]} is not a tilt angle; give degrees within ±{LARGEST_ANGLE}"
                )
    return values


def _mdoc_angles(lines: list[str], path: Path) -> list[float]:
    """``TiltAngle`` of every ``[ZValue = n]``, sorted by n: the order of the stack, not of acquisition."""
    found: dict[int, float] = {}
    section = None
    for line in lines:
        if header := re.fullmatch(r"\s*\[\s*ZValue\s*=\s*(\d+)\s*\]\s*", line):
            section = int(header[1])
        elif section is not None and (entry := re.fullmatch(r"\s*TiltAngle\s*=\s*(\S+)\s*", line)):
            found[section] = _angle_lines([entry[1]], path)[0]
    return [found[index] for index in sorted(found)]
