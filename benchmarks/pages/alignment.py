"""Accuracy and time of the alignment, on simulated raw series and the raw needle.

    python -m benchmarks.pages.alignment run [--data FOLDER]    # rows not yet kept; FOLDER holds tilt_needle_256
    python -m benchmarks.pages.alignment page                   # tables and picture of alignment.md from the results

Times are processor seconds of one thread.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import affine_transform

from benchmarks.pages import FOLDER, dots
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results
from recon.series.alignment import Alignment
from recon.series.alignment_search import AxisUndetermined, find_alignment
from recon.series.files import read_tilt_series
from recon.series.tilt_series import TiltSeries
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series

PAGE = FOLDER / "alignment.md"
HINTS = "no hint", "`--tilt-axis 90`", "its log"
START, END = "<!-- table -->", "<!-- end of table -->"
ANGLES = np.arange(-70, 71, 3.0)
Array = NDArray[np.float64]
Row = dict[str, Any]
Scene = tuple[str, int, float, str, float]


@dataclass(frozen=True)
class Raw:
    """A simulated raw series: its axis (degrees), its shifts (tilt, (y, x)) in pixels, and the angles it was really taken at."""

    series: TiltSeries
    axis: float
    shifts: Array
    angles: Array


def raw_series(phantom: str, size: int, axis: float, *, noise: str, angle_error: float, seed: int) -> Raw:
    """A phantom turned by `axis`, images shifted by up to a tenth of their width, angles off by a factor of 1 + angle_error."""
    generator = np.random.default_rng(seed)
    angles = ANGLES if size < 256 else np.arange(-76, 77, 2.0)
    true = angles * (1 + angle_error)
    acquisition = ACQUISITIONS[noise]
    density = make_phantom(phantom, size, generator=np.random.default_rng(seed))
    clean, _ = clean_tilt_series(density, true, acquisition=acquisition)
    shifts = generator.uniform(-0.1, 0.1, (len(angles), 2)) * size
    theta, middle = math.radians(axis), np.full(2, (size - 1) / 2)
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    vacuum = float(np.quantile(clean.images, 0.02 if acquisition.mode == "linear" else 0.98))
    images = [
        affine_transform(image.astype(float), turn, middle - turn @ (middle + shift), cval=vacuum)
        for image, shift in zip(clean.images, shifts, strict=True)
    ]
    series = TiltSeries(np.maximum(np.array(images), 0).astype(np.float32), angles, None, acquisition.mode)
    assert acquisition.noise is not None
    return Raw(add_noise(series, acquisition.noise(), seed=seed), axis, shifts, true)


def errors(raw: Raw, found: Alignment) -> tuple[float, float, float]:
    """Degrees of the axis; rms pixels along and across it, without what only moves the object."""
    axis, theta = np.deg2rad(raw.axis), np.deg2rad(raw.angles)
    error = found.shifts - raw.shifts
    along, across = error @ [np.cos(axis), -np.sin(axis)], error @ [np.sin(axis), np.cos(axis)]
    moves = np.stack([np.cos(theta), np.sin(theta)], 1)
    across = across - moves @ np.linalg.lstsq(moves, across, rcond=None)[0]
    turn = (found.tilt_axis - raw.axis + 90) % 180 - 90
    return float(turn), float(along.std()), float(np.sqrt(np.mean(across**2)))


def timed(series: TiltSeries, tilt_axis: float | None = None) -> tuple[Alignment | AxisUndetermined, float]:
    """The alignment, or the refusal, and the processor seconds it took."""
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return find_alignment(series, tilt_axis=tilt_axis), time.process_time() - started
    except AxisUndetermined as refusal:
        return refusal, time.process_time() - started


def scenes() -> Iterator[tuple[str, Scene]]:
    """Name, and phantom, size, axis (degrees), noise and error of the angles of every simulated series."""
    turned = [("shells", 64, 33.0), ("filaments", 64, -75.0), ("particles", 64, 118.0), ("slab", 64, 33.0)]
    for phantom, size, axis in [*turned, ("shells", 128, 10.0), ("particles", 256, -41.0)]:
        for noise in ("low-dose", "clipped"):
            for angle_error in (0.0, 0.05):
                angles = "true" if angle_error == 0 else f"{angle_error:.0%} off"
                yield f"{phantom}, {size}², {noise}/{angles}", (phantom, size, axis, noise, angle_error)


def simulated(phantom: str, size: int, axis: float, noise: str, angle_error: float) -> Row:
    """Errors and time of one simulated series; time alone where it asks for the axis."""
    raw = raw_series(phantom, size, axis, noise=noise, angle_error=angle_error, seed=1)
    found, seconds = timed(raw.series)
    row: Row = {"seconds": seconds}
    if isinstance(found, Alignment):
        row |= dict(zip(("axis", "along", "across"), errors(raw, found), strict=True)) | {"margin": found.margin}
    return row


def needle(hint: str, data: Path) -> Row:
    """The raw needle without a hint, with a rough one, or with the microscope's log."""
    logged = read_tilt_series(data / "tilt_needle_256" / "needle_256_raw.mrc", mode="linear")
    series = logged if hint == "its log" else replace(logged, tilt_axis=None)
    found, seconds = timed(series, tilt_axis=90.0 if hint == "`--tilt-axis 90`" else None)
    assert isinstance(found, Alignment)
    best, rival = found.evidence[:2]
    return {
        "axis": found.tilt_axis,
        "explained": 1 - best.residual,
        "runner-up": [rival.axis, 1 - rival.residual],
        "margin": found.margin,
        "seconds": seconds,
    }


