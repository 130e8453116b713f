"""The same objects, one field against another, from many tilts and from few.

    python -m benchmarks.pages.fields run [--scene shells] [--field grids]   # rows that are not there yet
    python -m benchmarks.pages.fields page                                   # fields.md from the JSON

Each row is saved when it is done, in results/fields.json in docs/benchmarks, and is not computed again without --again.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.scenes import EMPTY, Results, Scene, make_scene
from noiseflow import io
from noiseflow.commands.console import Output
from recon.fields.files import field_kinds
from recon.joint.joint import JointReconstructor
from recon.joint.plan import Schedule
from recon.methods import reconstruct

_FULL = "-59.5:57.5:1.5"
SCENES: dict[str, dict[str, Any]] = {
    "shells": {},
    "shells, seed 1": {"seed": 1},
    "cell": {"phantom": "cell"},
    "particles, low dose": {"phantom": "particles", "noise": "low-dose"},
    "filaments, skewed": {"phantom": "filaments", "noise": "skewed"},
    "slab": {"phantom": "slab"},
    "shells, ±40°, 21 tilts": {"tilts": "-40:40:4"},
    "shells, ±60°, 11 tilts": {"tilts": "-60:60:12"},
    "shells, ±60°, 21 tilts": {"tilts": "-60:60:6"},
    "shells, ±60°, 41 tilts": {"tilts": "-60:60:3"},
}
_SIZE = 48
_WEIGHT = 0.4  # near the best of all scenes
_CLASSICAL = ("wbp", "sirt")
KINDS = (EMPTY, *_CLASSICAL, "grids", "gaussians", "network")
_HEAD = f"""# Fields

PSNR of volume / projections (at angles between the tilts), dB, affinely matched, for the classical methods, and for volumes
made of grids, of Gaussians, or of a sine network (`--field`), from many tilts and from few. Scenes of {_SIZE}³ with the true
noise and a weight of {_WEIGHT:g}, one fit each: differences below 0.2 dB are scatter. The first column is the score of an empty
volume, which a method has to exceed. The last column names the field that predicts held-out pixels best, as `--field auto`
takes it on the slab, and how far the others are behind, in nats per pixel.

Written by `python -m benchmarks.pages.fields page` from `results/fields.json`."""
_NOT_RUN = """The weight is the same for all and the best of none: with weights searched for each field, differences may
change their sign. Grids take their usual 150 steps.

## Not measured

More than one fit per row, sizes of 64³ and more, weights and noise chosen by the fit, and the network of Kniesel et al. with
its 256 units (`--field kniesel2022`)."""
Row = dict[str, Any]


def scene_of(name: str) -> Scene:
    """The scene of a row."""
    return make_scene(_SIZE, **{"tilts": _FULL} | SCENES[name])


def measure(scene: Scene, kind: str) -> Row:
    """One row: scores, parameters, steps and held-out likelihood."""
    if kind == EMPTY:
        return _scores(scene, np.zeros_like(scene.truth))
    if kind in _CLASSICAL:
        return _scores(scene, reconstruct(scene.noisy, scene.grid, method=kind).volume.attenuation)
    make = next(iter(field_kinds(kind).values()))
    result = JointReconstructor(weight=_WEIGHT, noise_model=lambda: scene.noise_model, make_field=make)(scene.noisy)
    assert result.field is not None
    assert result.fit_result is not None
    row = {"parameters": sum(parameter.numel() for parameter in result.field.parameters())}
    row |= {"steps": make.num_steps or Schedule().whole, "held-out": result.fit_result.held_out_nll}
    return row | _scores(scene, result.volume.attenuation)


def _scores(scene: Scene, volume: Any) -> Row:
    errors, images = scene.errors(volume), scene.projection_errors(volume)
    return {"volume": errors["psnr affine"], "projections": images["2d psnr affine"], "raw": errors["psnr raw"]}


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    cells = content["cells"]
    lines = [_HEAD, "", f"| scene | {' | '.join(KINDS)} | preferred |", "|---" * (len(KINDS) + 2) + "|"]
    for name in SCENES:
        rows = {kind: cells.get(f"{name}/{kind}") for kind in KINDS}
        if any(rows.values()):
            lines.append(f"| {name} | {' | '.join(map(_text, rows.values()))} | {_preferred(rows)} |")
    counts = {kind: next((cells[key] for key in cells if key.endswith(f"/{kind}")), None) for kind in KINDS}
    lines += ["", "| field | parameters | steps |", "|---|---|---|"]
    lines += [
        f"| {kind} | {row['parameters']} | {row['steps']} |" for kind, row in counts.items() if row and "steps" in row
    ]
    return "\n".join([*lines, "", _NOT_RUN, "", measured_on([content]), ""])


def _text(row: Row | None) -> str:
    return "" if row is None else f"{row['volume']:.2f} / {row['projections']:.2f}"


def _preferred(rows: dict[str, Row]) -> str:
    """The field with the lowest held-out negative log-likelihood, and how far the others are above it."""
    nll = {kind: row["held-out"] for kind, row in rows.items() if row and "held-out" in row}
    if len(nll) < 2:
        return ""
    first = min(nll, key=lambda kind: nll[kind])
    return f"{first} ({', '.join(f'{kind} {nll[kind] - nll[first]:+.4f}' for kind in nll if kind != first)})"


def main() -> None:
    """Run the chosen rows, save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", "page"))
    parser.add_argument("--scene", action="append", choices=list(SCENES))
    parser.add_argument("--field", action="append", choices=KINDS)
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "fields.json", help="JSON file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    results, output = Results(options.out, "fields"), Output(json_mode=False)
    if options.part == "page":
        with io.atomic_path(FOLDER / "fields.md") as partial_path:
            partial_path.write_text(page(results.content), encoding="utf-8")
        return
    for name in options.scene or SCENES:
        for kind in options.field or KINDS:
            key = f"{name}/{kind}"
            if options.again:
                results.cells.pop(key, None)
            row = results.cell(key, partial(measure, scene_of(name), kind))
            output.line(f"{key}: {row}")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"fields.py: {error}")
