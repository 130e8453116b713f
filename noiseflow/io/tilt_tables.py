"""Tables of tilts of other programs: SerialEM's ``.mdoc``, STAR files of RELION and Warp (``.tomostar``), AreTomo's ``.aln``.

Sources: https://bio3d.colorado.edu/SerialEM/hlp/html/about_formats.htm (stacks, single images and movies),
https://relion.readthedocs.io (tilt-series metadata), https://warpem.github.io/warp, and
https://github.com/czimaginginstitute/AreTomo3 (``CSaveAlignFile.cpp``: tilt axis, shift and angle of every image)
"""

import contextlib
import re
import shlex
import sys
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import TiltTable, rotations
from noiseflow.io.imod import FLAT, x_tilt_of

_SECTION = re.compile(r"\s*\[\s*(zvalue|frameset|image)\s*=\s*(.*?)\s*\]\s*", re.IGNORECASE)
_OTHER = re.compile(r"\s*\[\s*(?!t\s*=)\w+\s*=.*\]\s*", re.IGNORECASE)
"""Sections that are no images, such as those of montages; titles (``[T = …]``) belong to no section."""
_TIMES = ("%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%Y-%m-%d %H:%M:%S")
_ENTRY = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*")


def read_mdoc(path: Path) -> TiltTable:
    """Angles, image files and pixel size of an ``.mdoc``; sections of a stack are sorted by ``ZValue``, the others stay in order.

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
    stack = all(kind == 0 and place.is_integer() and 0 <= place < sys.maxsize for place, kind in places)
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


_ANGLES = ("rlnTomoYTilt", "rlnTomoNominalStageTiltAngle", "wrpAngleTilt")
_NAMES = ("rlnMicrographMovieName", "rlnMicrographName", "wrpMovieName")
_AXES = ("rlnTomoNominalTiltAxisAngle", "wrpAxisAngle")
_SIZES = ("rlnTomoTiltSeriesPixelSize", "rlnMicrographPixelSize", "rlnMicrographOriginalPixelSize")
_DOSES = ("rlnMicrographPreExposure", "wrpDose")
_ALIGNED = ("rlnTomoZRot", "rlnTomoXShiftAngst", "rlnTomoYShiftAngst")

_MISSING = {"nan", "<na>", "none", "null"}
_IN_STACK = re.compile(r"([0-9]{1,9})@")
Columns = dict[str, list[str]]


def read_star(path: Path) -> TiltTable:
    """The first table of a STAR file with tilt angles; an alignment of RELION becomes transforms in Å.

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
    sections = [int(stated[1]) for name in names if (stated := _IN_STACK.match(name))]
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
        elif looped and len(values := _split(line)) == len(names):
            for name, text in zip(names, values, strict=True):
                tables[-1][name].append(text)
    return tables


def _split(line: str) -> list[str]:
    """Words, of which those with spaces are in quotes; a line with an open quotation is split at spaces."""
    try:
        return shlex.split(line)
    except ValueError:
        return line.split()


_COLUMNS = ["SEC", "ROT", "GMAG", "TX", "TY", "SMEAN", "SFIT", "SCALE", "BASE", "TILT"]
_SIZE = re.compile(r"#\s*RawSize\s*=\s*(\d+)\s+(\d+)")
_DARK = re.compile(r"#\s*DarkFrame\s*=\s*\d+\s+(\d+)\s+(\S+)")
_BETA = re.compile(r"#\s*BetaOffset\s*=\s*([-+]?\d+\.?\d*)")
_LOCAL = re.compile(r"#\s*Local\s*Alignment", re.IGNORECASE)


def read_aln(path: Path) -> TiltTable:
    """The global alignment of an ``.aln``; magnifications and local alignments are left out, with a warning; dark frames, too.

    The axis ROT and the shift (TX, TY) lead from aligned to raw images; the pixels are those of the raw stack. SEC numbers its
    sections from 0, or from 1 in AreTomo3. TILT includes ``AlphaOffset``; ``BetaOffset`` turns the specimen about x.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a row is not ten numbers.
    """
    rows, dark, shape = list[list[float]](), list[list[float]](), None
    local, beta, begun = False, 0.0, False
    for count, line in enumerate(text_lines(path, "alignment file", holds="the table of AreTomo"), 1):
        local = local or _LOCAL.match(line) is not None
        begun = begun or line.startswith("#")  # AreTomo3 may write a word first
        if size := _SIZE.match(line):
            shape = (int(size[2]), int(size[1]))
        if offset := _BETA.match(line):
            beta = float(offset[1])
        found = _DARK.match(line)
        words = [found[1], *["0"] * (len(_COLUMNS) - 2), found[2]] if found else line.partition("#")[0].split()
        if local or not words or not begun:
            continue
        try:
            values = [number(word) for word in words]
        except ValueError:
            values = []
        if len(values) != len(_COLUMNS) or not np.isfinite(values).all() or not 0 <= values[0] < sys.maxsize:
            raise ValueError(f"{path} line {count}: ten numbers {' '.join(_COLUMNS)} are needed")
        (dark if found else rows).append(values)
    table = np.array([*rows, *dark], dtype=np.float64).reshape(-1, len(_COLUMNS))
    kept = table[: len(rows)]
    if local or np.abs(kept[:, 2] - 1).max(initial=0.0) > np.deg2rad(FLAT):
        warnings.warn(f"the magnifications and local alignments of {path} are not applied", stacklevel=4)
    first = int(table[:, 0].min(initial=1))
    return TiltTable(
        table[:, 9],
        sections=table[:, 0].astype(np.int64) - (1 if first == 1 else 0),
        transforms=rotations(table[:, 1], table[:, 3:5]),
        image_shape=shape,
        tilt_axis=float(kept[:, 1].mean()) if len(kept) else None,
        excluded=tuple(range(len(rows), len(table))),
        x_tilt=x_tilt_of(np.array([beta]), path),
    )
