"""Numbers in the metadata of files: tilt angles, sizes and units, and the tilt axis, degrees from y towards −x as in IMOD."""

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.angles import candidates
from noiseflow.io.checks import text_lines
from noiseflow.io.image_file import LARGEST_ANGLE, ImageFile

_ANGLE_NAME = re.compile(
    r"stage.?a(ngle|lpha)|alpha.?tilt|tilt|theta|rotation.?angle|(^|[/.])(angles?|alpha)$", re.IGNORECASE
)
_DEGREES = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), 180 / np.pi),
    **dict.fromkeys(("mrad", "milliradian", "milliradians"), 0.18 / np.pi),
}
_ANGSTROM = {
    **dict.fromkeys(("å", "a", "angstrom", "angstroms", r"\u00c5", "ångström", "ångstrom"), 1.0),
    **dict.fromkeys(("pm", "picometer", "picometre"), 0.01),
    **dict.fromkeys(("nm", "nanometer", "nanometre"), 10.0),
    **dict.fromkeys(("µm", "μm", "um", "micron", "microns", "micrometer", "micrometre", r"\u00b5m", "µ", "μ"), 1e4),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e7),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 1e8),
    **dict.fromkeys(("inch", "in", '"'), 2.54e8),
    **dict.fromkeys(("m", "meter", "metre"), 1e10),
}


def in_angstrom(unit: object) -> float | None:
    """Å per unit, by its name or symbol; None if it is not a unit of length."""
    return _ANGSTROM.get(str(unit).strip().lower())


def in_degrees(unit: object) -> float | None:
    """Degrees per unit, by its name or symbol; None if it is not an angular unit."""
    return _DEGREES.get(str(unit).strip(" []").lower())


def recorded_angles(leaves: Iterable[tuple[str, list[float]]], count: int) -> NDArray[np.float64] | None:
    """The first list of `count` plausible tilt angles, degrees, under a name that refers to tilts.

    Args:
        leaves: (name, numbers); names that differ only in their digits, as in a list of sections, form one list. The last
            part of a name counts, because a group of tilts also holds doses and times.
    """
    recorded: dict[str, list[float]] = {}
    for name, values in leaves:
        alike = re.sub(r"\d+", "#", name)
        if _ANGLE_NAME.search(re.sub(r"(/#)+$", "", alike).rpartition("/")[2]):
            recorded.setdefault(alike, []).extend(values)
    for name, values in recorded.items():
        if len(values) == count and np.isfinite(values).all() and max(map(abs, values)) <= LARGEST_ANGLE:
            if count == 1 or np.ptp(values) > np.pi:  # otherwise radians, or a stage that did not move
                return np.array(values)
            if np.ptp(values) > 1:
                warnings.warn(
                    f"{name} seems to hold radians: give --angles FILE with degrees, or the unit rad", stacklevel=2
                )
    return None


def leaves_of(tree: Any, path: str = "") -> Iterator[tuple[str, list[float]]]:
    """(name, numbers) of every numeric leaf of a metadata tree."""
    if isinstance(tree, Mapping):
        for name, child in tree.items():
            yield from leaves_of(child, f"{path}/{name}")
    elif isinstance(tree, (int, float, list, tuple, np.ndarray, np.generic)):
        values = np.asarray(tree)
        if values.dtype.kind in "iuf":
            yield path, [float(value) for value in values.reshape(-1)]


_TITLE = re.compile(
    r"tilt\s*axis\s*(?:rotation\s*)?(?:angle)?\s*(?:\[[^\]]*\])?\s*[=:]\s*([-+]?\d+(?:\.\d*)?)", re.IGNORECASE
)
_ROTATION = re.compile(r"\s*RotationAngle\s*=\s*([-+]?\d+(?:\.\d*)?)")
_FIELD = re.compile(r"tilt.?axis.?(angle|rotation|orientation|direction)?[^/]*$", re.IGNORECASE)


def tilt_axis_of(stack: str | Path, image: ImageFile) -> float | None:
    """The tilt axis from the ``.mdoc`` next to a stack, from the stack itself, or from the microscope log next to it.

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


def _axis_in(file: Path, *, of_other_axis: float = 90.0) -> float | None:
    """The tilt axis that a log states; SerialEM's RotationAngle refers to the other stage axis: its titles state 90° less."""
    if not file.is_file():
        return None
    try:
        lines = text_lines(file, "log", holds="plain text")
    except (OSError, ValueError):  # an unrelated file of this name
        return None
    stated = axis_in_titles(lines)
    rotations = (float(found[1]) for line in lines if (found := _ROTATION.fullmatch(line.rstrip())))
    return stated if stated is not None else next((angle - of_other_axis for angle in rotations), None)
