"""IMOD's files: lists of tilt angles, as people and other programs write them too, the command file ``tilt.com``, and transforms.

Source: https://bio3d.colorado.edu/imod/doc/man/tilt.html
"""

import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, shortened, text_lines
from noiseflow.io.image_file import LARGEST_ANGLE, TiltTable

_COMMENT = re.compile(r"[#!%].*|//.*")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
_UNIT = re.compile(r"°|(?<![a-z_])deg(rees?)?(?!\w)", re.IGNORECASE)
_MARKS = re.compile(r"[\"'\[\](){}\x00-\x08\x1a]")
"""Quotes, brackets and the end mark of old text files."""
_TITLE = re.compile(r"(?!.*(axis|focus|astig|phase))(.*)(tilt|angle|theta|alpha|degree)", re.IGNORECASE)
_COMMANDS = ("tilt.com", "tilta.com", "tiltb.com")
"""Command files of a series, and of the two of a dual-axis tomogram."""
_LISTS = ("EXCLUDE", "INCLUDE")
FLAT = 0.05
"""Degrees: a rotation, or a magnification in radians, that moves the edge of a 4096-pixel image by less than two pixels."""


def read_list(path: Path) -> TiltTable:
    """Angles of a text file.

    Comments after ``#``, ``!``, ``%`` or ``//`` are skipped, and so are quotes, brackets, and titles, which are lines without
    digits at the start. Numbers are separated by spaces, tabs, semicolons or commas; a comma between two groups of digits is a
    decimal comma. A column of other words names the images. Of several columns of numbers, the one under a title such as ``tilt``
    is used, or the first one with negative numbers, or the first one that does not count the rows; a warning names it.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a word is not a number, the rows differ in length, or it is not clear which column holds the angles.
    """
    lines = [_COMMENT.sub("", line) for line in text_lines(path, "angle file", holds="one angle in degrees per line")]
    rows = [(count, words) for count, line in enumerate(lines, 1) if (words := _words(line))]
    start = next((place for place, (_, words) in enumerate(rows) if re.search(r"\d", " ".join(words))), 0)
    title, rows = rows[start - 1][1] if start else [], rows[start:]
    if len(rows) < 2:  # all angles in one line
        return TiltTable(_within([(count, word) for count, words in rows for word in words], path))
    first = len(rows[0][1])
    for count, words in rows:
        if len(words) != first:
            raise ValueError(f"{path} line {count} has {len(words)} numbers, not {first}; give one angle per line")
    named = next((k for k in range(first) if first > 1 and not any(_is_number(words[k]) for _, words in rows)), None)
    names = () if named is None else tuple(words[named] for _, words in rows)
    if named is not None:
        rows = [(count, words[:named] + words[named + 1 :]) for count, words in rows]
        title = title[:named] + title[named + 1 :] if len(title) == first else []
    table = np.array([[_angle(word, path, count) for word in words] for count, words in rows], dtype=np.float64)
    if table.shape[1] == 1 and _counts(np.trunc(table[:, 0])) and any("," in line for line in lines):
        raise ValueError(f"{path}: 'a,b' may be a decimal comma or two columns; write decimal points")
    column = _column(table, title, path) if table.shape[1] > 1 else 0
    return TiltTable(_within([(count, words[column]) for count, words in rows], path), names)


def _words(line: str) -> list[str]:
    line = _UNIT.sub(" ", _MARKS.sub(" ", line.replace("−", "-"))).strip()
    line = line.replace(",", " ") if re.search(r",\s", line) else line
    words: list[str] = []
    for word in filter(None, re.split(r"[\s;]+", line)):
        words += [word.replace(",", ".")] if _DECIMAL_COMMA.fullmatch(word) else filter(None, word.split(","))
    return words


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(number(word))
    except ValueError:
        return False


def _angle(word: str, path: Path, count: int) -> float:
    try:
        return number(word)
    except ValueError:
        raise ValueError(f"{path} line {count}: '{word[:40]}' is not an angle in degrees") from None


