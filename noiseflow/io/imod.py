"""IMOD's files: transforms (``.xf``), and the angle offset and excluded views of ``tilt.com``.

Source: https://bio3d.colorado.edu/imod/doc/man/tilt.html
"""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noiseflow.io import angle_text
from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import TiltTable

_COMMANDS = ("tilt.com", "tilta.com", "tiltb.com")
"""Command files of a series, and of the two of a dual-axis tomogram."""
_LISTS = ("EXCLUDE", "INCLUDE")
FLAT = 0.05
"""Degrees: a rotation, or a magnification in radians, that moves the edge of a 4096-pixel image by less than two pixels."""


def read(path: Path) -> TiltTable:
    """The angles of the ``TILTFILE`` next to the command file, with its offset and its excluded views.

    Raises:
        FileNotFoundError: a file does not exist.
        ValueError: the command file names no ``TILTFILE``, or a value is not a number.
    """
    entries = _entries(path)
    if "TILTFILE" not in entries:
        raise ValueError(f"{path} names no TILTFILE with the tilt angles; give that file with --angles")
    return _applied(angle_text.read(path.with_name(Path(entries["TILTFILE"]).name)), entries, path)


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
        return replace(table, x_tilt=x_tilt_of(angle_text.read(turned).angles, turned))
    return table


def _applied(table: TiltTable, entries: dict[str, str], path: Path) -> TiltTable:
    count, offset = len(table.angles), _value(entries, "OFFSET", path)
    # keywords that begin with a name, such as EXCLUDELIST and EXCLUDELIST2
    lists = (",".join(value for keyword, value in entries.items() if keyword.startswith(name)) for name in _LISTS)
    excluded, included = (parse_views(views, count, path) for views in lists)
    if included:
        excluded = sorted({*excluded, *range(count)} - {*included} | {*excluded})
    if excluded or offset:
        views = ", ".join(str(view + 1) for view in excluded[:12]) + (", …" if len(excluded) > 12 else "")
        parts = {f"adds {offset:g}° to the tilt angles": offset, f"excludes the views {views}": excluded}
        warnings.warn(f"{path} {' and '.join(text for text, there in parts.items() if there)}", stacklevel=5)
    turned = np.full(1, _value(entries, "XAXISTILT", path))
    if "XTILTFILE" in entries and (file := path.with_name(Path(entries["XTILTFILE"]).name)).is_file():
        turned = turned + angle_text.read(file).angles
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
