"""The default fit on series that nobody tuned it for, against other methods that are tuned against the ground truth.

    python -m benchmarks.pages.independent run [--half judge] [--only beads] [--most 20]    # cells that are there are kept
    python -m benchmarks.pages.independent page                                             # independent.md from the JSON

Scenes, projector and noise are those of tests/independent_scenes.py, which share no code with the library. Each cell is saved
when it is done, in results/independent.json. The order of cells is random, with a fixed seed.
"""

from __future__ import annotations

import argparse
import itertools
import random
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import FOLDER
from benchmarks.pages.joint_page import table
from benchmarks.provenance import measured_on
from benchmarks.scenes import Results
from noiseflow.commands.console import Output
from noiseflow.io import atomic_path
from recon import VolumeGrid, reconstruct, sirt
from recon.methods.sirt import LineIntegralProblem
from tests.independent_scenes import NOISES, RANGES, SCENES, IndependentSeries, independent_series

HALVES = {"learn": list(SCENES)[::2], "judge": list(SCENES)[1::2]}
"""Scenes that were looked at while the fit was changed, and scenes that only judge it."""
DRAWN = (
    "off_axis; scan noise; ±60°/2°; 32",
    "beads; Poisson 100; ±60°/2°; 32",
    "core_shell; 8 bits, gamma; 0…177°/3°; 32",
    "fibres; Poisson 40, read noise; ±60°/2°; 32",
    "truncated_object; Poisson 10; 0…177°/3°; 32",
    "vesicles_in_ice; Poisson 10; ±70°/5°; 32",
    "truncated_object; 8 bits, gamma; ±50°/10°; 32",
    "truncated_object; Poisson 40, read noise; ±50°/10°; 32",
    "smooth_blobs; outliers; ±60°/2°; 32",
    "needle_with_precipitates; Poisson 40, read noise; 0…177°/3°; 32",
    "beads; scan noise; ±70°/5°; 32",
    "needle_with_precipitates; Poisson 2; ±50°/10°; 32",
)
"""Cells drawn with the seed 44 from all that were not measured yet; they only judge, whatever their scene."""
_ITERATIONS = (5, 10, 20, 40, 80, 160)
_EQUAL = 0.1  # dB; two fits of a scene differ by that much
_FURTHER = (1, 2)  # seeds of the default besides the first one, to show what chance does
Row = dict[str, Any]


def cells(size: int) -> list[str]:
    """All cells, ``scene; noise; tilts; size``, in a random order that never changes: none is chosen by hand."""
    every = ["; ".join(parts) for parts in itertools.product(SCENES, NOISES, RANGES, [str(size)])]
    random.Random(0).shuffle(every)
    return every


def psnr(volume: Any, made: IndependentSeries) -> float:
    """Volume PSNR relative to the largest density, dB; nothing is rescaled."""
    return float(10 * np.log10(made.truth.max() ** 2 / np.mean((volume - made.truth) ** 2)))


def best_weight(made: IndependentSeries, method: str, first: float) -> tuple[float, float]:
    """The highest PSNR among weights on a ladder of factors of 2 around the best, and its weight."""
    tried: dict[int, float] = {}

    def visit(rung: int) -> float:
        if rung not in tried:
            found = reconstruct(made.series, method=method, weight=first * 2.0**rung)
            tried[rung] = psnr(found.volume.attenuation, made)
        return tried[rung]

    best = 0
    while (better := max((best, best + 1, best - 1), key=visit)) != best:
        best = better
    return tried[best], first * 2.0**best


def best_sirt(made: IndependentSeries) -> float:
    """The highest PSNR of SIRT among numbers of iterations."""
    problem = LineIntegralProblem.of(made.series, VolumeGrid.of(made.series))
    volume, found, done = None, list[float](), 0
    for count in _ITERATIONS:
        volume = sirt(problem.line_integrals, problem.projector, num_iterations=count - done, start=volume)
        done = count
        found.append(psnr(volume.numpy(), made))
    return max(found)


def measure(cell: str) -> Row:
    """The default, and other methods at what the truth calls their best."""
    scene, noise, tilts, size = cell.split("; ")
    made = independent_series(scene, noise, tilts, size=int(size))
    found = reconstruct(made.series)
    volume, choices = found.volume.attenuation, found.choices
    row: Row = {"default": psnr(volume, made), "mass": float(volume.sum() / made.truth.sum()), "choices": choices}
    row["further seeds"] = [psnr(reconstruct(made.series, seed=seed).volume.attenuation, made) for seed in _FURTHER]
    # least squares counts squares in units of its own noise, as the joint fit does
    row["l2"], weight = best_weight(made, "l2", float(choices["weight"]))
    row["tv"], _ = best_weight(made, "tv", weight)
    row["sirt"] = best_sirt(made)
    return row


def margin(row: Row) -> float:
    """The default's gain over the best of the others, dB."""
    return float(row["default"] - max(row["l2"], row["tv"], row["sirt"]))


