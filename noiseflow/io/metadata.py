"""Units in file formats, and tilt angles in the metadata of any file: as many numbers as sections, under a matching name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.tilt_table import LARGEST_ANGLE

_ANGLE_NAME = re.compile(
    r"stage.?angle|stage.?alpha|alpha.?tilt|tilt|theta|rotation.?angle|(^|[/.])angles?$", re.IGNORECASE
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
        leaves: (name, numbers); names that differ only in their digits, as in a list of sections, form one list.
        count: sections of the stack.
    """
    recorded: dict[str, list[float]] = {}
    for name, values in leaves:
        if _ANGLE_NAME.search(name):
            recorded.setdefault(re.sub(r"\d+", "#", name), []).extend(values)
    for values in recorded.values():
        plausible = len(values) == count and np.isfinite(values).all() and max(map(abs, values)) <= LARGEST_ANGLE
        if plausible and (count == 1 or np.ptp(values) > np.pi):  # otherwise radians, or a stage that did not move
            return np.array(values)
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
