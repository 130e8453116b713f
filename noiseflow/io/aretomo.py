"""AreTomo's ``.aln`` files: tilt axis, shift and angle of every image.

Source: https://github.com/czimaginginstitute/AreTomo3 (``CSaveAlignFile.cpp``)
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from noiseflow.io.checks import number, text_lines
from noiseflow.io.image_file import MOST_SECTIONS, TiltTable, rotations
from noiseflow.io.imod import FLAT, x_tilt_of

_COLUMNS = ["SEC", "ROT", "GMAG", "TX", "TY", "SMEAN", "SFIT", "SCALE", "BASE", "TILT"]
_SIZE = re.compile(r"#\s*RawSize\s*=\s*(\d+)\s+(\d+)")
_DARK = re.compile(r"#\s*DarkFrame\s*=\s*\d+\s+(\d+)\s+(\S+)")
_BETA = re.compile(r"#\s*BetaOffset\s*=\s*([-+]?\d+\.?\d*)")
_LOCAL = re.compile(r"#\s*Local\s*Alignment", re.IGNORECASE)


def read(path: Path) -> TiltTable:
    """The global alignment; magnifications and local alignments are left out, with a warning. Dark frames are excluded.

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
        if len(values) != len(_COLUMNS) or not np.isfinite(values).all() or not 0 <= values[0] < MOST_SECTIONS:
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
