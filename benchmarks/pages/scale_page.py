"""The results pages of the scale benchmark, scale.md and scale_estimates.md, from results/scale.json alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from noiseflow.io import atomic_path
from recon.scale.blocks import HALO, SETTLED_ON, block_memory, blocks
from recon.scale.memory import needed_memory
from recon.series.tilt_series import TiltSeries, VolumeGrid

_SHELLS = ("shells-64", "shells-128", "shells-192", "shells-256", "shells-512", "shells-1000")
_OTHERS = ("slab-128", "slab-blocks-128", "blocks-128", "blocks-256", "slab-512", "tv-512", "sirt-512", "l2-512")
_FORMER = "total-variation"  # of rows that do not say: the default until the directional one
_GOALS = {"shells-512": (240, 4), "slab-512": (720, 4), "shells-1000": (2700, 12)}
_TILTS, _LARGER, _WORKERS, _SLICES = 79, (2000, 4000), (1, 16, 256), 64
_DISK = 500e6  # bytes a second of a disk that workers share: assumed
Cell = dict[str, Any]


def write(content: Cell) -> None:
    """Write both pages and the figure."""
    _draw({name: row for name, row in _rows(content, "scale/").items() if name in _SHELLS})
    for name, text in (("scale.md", page(content)), ("scale_estimates.md", estimates(content))):
        with atomic_path(FOLDER / name) as partial:
            partial.write_text(text, encoding="utf-8")


def in_words(name: str, row: Cell) -> str:
    """One row as a line."""
    if "slices" in row:
        seconds = f"{row['seconds of the slices']:.0f} s"
        return f"{name}: {row['psnr of the slices']:.2f} dB on {row['slices']} slices, {row['setting']}, {seconds}"
    if "setting" in row:
        return f"{name}: {row['psnr of the middle']:.2f} dB on the middle slices, {row['setting']}"
    seam = "" if row["seam"] is None else f", seam {row['seam']:.2f} (truth {row['seam of the truth']:.2f})"
    return (
        f"{name}: {row['seconds']:.0f} s, {row['processor seconds']:.0f} s of processor time, {row['peak GiB']:.2f} GiB, "
        f"{row['psnr']:.2f} dB, {row['blocks']} blocks{seam}"
    )


def page(content: Cell) -> str:
    """The results as Markdown."""
    rows = _rows(content, "scale/")
    parts = [
        "# Time and memory over size",
        "![Seconds and peak memory of the joint fit over voxels × tilts, shells of 64³ to the largest size measured](scale.png)",
        "Every row of the table is one command, `noiseflow reconstruct` with default settings, in a separate process: 79 tilts, "
        "clipped noise. `python -m benchmarks.pages.scale run` measures the rows; `python -m benchmarks.pages.scale page` writes "
        "this page from `results/scale.json`.",
        "- **Peak GiB**: the largest resident set that the operating system saw, including pages of mapped files.\n"
        "- **FSC 0.5**: the frequency, in cycles per voxel, at which the Fourier shell correlation with the truth falls to 0.5.\n"
        "- **Seam**: the step of the volume across the border of two blocks over that between neighbouring slices inside, at "
        "the border within the specimen where this is largest; *truth* is the same ratio for the true volume.\n"
        "- **Load**: the number of processes that waited for a core when the row began. If it is high, compare only the "
        "processor time.",
        _table(rows),
        _growth(rows),
        _vacuum(rows),
        _borders(rows),
        _oracle(rows),
        _astra(rows),
        _processes(rows),
        _simulated(_rows(content, "simulate/")),
        "Do not compare seconds of different machines: rows that were measured on both took 1.9 times as long on a Xeon.",
        measured_on([content]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def estimates(content: Cell) -> str:
    """What larger volumes would take, as Markdown; from the rows of 512³."""
    rows = _rows(content, "scale/")
    text = "# Estimates for 2000³ and 4000³\n\n"
    if not {"shells-512", "start-512"} <= rows.keys():
        return text + "Rows `shells-512` and `start-512` are needed: `python -m benchmarks.pages.scale run`.\n"
    slice_seconds, start = _constants(rows["shells-512"], rows["start-512"])
    lines = [
        "| volume | workers | one worker's memory | disk | network | time |",
        "|---|---|---|---|---|---|",
        *(_estimate(size, workers, slice_seconds, start) for size in _LARGER for workers in _WORKERS),
    ]
    text += (
        "Not measured: computed by `python -m benchmarks.pages.scale page` for shells, 79 tilts, blocks of "
        f"{_SLICES} slices, one thread for each worker.\n\n" + "\n".join(lines) + "\n\n"
    )
    if beside := " ".join(filter(None, (_beside(rows), _growth(rows)))):
        text += f"Measured ({{doc}}`scale`): {beside}\n\n"
    return text + (
        f"- **Time**: at 512³ a slice of a block takes {slice_seconds:.2f} s of processor time, halo included, and the "
        f"start, which all blocks share, takes {start:.0f} s. Both grow with the area of a slice. The blocks run on all "
        f"workers, the start on one. The blocks are then joined at an assumed {_DISK / 1e6:.0f} MB a second. A volume without "
        "vacuum takes longer by the ratio of `slab-512` to `shells-512`.\n"
        "- **Memory**: the estimate of `noiseflow reconstruct --dry-run`. The matrix of the projector alone is tilts × width × "
        "depth × 32 bytes, in every worker.\n"
        "- **Disk**: the finished blocks with their halo, the volume, and the series, until the volume is complete.\n"
        "- **Network**: the same blocks, written once and read once, and rows of the series, read once.\n\n"
        "## What would limit larger volumes\n\n"
        "1. **The matrix of the projector**: 9 GiB at 2000 pixels of width and 79 tilts, 38 GiB at 4000. Wider images need tiles "
        "along x, or a projector without a matrix.\n"
        "2. **The start** runs on one worker: beyond a few dozen workers it takes most of the time.\n"
        "3. **Joining**: one process joins the blocks; 4000³ voxels are 238 GiB.\n"
    )


def _rows(content: Cell, start: str) -> dict[str, Cell]:
    return {key.removeprefix(start): row for key, row in content["cells"].items() if key.startswith(start)}


def _table(rows: dict[str, Cell]) -> str:
    lines = [
        "| row | regulariser | blocks | threads | seconds | processor s | peak GiB | PSNR (dB) | FSC 0.5 | seam | truth "
        "| load | goal |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in (*_SHELLS, *_OTHERS):
        if name not in rows:
            continue
        row, goal = rows[name], _GOALS.get(name)
        seams = ("–", "–") if row["seam"] is None else (f"{row[key]:.2f}" for key in ("seam", "seam of the truth"))
        prior = "–" if "sirt" in row["options"] else row.get("regulariser", _FORMER)
        cells = [f"{name} {' '.join(row['options'])}", prior, row["blocks"], row["threads"], f"{row['seconds']:.0f}"]
        cells += [
            f"{row['processor seconds']:.0f}",
            f"{row['peak GiB']:.2f}",
            f"{row['psnr']:.2f}",
            f"{row['fsc 0.5']:.3f}" if "fsc 0.5" in row else "–",
            *seams,
            row["load"],
        ]
        cells.append("" if goal is None else f"{goal[0]} s, {goal[1]} GiB")
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def _growth(rows: dict[str, Cell]) -> str:
    """The exponents of a power law through the shells up to 512³."""
    found = [rows[name] for name in _SHELLS if name in rows and rows[name]["size"] <= 512]
    if len(found) < 2:
        return ""
    work = np.log([row["size"] ** 3 * _TILTS for row in found])
    exponents = {
        name: np.polyfit(work, np.log([row[name] for row in found]), 1)[0] for name in ("seconds", "processor seconds")
    }
    return (
        f"From {found[0]['size']}³ to {found[-1]['size']}³, time grows with voxels × tilts to the power of "
        f"{exponents['seconds']:.2f} (processor time: {exponents['processor seconds']:.2f}); the goal is 0.9 or less."
    )


def _borders(rows: dict[str, Cell]) -> str:
    """Rows that were reconstructed twice, with borders in different places."""
    found = {name: row for name, row in rows.items() if "beside" in row}
    if not found:
        return ""
    lines = [
        "| row | blocks | PSNR (dB) | PSNR with other borders (dB) | jump at a border, over the same place without one |"
    ]
    lines.append("|---|---|---|---|---|")
    for name, row in found.items():
        cells = [name, row["blocks"], f"{row['psnr']:.2f}", f"{row['psnr beside']:.2f}", f"{row['beside']:.3f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return (
        "The specimen itself may have a step at a border. These series were therefore reconstructed twice, the second time as a "
        "whole or in blocks with other borders. The last column is the largest ratio of all borders; it is 1 if blocks leave no "
        "trace.\n\n" + "\n".join(lines)
    )


def _beside(rows: dict[str, Cell]) -> str:
    """The largest row that was measured, to compare with its estimate."""
    row = rows.get("shells-1000")
    if row is None:
        return ""
    minutes = _time(row["processor seconds"])
    wall, threads = _time(row["seconds"]), row["threads"]
    return (
        f"1000³ took {minutes} of processor time ({wall} with {threads} threads) and {row['peak GiB']:.1f} GiB, in "
        f"{row['blocks']} blocks."
    )


def _vacuum(rows: dict[str, Cell]) -> str:
    found = {name: row["seam in vacuum"] for name, row in rows.items() if row.get("seam in vacuum") is not None}
    if not found:
        return ""
    return (
        "At borders in vacuum, the largest step of the volume over the difference between neighbouring slices of the specimen: "
        f"{', '.join(f'{name} {seam:.1g}' for name, seam in found.items())}."
    )


def _oracle(rows: dict[str, Cell]) -> str:
    joint, oracle = rows.get("shells-512"), rows.get("oracle-512")
    if oracle is None or joint is None or "psnr of the middle" not in joint:
        return ""
    reached = oracle["psnr of the middle"] - joint["psnr of the middle"] <= 0.15
    return (
        f"On the 64 slices in the middle of 512³, the volume has {joint['psnr of the middle']:.2f} dB, a fit of these slices "
        f"with the true noise has {oracle['psnr of the middle']:.2f} dB at its best weight "
        f"({oracle['setting']}; the volume chose {joint['choices']['weight']:.3f}). The goal, at most 0.15 dB less, is "
        f"{'reached' if reached else 'missed'}."
    )


def _astra(rows: dict[str, Cell]) -> str:
    row, ours = rows.get("astra-512"), rows.get("sirt-512")
    if row is None or ours is None:
        return ""
    part, slices = row["seconds of the slices"], row["slices"]
    return (
        f"ASTRA's SIRT on the CPU works slice by slice with one thread. It took {part:.0f} s for {slices} slices in the middle "
        f"of 512³ at the best number of iterations by the truth ({row['setting']}, {row['psnr of the slices']:.2f} dB there), "
        f"which is {part * row['size'] / slices:.0f} s for all {row['size']} slices. `sirt-512`, with two threads and an "
        f"automatic number of iterations, took {ours['seconds']:.0f} s."
    )


def _processes(rows: dict[str, Cell]) -> str:
    if not {"processes-1", "processes-2"} <= rows.keys():
        return ""
    one, two = (rows[name]["seconds"] for name in ("processes-1", "processes-2"))
    return (
        f"256³ in four blocks took {two:.0f} s with two Dask workers of one thread and {one:.0f} s with one process of two "
        f"threads: {one / two:.2f} of its speed. The goal is 0.9 or more."
    )


def _simulated(rows: dict[str, Cell]) -> str:
    if not rows:
        return ""
    parts = [f"{name} {row['processor seconds']:.0f} s and {row['peak GiB']:.2f} GiB" for name, row in rows.items()]
    return f"`noiseflow simulate` made the series: {', '.join(parts)}."


def _constants(whole: Cell, start: Cell) -> tuple[float, float]:
    """Processor seconds of a slice of a block, and of what is settled, at the size of these rows.

    The row `start` takes one step in place of all; the last fit of the slabs that settle is among those that it leaves out.
    """
    slices = sum(part.wide.stop - part.wide.start for part in blocks(whole["size"], _SLICES, HALO))
    of_slice = (whole["processor seconds"] - start["processor seconds"]) / (slices + SETTLED_ON)
    return of_slice, start["processor seconds"] + SETTLED_ON * of_slice


def _estimate(size: int, workers: int, slice_seconds: float, start: float) -> str:
    parts, area = blocks(size, _SLICES, HALO), (size / 512) ** 2
    heights = [part.wide.stop - part.wide.start for part in parts]
    rounds = math.ceil(len(parts) / workers) * max(heights) if workers > 1 else sum(heights)
    kept, volume, series = 4 * size**2 * sum(heights), 4 * size**3, 4 * _TILTS * size**2
    seconds = area * (start + rounds * slice_seconds) + (kept + volume) / _DISK
    shape = np.broadcast_to(np.float32(1), (_TILTS, size, size))
    block = block_memory(_Virtual(shape), VolumeGrid(size, size, size), _SLICES, fitted=True)
    memory = needed_memory(*block)
    cells = [f"{size}³", workers, _bytes(memory), _bytes(kept + volume + series), _bytes(2 * kept + series)]
    return "| " + " | ".join(map(str, [*cells, _time(seconds)])) + " |"


class _Virtual(TiltSeries):
    """A series without its pixels."""

    def __init__(self, images: Any) -> None:
        for name, value in (("images", images), ("mask", None), ("tilt_angles", np.arange(float(len(images))))):
            object.__setattr__(self, name, value)


def _bytes(count: float) -> str:
    return f"{count / 2**40:.1f} TiB" if count >= 2**40 else f"{count / 2**30:.0f} GiB"


def _time(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{seconds / 60:.0f} min"


def _draw(rows: dict[str, Cell]) -> None:
    """Seconds and memory over voxels × tilts."""
    from matplotlib.figure import Figure

    if not rows:
        return
    found = sorted(rows.values(), key=lambda row: row["size"])
    work = [row["size"] ** 3 * _TILTS for row in found]
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    time, memory = figure.subplots(1, 2)
    for name, style in (("seconds", "o-"), ("processor seconds", "s--")):
        time.loglog(work, [row[name] for row in found], style, label=name)
    time.legend()
    time.set(xlabel="voxels × tilts", ylabel="seconds", title="Time")
    memory.loglog(work, [row["peak GiB"] for row in found], "o-")
    memory.set(xlabel="voxels × tilts", ylabel="peak memory, GiB", title="Memory")
    for axis in (time, memory):
        for row, place in zip(found, work, strict=True):
            axis.annotate(f"{row['size']}³", (place, axis.get_ylim()[0]), fontsize=8, ha="center", va="bottom")
        axis.grid(alpha=0.3)
    with atomic_path(FOLDER / "scale.png") as partial:
        figure.savefig(partial, dpi=110)
