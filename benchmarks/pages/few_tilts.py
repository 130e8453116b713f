"""Few tilts from narrow ranges: every method, and every field of the joint fit, with everything chosen automatically.

    python -m benchmarks.pages.few_tilts run [--scene "shells, ±60°, 11 tilts"] [--method joint/network]   # missing rows
    python -m benchmarks.pages.few_tilts page                                          # few_tilts.md from the JSON

Each row is saved when it is done, in results/few_tilts.json in docs/benchmarks, and is not computed again without --again.
"""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import FOLDER, dots
from benchmarks.pages.fields import Row, scores, text
from benchmarks.provenance import measured_on
from benchmarks.scenes import EMPTY, Results, make_scene
from noiseflow import io
from noiseflow.commands.console import Output
from recon.methods import method_names, reconstruct
from recon.names import AUTO, field_names

_SIZE = 32
_PHANTOMS = ("shells", "filaments")
_WIDEST = (60, 40)
_COUNTS = (11, 21, 41)
SCENES: dict[str, dict[str, Any]] = {
    f"{phantom}, ±{widest}°, {count} tilts": {
        "phantom": phantom,
        "tilts": f"{-widest}:{widest}:{2 * widest // (count - 1)}",
    }
    for phantom in _PHANTOMS
    for widest in _WIDEST
    for count in _COUNTS
}
_OTHERS = "joint/"
_WITH_TRUE_NOISE = "joint-supervised"
NOT_RUN = {
    "kniesel2022": "five minutes of processor time for each row; at 48³ it is on the page of fields",
    "kniesel2022-as-published": "400 000 steps ray by ray: days for each row",
    "joint/kniesel2022": "a step of this network costs 500 times one of grids; the method kniesel2022 fits it",
}
METHODS = (
    EMPTY,
    *(name for name in method_names() if name not in (AUTO, "joint", *NOT_RUN)),
    *(_OTHERS + name for name in field_names() if name != AUTO and _OTHERS + name not in NOT_RUN),
)
_HEAD = f"""# Few tilts

Volume / projections at angles between the tilts: PSNR in dB, affinely matched, for scenes of {_SIZE}³ with clipped noise,
from 11, 21 and 41 tilts within ±60° and ±40°. Every method chooses its noise model, weight and number of steps itself, as
`noiseflow reconstruct --method NAME` does; *joint/NAME* is the joint fit with `--field NAME`, and *{_WITH_TRUE_NOISE}* is given
the true noise. An empty volume has the score that a method has to exceed. One run of each: differences below 0.3 dB are scatter.

Written by `python -m benchmarks.pages.few_tilts page` from `results/few_tilts.json`."""


def measure(name: str, method: str) -> Row:
    """One row: the scores of a method on a scene, and its processor time."""
    torch.set_num_threads(1)
    scene = make_scene(_SIZE, **SCENES[name])
    if method == EMPTY:
        return scores(scene, np.zeros_like(scene.truth))
    options: dict[str, Any] = {"method": method.split("/")[0]}
    if method.startswith(_OTHERS):
        options["field"] = method.removeprefix(_OTHERS)
    if method == _WITH_TRUE_NOISE:
        options["noise_model"] = scene.noise_model
    started = time.process_time()
    result = reconstruct(scene.noisy, scene.grid, **options)
    return {"seconds": time.process_time() - started} | scores(scene, result.volume.attenuation)


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    cells = content["cells"]
    lines = [_HEAD]
    for phantom in _PHANTOMS:
        names = [name for name in SCENES if name.startswith(phantom)]
        if not any(f"{name}/{method}" in cells for name in names for method in METHODS):
            continue
        columns = [name.removeprefix(f"{phantom}, ") for name in names]
        lines += [
            "",
            f"## {phantom.capitalize()}",
            "",
            f"![PSNR of every method, one panel a range]({picture(phantom)})",
        ]
        lines += ["", f"| method | {' | '.join(columns)} | processor time, s |", "|---" * (len(names) + 2) + "|"]
        for method in METHODS:
            rows = [cells.get(f"{name}/{method}") for name in names]
            seconds = [row["seconds"] for row in rows if row is not None and "seconds" in row]
            spent = f"{min(seconds):.0f} to {max(seconds):.0f}" if seconds else "–"
            lines.append(f"| {method} | {' | '.join(text(row) for row in rows)} | {spent} |")
        for key in ("volume", "projections"):
            lines += ["", f"Best {key}: {'; '.join(_best(cells, names, columns, key))}."]
    reasons = [f"- {method}: {reason}." for method, reason in NOT_RUN.items()]
    return "\n".join([*lines, "", "## Not run", "", *reasons, "", measured_on([content]), ""])


def _best(cells: dict[str, Row], names: list[str], columns: list[str], key: str) -> list[str]:
    """The method with the highest score in each column, of those that are not given the true noise."""
    found = []
    for name, column in zip(names, columns, strict=True):
        rows = {
            method: cells[f"{name}/{method}"][key]
            for method in METHODS
            if method != _WITH_TRUE_NOISE and f"{name}/{method}" in cells
        }
        if rows:
            first = max(rows, key=lambda method: rows[method])
            found.append(f"{column}: {first} {rows[first]:.2f}")
    return found


def picture(phantom: str) -> str:
    """The file of the picture of a phantom."""
    return f"few_tilts_{phantom}.png"


def _draw(cells: dict[str, Row]) -> None:
    for phantom in _PHANTOMS:
        panels = []
        for name in (each for each in SCENES if each.startswith(phantom)):
            rows = {method: cells[f"{name}/{method}"] for method in METHODS if f"{name}/{method}" in cells}
            ranked = sorted(rows, key=lambda method: -rows[method]["volume"])
            series = {key: {method: rows[method][key] for method in ranked} for key in ("volume", "projections")}
            if rows:
                panels.append((name.removeprefix(f"{phantom}, "), "PSNR (dB)", series))
        panels = panels[: len(panels) // len(_COUNTS) * len(_COUNTS)]  # of whole ranges
        if panels:
            dots.save(FOLDER / picture(phantom), panels, columns=len(_COUNTS), one_legend=True)


def main() -> None:
    """Run the chosen rows, save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--scene", action="append", choices=list(SCENES))
    parser.add_argument("--method", action="append", choices=METHODS)
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "few_tilts.json", help="JSON file")
    options = parser.parse_args()
    results, output = Results(options.out, "few_tilts"), Output(json_mode=False)
    if options.part == "page":
        _draw(results.cells)
        with io.atomic_path(FOLDER / "few_tilts.md") as partial_path:
            partial_path.write_text(page(results.content), encoding="utf-8")
        return
    for name in options.scene or SCENES:
        for method in options.method or METHODS:
            key = f"{name}/{method}"
            if options.again:
                results.cells.pop(key, None)
            row = results.cell(key, partial(measure, name, method))
            output.line(f"{key}: {row}")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"few_tilts.py: {error}")
