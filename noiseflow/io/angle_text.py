"""Tilt angles in plain text: a list, or one column of a table, as people and programs write them."""

import math
import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import LARGEST_ANGLE, TiltTable

_COMMENT = re.compile(r"[#!%].*|//.*")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
_UNIT = re.compile(r"°|(?<![a-z_])deg(rees?)?(?!\w)", re.IGNORECASE)
_MARKS = re.compile(r"[\"'\[\](){}\x00-\x08\x1a]")
"""Quotes, brackets and the end mark of old text files."""
_TITLE = re.compile(r"(?!.*(axis|focus|astig|phase))(.*)(tilt|angle|theta|alpha|degree)", re.IGNORECASE)


def read(path: Path) -> TiltTable:
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
