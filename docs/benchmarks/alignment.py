"""Accuracy and time of the alignment, on simulated raw series and the raw needle.

Run as python docs/benchmarks/alignment.py [--data FOLDER].

Writes the table of docs/benchmarks/alignment.md. Times are processor seconds of one thread.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import affine_transform

from recon.series.alignment import Alignment
from recon.series.alignment_search import AxisUndetermined, find_alignment
from recon.series.tilt_series import TiltSeries, read_tilt_series
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series

PAGE = Path(__file__).with_suffix(".md")
START, END = "<!-- table -->", "<!-- end of table -->"
ANGLES = np.arange(-70, 71, 3.0)
Array = NDArray[np.float64]


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


def timed(series: TiltSeries, **options: float | None) -> tuple[Alignment | AxisUndetermined, float]:
    """The alignment, or the refusal, and the processor seconds it took."""
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return find_alignment(series, **options), time.process_time() - started
    except AxisUndetermined as refusal:
        return refusal, time.process_time() - started


def simulated(line: list[str], *, quick: bool) -> None:
    """A row for each scene."""
    line += [
        "| scene | size | noise | angles | axis error (°) | along (pixels rms) | across (pixels rms) | margin | CPU seconds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    scenes = [("shells", 64, 33.0), ("filaments", 64, -75.0), ("particles", 64, 118.0), ("slab", 64, 33.0)]
    for phantom, size, axis in scenes if quick else [*scenes, ("shells", 128, 10.0), ("particles", 256, -41.0)]:
        for noise in ("low-dose", "clipped"):
            for angle_error in (0.0, 0.05):
                raw = raw_series(phantom, size, axis, noise=noise, angle_error=angle_error, seed=1)
                found, seconds = timed(raw.series)
                start = f"| {phantom} | {size} | {noise} | {'true' if angle_error == 0 else f'{angle_error:.0%} off'} |"
                if isinstance(found, AxisUndetermined):
                    line.append(f"{start} asks for the axis | | | | {seconds:.0f} |")
                else:
                    turn, along, across = errors(raw, found)
                    margin = "–" if found.margin is None else f"{found.margin:.0f}"
                    line.append(f"{start} {turn:.2f} | {along:.2f} | {across:.2f} | {margin} | {seconds:.0f} |")
                print(line[-1], flush=True)


def needle(line: list[str], data: Path) -> None:
    """The raw needle without a hint, with a rough one, and with the microscope's log."""
    line += [
        "",
        "| raw needle, 77 × 256² | axis (°) | gaps explained | runner-up | margin | CPU seconds |",
        "|---|---|---|---|---|---|",
    ]
    logged = read_tilt_series(data / "tilt_needle_256" / "needle_256_raw.mrc", mode="linear")
    unknown = replace(logged, tilt_axis=None)
    for name, series, hint in (
        ("no hint", unknown, None),
        ("`--tilt-axis 90`", unknown, 90.0),
        ("its log", logged, None),
    ):
        found, seconds = timed(series, tilt_axis=hint)
        assert isinstance(found, Alignment)
        rival, residual = found.evidence[1], found.evidence[0].residual
        line.append(
            f"| {name} | {found.tilt_axis:.2f} | {1 - residual:.2%} | {rival.axis:.1f}°: {1 - rival.residual:.2%} | "
            f"{found.margin:.0f} | {seconds:.0f} |"
        )
        print(line[-1], flush=True)


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder with tilt_needle_256; without it, only simulated series")
    parser.add_argument("--quick", action="store_true", help="64 pixels only")
    given = parser.parse_args()
    torch.set_num_threads(1)
    line: list[str] = []
    simulated(line, quick=given.quick)
    if given.data is not None:
        needle(line, given.data)
    before, rest = PAGE.read_text(encoding="utf-8").split(START)
    PAGE.write_text(f"{before}{START}\n\n" + "\n".join(line) + f"\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
