"""The same objects, one field against another, from many tilts and from few.

    python -m benchmarks.pages.fields run [--scene shells] [--field grids]   # rows that are not there yet
    python -m benchmarks.pages.fields line-integrals                         # Gaussians with and without voxels between
    python -m benchmarks.pages.fields merge FILE...                          # rows that other processes wrote with --out
    python -m benchmarks.pages.fields page                                   # fields.md from the JSON

Each row is saved when it is done, in results/fields.json in docs/benchmarks, and is not computed again without --again.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.line_integrals import compare_ways
from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.scenes import EMPTY, Results, Scene, make_scene
from noiseflow import io
from noiseflow.commands.console import Output
from recon.fields.fields import field_kinds, find_field
from recon.joint.joint import JointReconstructor
from recon.joint.plan import Schedule
from recon.methods import reconstruct
from recon.methods.joint import choose_field
from recon.methods.kniesel2022 import PRESETS
from recon.names import AUTO

_FULL = "-59.5:57.5:1.5"
SCENES: dict[str, dict[str, Any]] = {
    "shells": {},
    "shells, seed 1": {"seed": 1},
    "particles, low dose": {"phantom": "particles", "noise": "low-dose"},
    "filaments, skewed": {"phantom": "filaments", "noise": "skewed"},
    "slab": {"phantom": "slab"},
    "shells, ±40°, 21 tilts": {"tilts": "-40:40:4"},
    "shells, ±60°, 11 tilts": {"tilts": "-60:60:12"},
    "shells, ±60°, 21 tilts": {"tilts": "-60:60:6"},
    "shells, ±60°, 41 tilts": {"tilts": "-60:60:3"},
    "cell": {"phantom": "cell"},
    "shells, 64³": {"size": 64},
    "shells, 96³": {"size": 96},
}
_CLASSICAL = ("wbp", "sirt")
FITTED = ("grids", "gaussians", "network")
KINDS = (EMPTY, *_CLASSICAL, *FITTED)
PAPER = "kniesel2022"
_POINTS = 8  # scores along the training of the paper's network
_HEAD = """# Fields

PSNR of volume / projections (at angles between the tilts), dB, affinely matched, for the classical methods, and for volumes
made of grids, of Gaussians, or of a sine network (`--field`), from many tilts and from few. Scenes of 48³, unless stated
otherwise, with the true noise and the weight that held-out pixels choose, one fit each: differences below 0.2 dB are scatter.
The first column is the score of an empty volume, which a method has to exceed.

Written by `python -m benchmarks.pages.fields page` from `results/fields.json`."""
_COSTS = """## Choices and costs

Processor time of the whole fit, relative to grids, with the choice of the weight, on one thread of a machine that was busy
with other work; *memory* is the largest of the process, and includes 300 MiB of libraries, or 550 MiB
where torch is built for GPUs. *auto* is what `--field auto`
takes: the field that predicts left-out tilts best, on the slab, or one within a standard error of it that has fewer
parameters; and how far the others are behind, in nats per pixel; its own time, again relative to grids. All these scenes have
a missing wedge, and the tilts beside it are left out; of a series without one, every fifth tilt is (the tooth: {doc}`tooth`).
Weights are chosen with grids for every field; networks and Gaussians take 0.7 of them."""
_LINE_INTEGRALS = "line integrals"
_SCATTER = 0.2  # dB, between fits of a scene
_NOT_RUN = """## Not measured

The noise is given, not chosen. Rows that say *not run* were left out for lack of time."""
_WITHOUT_VOXELS = """## Gaussians without voxels

The line integral of a Gaussian is a 2D Gaussian of the image, so that a fit needs no voxels between. But a Gaussian would be
evaluated in every image, in place of once in the volume, and the projection of voxels costs little beside it. For Gaussians
fitted to *shells*, all {tilts} projections take {direct:.0f} ms of processor time without voxels and {voxels:.1f} ms with them,
{ratio:.0f} times as long, by {count:.0f} million exponentials. Voxels cost less from {least} tilts on, and the regulariser and
the vacuum need them anyway. So Gaussians keep them. The projections differ by {difference:.0%}."""
_PAPER = """## The network of the paper