def _within(words: list[tuple[int, str]], path: Path) -> NDArray[np.float64]:
    values = [_angle(word, path, count) for count, word in words]
    for value, (count, word) in zip(values, words, strict=True):
        if not abs(value) <= LARGEST_ANGLE:
            raise ValueError(f"{path} line {count}: {word[:40]} is not a tilt angle, degrees within ±{LARGEST_ANGLE}")
    return np.array(values, dtype=np.float64)


def _counts(column: NDArray[np.float64]) -> bool:
    """Whether a column numbers the rows, from zero or one."""
    return len(column) > 1 and column[0] in (0, 1) and bool((np.diff(column) == 1).all())


def _column(table: NDArray[np.float64], title: list[str], path: Path) -> int:
    columns = list(range(table.shape[1]))
    titled = [k for k in columns if len(title) == len(columns) and _TITLE.match(title[k])]
    negative = [k for k in columns if (table[:, k] < 0).any()]
    counting = [k for k in columns if _counts(table[:, k])]
    if len(titled) == 1:
        return titled[0]
    if not negative and 0 in counting:
        raise ValueError(f"{path}: either of the first two of {len(columns)} columns may hold the angles; keep one")
    chosen = next(k for k in [*negative, *columns] if k not in counting or k in negative)
    low, high = table[:, chosen].min(), table[:, chosen].max()
    warnings.warn(
        f"{path} has {len(columns)} columns; the tilt angles are taken from column {chosen + 1}, {low:g}° to {high:g}°",
        stacklevel=6,
    )
    return chosen


def read_commands(path: Path) -> TiltTable:
    """The angles of the ``TILTFILE`` next to the command file, with its offset and its excluded views.

    Raises:
        FileNotFoundError: a file does not exist.
        ValueError: the command file names no ``TILTFILE``, or a value is not a number.
    """
    entries = _entries(path)
    if "TILTFILE" not in entries:
        raise ValueError(f"{path} names no TILTFILE with the tilt angles; give that file with --angles")
    return _applied(read_list(path.with_name(Path(entries["TILTFILE"]).name)), entries, path)


def adjusted(table: TiltTable, stack: Path, stem: str) -> TiltTable:
    """A table with what the ``tilt.com`` of a stack adds, if it lies next to it, and a warning that says so. Rotations of the
    specimen about x (``XAXISTILT``, ``.xtilt``) become the table's `x_tilt`, which levels the volume."""
    for path in (each for name in _COMMANDS if stack.is_file() and (each := stack.with_name(name)).is_file()):
        entries = _entries(path)
        # older files name the stack in a line of its own, without a keyword
        older = next((name for name in entries if name.endswith((".ALI", "_ALI.MRC"))), "")
        projections = entries.get("INPUTPROJECTIONS") or entries.get("INPUTFILE") or older
        if Path(projections).stem.lower().removesuffix("_ali") == stem.lower():
            return _applied(table, entries, path)
    turned = stack.with_name(f"{stem}.xtilt")
    if turned.is_file() and not stack.is_dir():
        return replace(table, x_tilt=x_tilt_of(read_list(turned).angles, turned))
    return table


def _applied(table: TiltTable, entries: dict[str, str], path: Path) -> TiltTable:
    count, offset = len(table.angles), _value(entries, "OFFSET", path)
    # keywords that begin with a name, such as EXCLUDELIST and EXCLUDELIST2
    lists = (",".join(value for keyword, value in entries.items() if keyword.startswith(name)) for name in _LISTS)
    excluded, included = (parse_views(views, count, path) for views in lists)
    if included:
        excluded = sorted({*excluded, *range(count)} - {*included} | {*excluded})
    if excluded or offset:
        views = shortened([str(view + 1) for view in excluded])
        parts = {f"adds {offset:g}° to the tilt angles": offset, f"excludes the views {views}": excluded}
        warnings.warn(f"{path} {' and '.join(text for text, there in parts.items() if there)}", stacklevel=5)
    turned = np.full(1, _value(entries, "XAXISTILT", path))
    if "XTILTFILE" in entries and (file := path.with_name(Path(entries["XTILTFILE"]).name)).is_file():
        turned = turned + read_list(file).angles
    rows = tuple(sorted({*table.excluded, *excluded}))
    return replace(table, angles=table.angles + offset, excluded=rows, x_tilt=x_tilt_of(turned, path))


