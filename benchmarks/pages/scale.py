"""Time, memory and accuracy over size: every row is the command that a user would run, in a process of its own.

    python -m benchmarks.pages.scale run                      # all rows but the largest; those already there are kept
    python -m benchmarks.pages.scale run --row shells-512 --row shells-1000
    python -m benchmarks.pages.scale run --threads 2 --cache /data/scale --out FILE
    python -m benchmarks.pages.scale page                     # scale.md, its figure, and scale_estimates.md from the JSON

Peak memory is the largest resident set of the process that the operating system saw, pages of mapped files included. Simulated
series stay in the cache folder, and are made slab by slab; volumes are removed when they are judged. Results go to
results/scale.json in docs/benchmarks, with commit, date, machine and its load for every row.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.external import astra_sirt
from benchmarks.pages import FOLDER, scale_page
from benchmarks.pages.scale_measure import mapped, middle_rows, psnr, run, seams, seams_beside
from benchmarks.scenes import Results
from benchmarks.search import best_fit
from noiseflow.commands.console import Output
from recon.joint.joint import JointReconstructor
from recon.metrics.metrics import fourier_shell_correlation, resolution
from recon.names import REGULARISERS
from recon.scale.blocks import HALO
from recon.series.files import read_tilt_series
from recon.series.tilt_series import VolumeGrid
from recon.simulate.simulation import ACQUISITIONS

RESULTS = FOLDER / "results" / "scale.json"
_ASTRA = 8  # slices: each costs as much as another
TILTS = "-59.5:57.5:1.5"  # 79
Cell = dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A reconstruction to measure.

    Attributes:
        phantom, size: of the scene.
        options: of ``noiseflow reconstruct``.
        threads: of the process; None takes those of ``--threads``.
        beside: options of a second reconstruction, whose borders of blocks lie elsewhere: its jumps are those without a border.
        oracle: whether, in place of the command, a fit that knows the true noise is searched for its best weight.
        astra: whether, in place of the command, ASTRA's SIRT reconstructs a few slices; every slice costs it the same.
    """

    phantom: str
    size: int
    options: tuple[str, ...] = ()
    threads: int | None = None
    beside: tuple[str, ...] | None = None
    oracle: bool = False
    astra: bool = False


ROWS = {
    **{f"shells-{size}": Row("shells", size) for size in (64, 128, 192, 256, 512)},
    "start-512": Row("shells", 512, ("--steps", "1")),
    "tv-512": Row("shells", 512, ("--regulariser", "total-variation")),
    "slab-512": Row("slab", 512),
    "sirt-512": Row("shells", 512, ("--method", "sirt")),
    "l2-512": Row("shells", 512, ("--method", "l2")),
}
LARGE = {
    "shells-1000": Row("shells", 1000),
    "blocks-128": Row("shells", 128, ("--slices-at-once", "32")),
    "blocks-256": Row("shells", 256, ("--slices-at-once", "64")),
    "slab-128": Row("slab", 128),
    "slab-blocks-128": Row("slab", 128, ("--slices-at-once", "32")),
    "borders-256": Row("shells", 256, ("--slices-at-once", "64"), beside=("--slices-at-once", "256")),
    "borders-512": Row("shells", 512, beside=("--slices-at-once", "48")),
    "borders-slab-256": Row("slab", 256, ("--slices-at-once", "64"), beside=("--slices-at-once", "256")),
    "borders-slab-512": Row("slab", 512, beside=("--slices-at-once", "48")),
    "oracle-512": Row("shells", 512, oracle=True),
    "astra-512": Row("shells", 512, astra=True),
    "processes-1": Row("shells", 256, ("--slices-at-once", "64"), threads=2),
    "processes-2": Row("shells", 256, ("--slices-at-once", "64", "--workers", "2")),
}
"""Rows that run where they are named alone."""


def main() -> None:
    """Run the chosen rows, save each, or draw the page."""
    every = ROWS | LARGE
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--row", action="append", choices=every, help="by default all but " + ", ".join(LARGE))
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)), help="all cores by default")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "noiseflow-scale")
    parser.add_argument("--out", type=Path, default=RESULTS, help="JSON file; by default the one of the page")
    options = parser.parse_args()
    results, output = Results(options.out, "scale"), Output(json_mode=False)
    if options.part == "page":
        scale_page.write(results.content)
        return
    options.cache.mkdir(parents=True, exist_ok=True)

    def cell(key: str, compute: Callable[[], Cell]) -> Cell:
        if options.again:
            results.cells.pop(key, None)
        return results.cell(key, compute)

    failed = []
    for name in options.row or ROWS:
        row = every[name]
        try:
            folder = scene(row, options.cache, options.threads, results)
            threads = options.threads if row.threads is None else row.threads
            found = cell(f"scale/{name}", partial(measure, row, folder, threads))
        except RuntimeError as error:  # the rows that follow do not depend on this one
            failed.append(f"{name}: {error}")
            continue
        output.line(scale_page.in_words(name, found))
    if failed:
        raise ValueError("; ".join(failed))