`--preset kniesel2022`: the network of nine layers of 256 and the flow of Kniesel et al. (CVPR 2022), without a regulariser,
trained on all voxels by least squares, while the flow learns the residuals. Where the curve is flat, more steps gain nothing;
ray by ray, as published, an hour is 55 of 400 000 steps. Steps by the likelihood of the flow, which has no bound at clipped
values, made the volume worse and were given up."""
Row = dict[str, Any]


def scene_of(name: str) -> Scene:
    """The scene of a row."""
    return make_scene(**{"size": 48, "tilts": _FULL} | SCENES[name])


def measure(name: str, kind: str) -> Row:
    """One row: scores, parameters, steps, weight, held-out likelihood, processor time, and memory of the process."""
    torch.set_num_threads(1)
    scene = scene_of(name)
    if kind == EMPTY:
        return scores(scene, np.zeros_like(scene.truth))
    if kind in _CLASSICAL:
        return scores(scene, reconstruct(scene.noisy, scene.grid, method=kind).volume.attenuation)
    if kind == PAPER:
        return _trained(scene)
    if kind == AUTO:
        fit = JointReconstructor(noise_model=lambda: scene.noise_model)
        started = time.process_time()
        _, evidence = choose_field(fit, scene.noisy, scene.grid, field_kinds(AUTO))
        return {"chosen": evidence, "seconds": time.process_time() - started}
    make, started = find_field(kind), time.process_time()
    result = JointReconstructor(noise_model=lambda: scene.noise_model, make_field=make)(scene.noisy)
    seconds = time.process_time() - started
    assert result.field is not None
    assert result.fit_result is not None
    row = {"parameters": sum(parameter.numel() for parameter in result.field.parameters()), "seconds": seconds}
    row |= {"steps": make.num_steps or Schedule().whole, "held-out": result.fit_result.held_out_nll}
    row |= {"weight": result.weight, "MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
    return row | scores(scene, result.volume.attenuation)


def _trained(scene: Scene) -> Row:
    """Scores of the paper's network along its training, and at its end."""
    preset, started, curve = PRESETS[PAPER], time.process_time(), []
    every = preset.num_steps // _POINTS
    for state in preset.train(scene.noisy, scene.grid):
        if state.done % every == 0:
            seconds = time.process_time() - started
            curve.append({"steps": state.done, "seconds": seconds} | scores(scene, state.volume()))
            print(curve[-1], flush=True)
    return {"curve": curve, "MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024} | curve[-1]


def in_own_process(name: str, kind: str) -> Row:
    """The row, measured in a new process, whose memory is that of this row alone."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure, name, kind).result()


def scores(scene: Scene, volume: Any) -> Row:
    """PSNR of volume and projections, affinely matched, and of the volume as it is, dB."""
    errors, images = scene.errors(volume), scene.projection_errors(volume)
    return {"volume": errors["psnr affine"], "projections": images["2d psnr affine"], "raw": errors["psnr raw"]}


def page(content: dict[str, Any]) -> str:
    """The page as Markdown."""
    cells = content["cells"]
    lines = [_HEAD, "", f"| scene | {' | '.join(KINDS)} |", "|---" * (len(KINDS) + 1) + "|"]
    costs = [
        f"| scene | weight of {', '.join(FITTED)} | time | memory, MiB | parameters | auto |",
        "|---" * 6 + "|",
    ]
    for name in SCENES:
        rows = {kind: cells[f"{name}/{kind}"] for kind in KINDS if f"{name}/{kind}" in cells}
        if not rows:
            continue
        lines.append(f"| {name} | {' | '.join(text(rows.get(kind)) for kind in KINDS)} |")
        fits = [rows.get(kind, {}) for kind in FITTED]
        if not any(fits):
            continue
        usual = fits[0].get("seconds", math.nan)
        figures = [
            ", ".join(f"{row['weight']:.2g}" if row else "–" for row in fits),
            ", ".join(f"{row['seconds'] / usual:.1f}" if row else "–" for row in fits),
            ", ".join(f"{row['MiB']:.0f}" if row else "–" for row in fits),
            ", ".join(str(row["parameters"]) if row else "–" for row in fits),
        ]
        costs.append(f"| {name} | {' | '.join(figures)} | {_auto(cells.get(f'{name}/{AUTO}'), usual)} |")
    costs += ["", *_misses(cells)]
    paper = [_PAPER, "", "| scene | steps | volume / projections | processor time, s |", "|---" * 4 + "|"]
    for name in SCENES:
        for point in cells.get(f"{name}/{PAPER}", {"curve": []})["curve"]:
            paper.append(f"| {name} | {point['steps']} | {text(point)} | {point['seconds']:.0f} |")
    paper = [*paper, ""] if len(paper) > 4 else []
    if (ways := cells.get(_LINE_INTEGRALS)) is not None:
        paper = [_without_voxels(ways), "", *paper]
    gaps = _NOT_RUN if any("not run" in line for line in lines) else _NOT_RUN.partition(" Rows")[0]
    return "\n".join([*lines, "", _COSTS, "", *costs, "", *paper, gaps, "", measured_on([content]), ""])


def _without_voxels(row: Row) -> str:
    voxels, direct = row["seconds by voxels"], row["seconds without"]
    return _WITHOUT_VOXELS.format(
        tilts=row["tilts"],
        direct=1e3 * direct,
        voxels=1e3 * voxels,
        ratio=direct / voxels,
        count=1e-6 * row["exponentials without"],
        least=math.ceil(row["tilts"] * voxels / direct),
        difference=row["relative difference"],
    )


def _misses(cells: dict[str, Row]) -> list[str]:
    """Where the field that `--field auto` takes is behind another one by more than the scatter."""
    judged, behind = 0, []
    for name in SCENES:
        fits = {kind: cells[f"{name}/{kind}"] for kind in FITTED if f"{name}/{kind}" in cells}
        if len(fits) < len(FITTED) or f"{name}/{AUTO}" not in cells:
            continue
        judged, taken = judged + 1, cells[f"{name}/{AUTO}"]["chosen"].split()[0]
        for what, other in (("volume", "projections"), ("projections", "volume")):
            best = max(fits, key=lambda kind, key=what: fits[kind][key])  # type: ignore[misc]
            if (less := fits[best][what] - fits[taken][what]) > _SCATTER:
                lead = fits[taken][other] - fits[best][other]
                but = f", and {lead:.2f} dB ahead of it in the {other}" if lead > _SCATTER else ""
                behind.append(f"- {name}: *{taken}* is {less:.2f} dB behind *{best}* in the {what}{but}.")
    if not judged:
        return []
    scenes = len({line.partition(":")[0] for line in behind})
    return [
        f"On {judged - scenes} of {judged} scenes, *auto* takes the best field, or one within {_SCATTER} dB of it, in volume and "
        f"projections.{' On the others:' if behind else ''}",
        *(["", *behind] if behind else []),
    ]


def text(row: Row | None) -> str:
    """Volume and projections of a row for a table."""
    return "not run" if row is None else f"{row['volume']:.2f} / {row['projections']:.2f}"


def _auto(row: Row | None, usual: float) -> str:
    """What `--field auto` chooses, with the evidence, and the time of the choice relative to a fit of grids."""
    return "not run" if row is None else f"{row['chosen']}; {row['seconds'] / usual:.1f}"


def main() -> None:
    """Run the chosen rows, save each, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("run", _LINE_INTEGRALS.replace(" ", "-"), "merge", "page"))
    parser.add_argument("files", nargs="*", type=Path, help="JSON files to merge")
    parser.add_argument("--scene", action="append", choices=list(SCENES))
    parser.add_argument("--field", action="append", choices=(*KINDS, PAPER, AUTO))
    parser.add_argument("--again", action="store_true", help="compute rows again that are there already")
    parser.add_argument("--out", type=Path, default=FOLDER / "results" / "fields.json", help="JSON file")
    options = parser.parse_args()
    results, output = Results(options.out, "fields"), Output(json_mode=False)
    if options.part == "merge":
        for file in options.files:
            results.take(file)
        return
    if options.part == "page":
        with io.atomic_path(FOLDER / "fields.md") as partial_path:
            partial_path.write_text(page(results.content), encoding="utf-8")
        return
    if options.part != "run":
        output.line(str(results.cell(_LINE_INTEGRALS, lambda: compare_ways(scene_of("shells")))))
        return
    for name in options.scene or SCENES:
        for kind in options.field or (*KINDS, AUTO):
            key = f"{name}/{kind}"
            if options.again:
                results.cells.pop(key, None)
            row = results.cell(key, partial(in_own_process, name, kind))
            output.line(f"{key}: {row}")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"fields.py: {error}")
