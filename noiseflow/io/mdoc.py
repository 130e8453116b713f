"""SerialEM's ``.mdoc`` files: of a stack, of single images and of movies.

Source: https://bio3d.colorado.edu/SerialEM/hlp/html/about_formats.htm
"""

from __future__ import annotations

import contextlib
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import MOST_SECTIONS, TiltTable

_SECTION = re.compile(r"\s*\[\s*(zvalue|frameset|image)\s*=\s*(.*?)\s*\]\s*", re.IGNORECASE)
_OTHER = re.compile(r"\s*\[\s*(?!t\s*=)\w+\s*=.*\]\s*", re.IGNORECASE)
"""Sections that are no images, such as those of montages; titles (``[T = …]``) belong to no section."""
_TIMES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%Y-%m-%d %H:%M:%S")
_ENTRY = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*")


def read(path: Path) -> TiltTable:
    """Angles, image files and pixel size; sections of a stack are sorted by ``ZValue``, the others stay in order.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a section has no angle although others have, or a value is not a number.
    """
    lines = text_lines(path, "angle file", holds="the sections of a series")
    common: dict[str, str] = {}
    sections: dict[tuple[float, int], dict[str, str]] = {}
    current = common
    for line in lines:
        if header := _SECTION.fullmatch(line):
            kind, value = header[1].lower(), header[2]
            place = _number(value, path) if kind == "zvalue" else 0.0
            current = {} if kind != "image" else {"imagefile": value}
            sections[place, 0 if kind == "zvalue" else len(sections)] = current
        elif _OTHER.fullmatch(line):
            current = {}
        elif entry := _ENTRY.fullmatch(line):
            current[entry[1].lower()] = entry[2]
    found = [sections[place] for place in sorted(sections)]
    told = [section for section in found if "tiltangle" in section]
    if told and len(told) < len(found):
        bare = next(count for count, section in enumerate(found) if "tiltangle" not in section)
        raise ValueError(f"{path}: section {bare} has no TiltAngle, although others have; complete the file")
    places = [place for place in sorted(sections) if "tiltangle" in sections[place]]
    stack = all(kind == 0 and place in range(MOST_SECTIONS) for place, kind in places)
    names = [section.get("subframepath") or section.get("imagefile") or "" for section in told]
    spacings = [value for each in (common, *told) if (value := each.get("pixelspacing"))]
    return TiltTable(
        np.array([_number(section["tiltangle"], path) for section in told], dtype=np.float64),
        tuple(names) if all(names) else (),
        np.array([int(place) for place, _ in places], dtype=np.int64) if stack and places else None,
        pixel_size=(_number(spacings[0], path) or None) if spacings else None,
        acquired=_acquired(told),
    )


def _acquired(sections: list[dict[str, str]]) -> NDArray[np.float64] | None:
    """The dose before each image, or else its time; None if a section has neither, or all are equal."""
    for name, read in (("priorrecorddose", number), ("datetime", _seconds)):
        try:
            found = np.array([read(section[name]) for section in sections], dtype=np.float64)
        except (KeyError, ValueError):
            continue
        if len(np.unique(found)) > 1:
            return found
    return None


def _seconds(text: str) -> float:
    for form in _TIMES:
        with contextlib.suppress(ValueError):
            return datetime.strptime(text.strip(), form).replace(tzinfo=UTC).timestamp()
    raise ValueError(text)


def _number(text: str, path: Path) -> float:
    try:
        return number(text.split()[0].rstrip("°").replace(",", "."))
    except (ValueError, IndexError):
        raise ValueError(f"{path}: '{text[:40]}' is not an angle in degrees, or not a number") from None