def x_tilt_of(angles: NDArray[np.float64], path: Path) -> float:
    """The mean rotation of the specimen about x, degrees; a warning names it, and rotations that differ between views."""
    found = float(angles.mean()) if angles.size else 0.0
    varies = angles.size > 0 and float(np.ptp(angles)) > FLAT
    if abs(found) <= FLAT and not varies:
        return 0.0
    told = f"{path} turns the specimen by {found:.3g}° about x; the volume is levelled by as much"
    if varies:
        told += f"; its views differ by {np.ptp(angles):.2g}°, which is not modelled: they do not share one axis"
    warnings.warn(told, stacklevel=6)
    return found


def _value(entries: dict[str, str], name: str, path: Path) -> float:
    try:
        return number(entries.get(name, "0").replace(",", " ").split()[0])
    except (ValueError, IndexError):
        raise ValueError(f"{path}: {name} '{entries[name][:40]}' is not a number") from None


def _entries(path: Path) -> dict[str, str]:
    """Values by keyword in capitals; the last of a repeated keyword counts, as in IMOD, but lists of views are joined."""
    found: dict[str, str] = {}
    for line in text_lines(path, "command file", holds="keywords with values"):
        words = line.split("#")[0].split(None, 1)
        if words and not words[0].startswith("$"):
            name, value = words[0].upper(), words[1].strip() if len(words) > 1 else ""
            found[name] = f"{found[name]},{value}" if name.startswith(_LISTS) and name in found else value
    return found


def parse_views(text: str, count: int, source: object = "views") -> list[int]:
    """Indices of views given as in IMOD: numbers from 1, and ranges, such as ``1,5-8,30``.

    Raises:
        ValueError: the text is no such list, or a view does not exist.
    """
    found: set[int] = set()
    for part in filter(None, text.replace(",", " ").split()):
        first, _, last = part.partition("-")
        last = last or first
        numbers = first.isascii() and first.isdigit() and last.isascii() and last.isdigit()
        if not numbers or not 1 <= int(first) <= int(last) <= count:
            raise ValueError(f"{source}: '{part}' is no view from 1 to {count}, or range of them; write such as 1,5-8")
        found.update(range(int(first) - 1, int(last)))
    return sorted(found)


def read_transforms(path: str | Path) -> NDArray[np.float64]:
    """Read an IMOD ``.xf`` file.

    Args:
        path: text file, one line ``A11 A12 A21 A22 DX DY`` per section.

    Returns:
        (section, 2, 3): the matrix A and the shift in pixels, in the order (x, y) of IMOD.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a line does not hold six numbers, a matrix is not invertible, or the file is empty.
    """
    path = Path(path)
    rows = []
    for count, line in enumerate(text_lines(path, "alignment file", holds="six numbers per line"), 1):
        if not line.strip():
            continue
        try:
            a11, a12, a21, a22, dx, dy = map(number, line.split())
        except ValueError:
            raise ValueError(f"{path} line {count}: six numbers A11 A12 A21 A22 DX DY are needed") from None
        row = np.array([[a11, a12, dx], [a21, a22, dy]])
        if not np.isfinite(row).all() or abs(np.linalg.det(row[:, :2])) < 1e-6:
            raise ValueError(f"{path} line {count}: this transform is not invertible; check the alignment file")
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} holds no transforms; one line of six numbers per section is required")
    return np.stack(rows)