def spread(row: Row) -> float | None:
    """The largest difference between seeds of the default, dB; None if only one was run."""
    found = [row["default"], *row.get("further seeds", [])]
    return max(found) - min(found) if len(found) > 1 else None


def page(content: dict[str, Any]) -> str:
    """The page as Markdown, losses first."""
    rows: dict[str, Row] = dict(sorted(content["cells"].items(), key=lambda item: margin(item[1])))
    lines = []
    learn = [key for key in rows if key.split("; ")[0] in HALVES["learn"] and key not in DRAWN]
    groups = {
        "learn": learn,
        "judge": [key for key in rows if key not in learn],
        "judge, drawn at random": DRAWN,
        "all": rows,
    }
    for name, counted in groups.items():
        gains = [margin(row) for key, row in rows.items() if key in counted]
        if gains:
            kept = sum(gain > -_EQUAL for gain in gains)
            words = f"{kept} of {len(gains)} ({kept / len(gains):.0%})"
            lines.append([name, words, f"{statistics.mean(gains):+.2f}", f"{min(gains):+.2f}"])
    cells_ = [
        [
            *key.split("; "),
            f"{margin(row):+.2f}",
            f"{row['default']:.2f}",
            "–" if (between := spread(row)) is None else f"{between:.2f}",
            *(f"{row[name]:.2f}" for name in ("l2", "tv", "sirt")),
            f"{row['mass']:.3f}",
            f"{row['choices']['noise model']}, weight {row['choices']['weight']:.2g}",
        ]
        for key, row in rows.items()
    ]
    head = (
        "# Independent scenes\n\n"
        "The default is compared with the best of three methods, each tuned against the ground truth: least squares with the "
        "directional prior (`l2`) and with total variation (`tv`), both at the best weight of a ladder of factors of 2, and "
        "SIRT at the best number of iterations. Scenes, their projector and their noise share no code with the library "
        "(`tests/independent_scenes.py`). The numbers are volume PSNR in dB, without any rescaling, and the mass of the "
        "volume relative to the truth.\n\n"
        "Changes of the fit were made with the cells `learn` in view; the cells `judge` were only measured, except that wider "
        "grids were made with the truncated object in view, and the blur of the detector with the beads. Not all of the "
        f"{len(cells(0))} cells have been measured: those here by a list that covers scenes, noises and tilt ranges evenly; the "
        "beads with four more noises, because their weights were suspected to be too low; and twelve cells that were drawn at "
        "random from all others after the fit was last changed. Pixel values with a gamma have no unit: the truth takes that in "
        "which the brightest of the 256 levels stays what it is, and a fit that knows of no gamma finds a volume of another "
        "scale (*mass*). Of the methods here, only the default models the blur of a detector and a bent response, and it finds "
        "them by itself, a bend in one of the four series with a gamma."
        "\n\n"
        "An object that the field of view cuts off is fitted on a wider grid, by all methods here but SIRT."
        "\n\n```sh\npython -m benchmarks.pages.independent run\n```"
    )
    summary = table(["scenes", f"default within {_EQUAL} dB of the best", "mean gain (dB)", "worst (dB)"], lines)
    header = [
        "scene",
        "noise",
        "tilts",
        "voxels",
        "gain (dB)",
        "default",
        "seeds",
        "l2",
        "tv",
        "sirt",
        "mass",
        "chosen",
    ]
    spreads = [each for row in rows.values() if (each := spread(row)) is not None]
    chance = (
        f"Between {len(_FURTHER) + 1} seeds, the default differs by {statistics.median(spreads):.2f} dB in the median of "
        f"{len(spreads)} cells, and by at most {max(spreads):.2f} dB (*seeds*)."
        if spreads
        else "What the seed changes is not measured."
    )
    return "\n\n".join([head, summary, chance, table(header, cells_), measured_on([content])]) + "\n"


def main() -> None:
    """Run the chosen cells and save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--half", choices=HALVES, help="of the scenes; all by default")
    parser.add_argument("--only", default="", help="cells whose name contains this")
    parser.add_argument("--most", type=int, help="number of cells to measure")
    parser.add_argument("--size", type=int, default=32, help="voxels along each edge")
    parser.add_argument("--again", action="store_true", help="measure the chosen cells again")
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "independent.json")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results, output = Results(options.out, "independent"), Output(json_mode=False)
    if options.part == "page":
        with atomic_path(FOLDER / "independent.md") as partial:
            partial.write_text(page(results.content), encoding="utf-8")
        return
    scenes = HALVES.get(options.half, list(SCENES))
    chosen = [cell for cell in cells(options.size) if cell.split("; ")[0] in scenes and options.only in cell]
    for cell in chosen[: options.most]:
        if options.again:
            results.forget(cell)
        row = results.cell(cell, lambda name=cell: measure(name))  # type: ignore[misc]
        output.line(f"{cell}: {margin(row):+.2f} dB, default {row['default']:.2f}")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"independent.py: {error}")
