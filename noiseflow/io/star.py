"""Tables of tilts in STAR files: RELION's tilt series and Warp's ``.tomostar``.

Sources: https://relion.readthedocs.io (tilt-series metadata), https://warpem.github.io/warp
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import TiltTable, rotations
from noiseflow.io.imod import x_tilt_of

_ANGLES = ("rlnTomoYTilt", "rlnTomoNominalStageTiltAngle", "wrpAngleTilt")
_NAMES = ("rlnMicrographMovieName", "rlnMicrographName", "wrpMovieName")
_AXES = ("rlnTomoNominalTiltAxisAngle", "wrpAxisAngle")
_SIZES = ("rlnTomoTiltSeriesPixelSize", "rlnMicrographPixelSize", "rlnMicrographOriginalPixelSize")
_DOSES = ("rlnMicrographPreExposure", "wrpDose")
_ALIGNED = ("rlnTomoZRot", "rlnTomoXShiftAngst", "rlnTomoYShiftAngst")

_MISSING = {"nan", "<na>", "none", "null"}
_SECTION = re.compile(r"([0-9]{1,9})@")
Columns = dict[str, list[str]]


def read(path: Path) -> TiltTable:
    """The first table with tilt angles; an alignment of RELION becomes transforms in Å.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: no table has tilt angles, or a value is not a number.
    """
    tables = _tables(text_lines(path, "angle file", holds="a table of tilts"))
    tilted = ((table, angles) for table in tables if (angles := _numbers(table, _ANGLES, path)) is not None)
    table, angles = next(tilted, (None, None))
    if table is None or angles is None:
        raise ValueError(f"{path} holds no angles: no table has a column {', '.join(_ANGLES)}")
    sizes = next((found for each in (table, *tables) if (found := _numbers(each, _SIZES, path)) is not None), None)
    axes = _numbers(table, _AXES, path)
    size = None if sizes is None else float(sizes[0])
    turned = _numbers(table, ("rlnTomoXTilt",), path)
    names = next((table[name] for name in _NAMES if name in table), [])
    sections = [int(stated[1]) for name in names if (stated := _SECTION.match(name))]
    aligned = [_numbers(table, (name,), path) for name in _ALIGNED]
    axis, x, y = (np.asarray(column) for column in aligned)
    return TiltTable(
        angles,
        () if sections else tuple(names),
        np.array(sections, dtype=np.int64) - 1 if sections and len(sections) == len(names) else None,
        transforms=None if any(each is None for each in aligned) else rotations(axis, np.stack([x, y], 1)),
        in_angstrom=True,
        pixel_size=size,
        tilt_axis=None if axes is None else float(axes.mean()),
        x_tilt=0.0 if turned is None else x_tilt_of(turned, path),
        acquired=_numbers(table, _DOSES, path),
    )


def has_tilts(path: Path) -> bool:
    """Whether a file has a column of tilt angles."""
    try:
        return any(name in path.read_text(encoding="utf-8", errors="replace") for name in _ANGLES)
    except OSError:
        return False


def _numbers(table: Columns, names: Sequence[str], path: Path) -> NDArray[np.float64] | None:
    """The first of some columns, if possible one without missing values."""
    known = [name for name in names if name in table]
    if not known:
        return None
    name = next((name for name in known if not _MISSING & {text.lower() for text in table[name]}), known[0])
    try:
        return np.array([number(text) for text in table[name]], dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}, column {name}: {error}") from None


def _tables(lines: list[str]) -> list[Columns]:
    """Columns by name of every table: loops, and lists of single values."""
    tables: list[Columns] = []
    names: list[str] = []
    looped = False
    for line in map(str.strip, lines):
        if not line or line.startswith("#"):
            continue
        if line.startswith("data_") or line == "loop_":
            looped, names = line == "loop_", []
            tables.append({})
        elif line.startswith("_") and tables:
            name, *value = _split(line.partition(" #")[0])
            names.append(name[1:])
            tables[-1][name[1:]] = [] if looped else value
        elif looped:
            values = _split(line)
            if len(values) == len(names):
                for name, text in zip(names, values, strict=True):
                    tables[-1][name].append(text)
    return tables


def _split(line: str) -> list[str]:
    """Words, of which those with spaces are in quotes; a line with an open quotation is split at spaces."""
    try:
        return shlex.split(line)
    except ValueError:
        return line.split()