def scene(row: Row, cache: Path, threads: int, results: Results) -> Path:
    """The folder of a simulated series, made where it is not there; what that took is a row, too."""
    name = f"{row.phantom}-{row.size}"
    folder = cache / name
    if not (folder / "tilts.mrc").is_file():
        words = ("simulate", folder, "--phantom", row.phantom, "--size", row.size, "--noise", "clipped")
        results.cells.pop(f"simulate/{name}", None)
        results.cell(
            f"simulate/{name}", lambda: run(*words, f"--tilts={TILTS}", threads=threads)[0] | {"size": row.size}
        )
    return folder


def measure(row: Row, folder: Path, threads: int) -> Cell:
    """Reconstruct, and judge the volume."""
    truth = mapped(folder / "truth.mrc")
    about = {"phantom": row.phantom, "size": row.size, "options": list(row.options), "threads": threads}
    if row.oracle:
        return about | of_oracle(folder, truth, threads)
    if row.astra:
        return about | of_astra(folder, truth)
    with tempfile.TemporaryDirectory(prefix="volume-", dir=folder) as scratch:
        out = Path(scratch) / "volume.mrc"
        figures, said = run("reconstruct", folder / "tilts.mrc", "-o", out, *row.options, threads=threads)
        volume = mapped(out)
        if row.beside is not None:
            run("reconstruct", folder / "tilts.mrc", "-o", Path(scratch) / "beside.mrc", *row.beside, threads=threads)
            figures["beside"] = seams_beside(
                volume, mapped(Path(scratch) / "beside.mrc"), truth, said["slices_at_once"]
            )
            figures["psnr beside"] = psnr(mapped(Path(scratch) / "beside.mrc"), truth)
        judged = {"psnr": psnr(volume, truth), "psnr of the middle": psnr(volume, truth, rows=middle_rows(row.size))}
        judged |= {"fsc 0.5": resolution(*fourier_shell_correlation(volume, truth), 0.5)}
        judged |= seams(volume, truth, said["slices_at_once"])
    keep = {
        "regulariser": said["choices"].get("regulariser", REGULARISERS.first),
        "seconds inside": said["seconds"],
        "choices": said["choices"],
        "verdict": said["verdict"]["grade"],
        "reasons": said["verdict"]["reasons"],
    }
    return about | figures | judged | keep


def of_oracle(folder: Path, truth: Any, threads: int) -> Cell:
    """A fit that knows the true noise, at the weight that the truth likes best, of the middle slices and a halo."""
    torch.set_num_threads(threads)
    series = read_tilt_series(folder / "tilts.mrc", mapped=True)
    rows = middle_rows(truth.shape[1])
    wide = slice(max(0, rows.start - HALO), min(truth.shape[1], rows.stop + HALO))
    part = truth[:, wide]
    inner = slice(rows.start - wide.start, rows.stop - wide.start)
    grid = replace(VolumeGrid.of(series), height=wide.stop - wide.start)
    oracle = JointReconstructor(noise_model=ACQUISITIONS["clipped"].noise)
    found = best_fit(series.rows(wide), grid, oracle, lambda volume: psnr(volume, part, rows=inner))
    return {"psnr of the middle": max(found.tried.values()), "setting": found.setting, "tried": found.tried}


def of_astra(folder: Path, truth: Any) -> Cell:
    """ASTRA's SIRT of slices in the middle, at the number of iterations that the truth likes best."""
    series = read_tilt_series(folder / "tilts.mrc", mapped=True)
    middle = truth.shape[1] // 2
    rows = slice(middle - _ASTRA // 2, middle + _ASTRA // 2)
    grid = replace(VolumeGrid.of(series), height=_ASTRA)
    best: Cell = {"psnr of the slices": -np.inf}
    for label, seconds, volume in astra_sirt(series.rows(rows), grid, (4, 8, 16, 32)):
        found = psnr(volume, truth[:, rows])
        if found > best["psnr of the slices"]:
            best = {"psnr of the slices": found, "setting": label, "slices": _ASTRA, "seconds of the slices": seconds}
    return best


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"scale.py: {error}")