def tables(content: dict[str, Any]) -> str:
    """Picture, both tables, and where their figures come from."""
    rows, cells = [], content["cells"]
    for name, (phantom, size, _, noise, angle_error) in scenes():
        if name not in cells:
            continue
        row, angles = cells[name], "true" if angle_error == 0 else f"{angle_error:.0%} off"
        found = ["asks for the axis", "", "", ""]
        if "axis" in row:
            margin = "–" if row["margin"] is None else f"{row['margin']:.0f}"
            found = [*(f"{row[key]:.2f}" for key in ("axis", "along", "across")), margin]
        rows.append([phantom, f"{size}", noise, angles, *found, f"{row['seconds']:.0f}"])
    shifts = ["along (pixels rms)", "across (pixels rms)"]
    header = ["scene", "size", "noise", "angles", "axis error (°)", *shifts, "margin", "CPU seconds"]
    real = [
        [
            hint,
            f"{row['axis']:.2f}",
            f"{row['explained']:.2%}",
            f"{row['runner-up'][0]:.1f}°: {row['runner-up'][1]:.2%}",
            f"{row['margin']:.0f}",
            f"{row['seconds']:.0f}",
        ]
        for hint, row in ((hint, cells[f"needle/{hint}"]) for hint in HINTS if f"needle/{hint}" in cells)
    ]
    needle_header = ["raw needle, 77 × 256²", "axis (°)", "gaps explained", "runner-up", "margin", "CPU seconds"]
    picture = "![Error of the shifts across the axis, scene by scene, with true angles and with angles 5 % off](alignment.png)"
    return "\n\n".join([picture, table(header, rows), table(needle_header, real), measured_on([content])])


def panel(cells: dict[str, Row]) -> dots.Panel:
    """Errors across the axis, which are the larger ones, by the angles given."""
    series: dict[str, dict[str, float]] = {}
    for name, row in cells.items():
        if "across" in row:
            scene, angles = name.split("/")
            series.setdefault(f"angles {angles}", {})[scene] = row["across"]
    return "Shifts across the axis", "error (pixels rms)", series


def main() -> None:
    """Measure what is not kept yet, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--data", type=Path, help="folder with tilt_needle_256; without it, only simulated series")
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "alignment.json", help="JSON file")
    given = parser.parse_args()
    results = Results(given.out, "alignment")
    if given.part == "page":
        before, rest = PAGE.read_text(encoding="utf-8").split(START)
        text = "\n\n".join([before + START, tables(results.content), END + rest.split(END)[1]])
        dots.save(PAGE.with_suffix(".png"), [panel(results.cells)], columns=1)
        PAGE.write_text(text, encoding="utf-8")
        return
    torch.set_num_threads(1)
    if given.again:
        results.forget("")
    for name, scene in scenes():
        print(name, results.cell(name, partial(simulated, *scene)), flush=True)
    for hint in HINTS if given.data is not None else ():
        print(hint, results.cell(f"needle/{hint}", partial(needle, hint, given.data)), flush=True)


if __name__ == "__main__":
    main()
