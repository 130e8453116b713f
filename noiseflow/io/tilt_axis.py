"""Direction of the tilt axis in the images, from file metadata: degrees from y towards −x (IMOD's rotation angle)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from noiseflow.io.angles import candidates
from noiseflow.io.checks import text_lines
from noiseflow.io.image_file import ImageFile

_TITLE = re.compile(
    r"tilt\s*axis\s*(?:rotation\s*)?(?:angle)?\s*(?:\[[^\]]*\])?\s*[=:]\s*([-+]?\d+(?:\.\d*)?)", re.IGNORECASE
)
_ROTATION = re.compile(r"\s*RotationAngle\s*=\s*([-+]?\d+(?:\.\d*)?)")
_FIELD = re.compile(r"tilt.?axis.?(angle|rotation|orientation|direction)?[^/]*$", re.IGNORECASE)
_ROTATION_OF_Y_AXIS = 90.0
"""Degrees to add to SerialEM's RotationAngle, which refers to the other stage axis: its titles state an angle 90° smaller."""


def tilt_axis_of(stack: str | Path, image: ImageFile) -> float | None:
    """The tilt axis from the ``.mdoc`` next to a stack, from the stack itself, or from the microscope log next to it.

    Args:
        stack: the file the stack was read from.
        image: the image file that was read.

    Returns:
        Degrees, or None if no file states it.
    """
    files = candidates(stack)
    for file in files:
        if file.suffix.lower() == ".mdoc" and (found := _axis_in(file)) is not None:
            return found
    if image.tilt_axis is not None:
        return image.tilt_axis
    return next((found for file in files if (found := _axis_in(file.with_suffix(".txt"))) is not None), None)


def axis_in_titles(lines: Iterable[str]) -> float | None:
    """The angle in the first line of the form ``Tilt axis angle = 84.3``."""
    return next((float(found[1]) for line in lines if (found := _TITLE.search(line))), None)


def recorded_axis(leaves: Iterable[tuple[str, list[float]]]) -> float | None:
    """The first plausible number in metadata (name, numbers) under a name like ``Tilt axis angle``; zero means unset."""
    return next((v[0] for name, v in leaves if _FIELD.search(name) and len(v) == 1 and 0 < abs(v[0]) <= 360), None)


def _axis_in(file: Path) -> float | None:
    if not file.is_file():
        return None
    try:
        lines = text_lines(file, "log", holds="plain text")
    except (OSError, ValueError):  # an unrelated file of this name
        return None
    stated = axis_in_titles(lines)
    rotations = (float(found[1]) for line in lines if (found := _ROTATION.fullmatch(line.rstrip())))
    return stated if stated is not None else next((angle - _ROTATION_OF_Y_AXIS for angle in rotations), None)
