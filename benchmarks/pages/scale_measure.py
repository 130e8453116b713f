"""One row of the scale benchmark: a command in a process of its own, what it took, and how good its volume is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow import io
from recon.scale.blocks import HALO, blocks

_MIDDLE = 64
_NEAR = 8  # slices on either side of a border that say how much the volume jumps elsewhere
Array = NDArray[Any]


def run(*words: str | Path | int, threads: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run a command of noiseflow.

    Returns:
        Seconds, processor seconds and peak memory (GiB) of the process, and what it said. The system counts the peak of this
        process as one of its child's, so that it has to be small.

    Raises:
        RuntimeError: it failed; the message is the last line that it wrote.
    """
    command = [sys.executable, "-m", "noiseflow", *map(str, words), "--json"]
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as told:
        started = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=said, stderr=told, env=os.environ | {"OMP_NUM_THREADS": str(threads)}
        )
        _, status, usage = os.wait4(process.pid, 0)  # which alone tells of this child and no other
        seconds = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        for stream in (said, told):
            stream.seek(0)
        if process.returncode:
            lines = told.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"exit {process.returncode}: {lines[-1] if lines else 'without a word'}")
        answer = json.loads(said.read().decode().strip().splitlines()[-1])
    unit = 1 if sys.platform == "darwin" else 1024
    figures = {"seconds": seconds, "processor seconds": usage.ru_utime + usage.ru_stime}
    return figures | {"peak GiB": usage.ru_maxrss * unit / 2**30}, answer


def mapped(path: Path) -> Array:
    """A volume (z, y, x), left in its file."""
    return io.read(path, mapped=True).data


def psnr(found: Array, truth: Array, *, rows: slice = slice(None)) -> float:
    """PSNR (dB) of a volume's rows over the range of the whole truth, without any rescaling, section by section."""
    total = sum(float(np.sum((a[rows].astype(np.float64) - b[rows]) ** 2)) for a, b in zip(found, truth, strict=True))
    span = max(float(section.max()) for section in truth) - min(float(section.min()) for section in truth)
    return float(-10 * np.log10(total / truth[:, rows].size / span**2))


def middle_rows(height: int) -> slice:
    """The slices that an oracle is judged on: 64 in the middle, or all of fewer."""
    start = max(0, (height - _MIDDLE) // 2)
    return slice(start, min(height, start + _MIDDLE))


def seams(found: Array, truth: Array, slices_at_once: int | None) -> dict[str, Any]:
    """How much a volume jumps across the borders of its blocks, relative to neighbouring slices inside; and the truth there.

    Where the truth is empty on both sides, neighbouring slices differ by rounding, and a ratio to that says nothing: such borders
    are compared with neighbouring slices of the specimen.

    Returns:
        Blocks; the ratios of mean absolute differences that are largest over the borders within the specimen (None where there
        is no border); the largest difference at a border in vacuum, over the median of neighbouring slices at the others (None
        where there is no such border); and of every border its place with the difference there and the usual one beside it, of
        volume and of truth.
    """
    borders = _borders(found.shape[1], slices_at_once)
    jumps = [(border, *_jump(found, border), *_jump(truth, border)) for border in borders]
    inside = [jump for jump in jumps if any(jump[3:])]
    vacuum = [at for _, at, _, *true in jumps if not any(true)]
    none = 1.0 if borders else None  # a series of vacuum alone jumps nowhere
    usual = float(np.median([beside for _, _, beside, *_ in inside])) if inside else 0.0
    return {
        "blocks": 1 + len(borders),
        "seam": max((_ratio(at, beside) for _, at, beside, *_ in inside), default=none),
        "seam of the truth": max((_ratio(*true) for _, _, _, *true in inside), default=none),
        "seam in vacuum": max(vacuum) / usual if vacuum and usual else None,
        "jumps": [list(jump) for jump in jumps],
    }


def seams_beside(found: Array, other: Array, truth: Array, slices_at_once: int) -> float:
    """How much more a volume jumps across the borders of its blocks within the specimen than another of the same series jumps
    there that has no border so near: the largest quotient of the two ratios of `seams`; one where blocks leave no trace."""
    borders = [border for border in _borders(found.shape[1], slices_at_once) if any(_jump(truth, border))]
    return max(_ratio(*_jump(found, border)) / _ratio(*_jump(other, border)) for border in borders)


def _borders(height: int, slices_at_once: int | None) -> list[int]:
    parts = [] if slices_at_once is None else blocks(height, slices_at_once, HALO)
    return [part.rows.start - 1 for part in parts[1:]]


def _jump(array: Array, border: int) -> tuple[float, float]:
    """Mean absolute difference of the two slices at a border, and the median of those of the slices near it."""
    first, stop = max(0, border - _NEAR), min(array.shape[1], border + _NEAR + 2)
    total = np.zeros(stop - first - 1)
    for section in array[:, first:stop]:  # section by section: a slab of a large volume lies all over the file
        total += np.abs(np.diff(section, axis=0)).mean(1)
    total /= len(array)
    return float(total[border - first]), float(np.median(np.delete(total, border - first)))


def _ratio(at: float, beside: float) -> float:
    return at / beside if beside else 1.0
