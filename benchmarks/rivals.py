"""Run time against error for every method on the same data and machine, with an oracle as the lower bound.

A point is a volume and its run time; computing the error is not timed. Settings of other methods are tuned against the ground
truth in a search that is not timed, which favours them. The joint fit chooses its settings itself, within its run time.
"""

from __future__ import annotations

import itertools
import math
import re
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import nn

from benchmarks.external import astra_sirt, missing, quantem_inr
from benchmarks.scenes import Cell, Results, Scene, make_scene
from noiseflow import Gaussian
from recon.fields.kinds.grids import VoxelField
from recon.fields.regularisers.second_order import TotalVariation
from recon.joint.joint import JointReconstructor
from recon.methods.kniesel2022 import PRESETS, Kniesel2022
from recon.methods.sirt import LineIntegralProblem
from recon.metrics.metrics import compare
from recon.projection.classical import WINDOWS, sirt, wbp

Point = tuple[str, float, NDArray[Any]]
ITERATIONS = (1, 2, 4, 8, 16, 32, 64, 128)
CUTOFFS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)


@dataclass(frozen=True)
class Effort:
    """Computational effort of the benchmark.

    Attributes:
        steps: numbers of steps of the fits, each a separate run; weights are searched with the largest number.
        weights: initial weights of the total variation in the search.
        refine: number of refinements of the search around the best weight.
        repeats: repeats of every curve, in turn.
        budget: time in seconds for methods that would take hours.
    """

    steps: tuple[int, ...] = (30, 120, 300)
    weights: tuple[float, ...] = (0.1, 0.3, 1.0)
    refine: int = 1
    repeats: int = 3
    budget: float = 600.0


QUICK = Effort(steps=(20, 60), weights=(0.2,), refine=0, repeats=1, budget=5.0)


def back_projection(scene: Scene, window: str, cutoff: float) -> Iterator[Point]:
    """One back-projection, timed with its set-up."""
    started = time.perf_counter()
    problem = LineIntegralProblem.of(scene.noisy, scene.grid)
    volume = wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff).numpy()
    yield f"cutoff {cutoff:g}", time.perf_counter() - started, volume


def own_sirt(scene: Scene) -> Iterator[Point]:
    """SIRT at several numbers of iterations."""
    started = time.perf_counter()
    problem = LineIntegralProblem.of(scene.noisy, scene.grid)
    seconds, volume, done = time.perf_counter() - started, None, 0
    for count in ITERATIONS:
        started = time.perf_counter()
        volume = sirt(problem.line_integrals, problem.projector, num_iterations=count - done, start=volume)
        seconds, done = seconds + time.perf_counter() - started, count
        yield f"{count} iterations", seconds, volume.numpy()


def fitted(scene: Scene, reconstructor: JointReconstructor, steps: Iterable[int | None]) -> Iterator[Point]:
    """Complete fits of different lengths; None is the default length."""
    for count in steps:
        started = time.perf_counter()
        result = replace(reconstructor, num_steps=count)(scene.noisy)
        setting = "default settings" if count is None else f"{count} steps"
        yield setting, time.perf_counter() - started, result.volume.attenuation


def reconstructors(scene: Scene) -> dict[str, JointReconstructor]:
    """Fits with searched weight, by name."""

    def truth() -> nn.Module:
        return scene.noise_model

    return {
        "L2 + TV": JointReconstructor(noise_model=Gaussian, regulariser=TotalVariation()),
        "L2 + TV, voxels": JointReconstructor(
            noise_model=Gaussian, make_field=VoxelField, regulariser=TotalVariation()
        ),
        "oracle": JointReconstructor(noise_model=truth),
    }


def best_setting(scene: Scene, reconstructor: JointReconstructor, effort: Effort) -> Cell:
    """The weight, and whether to fit the incident intensity, with the highest PSNR of the volume."""
    tried: dict[float, float] = {}
    reconstructor = replace(reconstructor, num_steps=max(effort.steps))

    def visit(weights: Iterable[float]) -> float:
        for weight in weights:
            if weight not in tried:
                tried[weight] = _psnr(scene, replace(reconstructor, weight=weight))
        return max(tried, key=lambda weight: tried[weight])

    best = visit(effort.weights)
    for halving in range(effort.refine):
        step = (10 / 3) ** (0.5 ** (halving + 1))
        best = visit([best / step, best * step])
    known = _psnr(scene, replace(reconstructor, weight=best, estimate_response=False)) if effort.refine else -math.inf
    return {"weight": best, "estimate_response": bool(tried[best] >= known), "tried": tried}


def _psnr(scene: Scene, reconstructor: JointReconstructor) -> float:
    return compare(reconstructor(scene.noisy).volume.attenuation, scene.truth).psnr


def best_cutoff(scene: Scene, window: str) -> Cell:
    """The cutoff with the highest PSNR of the affinely matched volume."""
    problem = LineIntegralProblem.of(scene.noisy, scene.grid)
    tried = {}
    for cutoff in CUTOFFS:
        volume = wbp(problem.line_integrals, problem.projector, window=window, cutoff=cutoff).numpy()
        tried[cutoff] = compare(volume, scene.truth, scaling="affine").psnr
    return {"cutoff": max(tried, key=lambda cutoff: tried[cutoff]), "tried": tried}


def curves(scene: Scene, results: Results, key: str, effort: Effort) -> dict[str, Callable[[], Iterator[Point]]]:
    """Every method that is installed, with its best setting; the searches are stored as separate results."""
    found: dict[str, Callable[[], Iterator[Point]]] = {"SIRT": lambda: own_sirt(scene)}
    for window in WINDOWS:
        cutoff = results.cell(f"{key}/search/WBP {window}", lambda w=window: best_cutoff(scene, w))["cutoff"]  # type: ignore[misc]
        found[f"WBP {window}"] = lambda w=window, c=cutoff: back_projection(scene, w, c)  # type: ignore[misc]
    for name, reconstructor in reconstructors(scene).items():
        best = results.cell(f"{key}/search/{name}", lambda r=reconstructor: best_setting(scene, r, effort))  # type: ignore[misc]
        ready = replace(reconstructor, weight=best["weight"], estimate_response=best["estimate_response"])
        found[name] = lambda r=ready: fitted(scene, r, effort.steps)  # type: ignore[misc]
    found["joint"] = lambda: fitted(scene, JointReconstructor(), effort.steps)
    found["joint, default settings"] = lambda: fitted(scene, JointReconstructor(), (None,))
    found["joint, voxels"] = lambda: fitted(scene, JointReconstructor(make_field=VoxelField), effort.steps)
    if not missing("astra"):
        found["ASTRA SIRT"] = lambda: astra_sirt(scene.noisy, scene.grid, ITERATIONS)
    return found


def run(size: int, results: Results, *, effort: Effort, line: Callable[[str], None], **scene_options: Any) -> None:
    """Compute the curves at one size; existing results are kept.

    Args:
        size: voxels along each edge.
        results: file of the results.
        effort: computational effort.
        line: called with progress messages.
        **scene_options: arguments of `make_scene`.
    """
    scene = make_scene(size, **scene_options)
    line(f"{scene.name}: settings are searched, then {effort.repeats} curves of each method in turn")
    ready = curves(scene, results, str(size), effort)
    for repeat in range(effort.repeats):
        for name, curve in ready.items():
            cell = results.cell(f"{size}/curve {repeat}/{name}", lambda c=curve: _measured(scene, c()))  # type: ignore[misc]
            if cell["points"]:
                best = max(cell["points"], key=lambda point: point["psnr affine"])
                line(f"  {name}: {best['psnr affine']:.2f} dB in {best['seconds']:.2f} s ({best['setting']})")


def run_slow(size: int, results: Results, *, effort: Effort, line: Callable[[str], None], **scene_options: Any) -> None:
    """Compute one curve per method that takes hours, within the budget."""
    scene = make_scene(size, **scene_options)
    slow: dict[str, Callable[[], Iterator[Point]]] = {
        name: lambda p=preset: _trained(scene, p, effort.budget)  # type: ignore[misc]
        for name, preset in PRESETS.items()
    }
    if not missing("quantem"):
        slow["quantem INR"] = lambda: quantem_inr(scene.noisy, scene.grid, budget=effort.budget)
    for name, curve in slow.items():
        line(f"{scene.name}: {name}, {effort.budget:.0f} s")
        results.cell(f"{size}/curve 0/{name}", lambda c=curve: _measured(scene, c()))  # type: ignore[misc]


def _trained(scene: Scene, preset: Kniesel2022, budget: float) -> Iterator[Point]:
    """Volumes of a preset at increasing times, each 1.5 times the previous one."""
    seconds, due, started = 0.0, budget / 30, time.perf_counter()
    for state in preset.train(scene.noisy, scene.grid):
        now = seconds + time.perf_counter() - started
        if now >= due or now >= budget:
            yield f"{state.done} of {preset.num_steps} steps", now, state.volume()
            seconds, due, started = now, 1.5 * now, time.perf_counter()
        if now >= budget:
            return


def _measured(scene: Scene, points: Iterator[Point]) -> Cell:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return {
            "points": [
                {"setting": setting, "seconds": seconds} | scene.errors(volume) for setting, seconds, volume in points
            ]
        }


def summary(results: Results, size: int) -> dict[str, list[dict[str, Any]]]:
    """The curves at one size: points by method, with the median run time of the repeats."""
    found: dict[str, list[list[dict[str, Any]]]] = {}
    for key, cell in results.cells.items():
        parts = key.split("/", 2)
        if parts[0] == str(size) and parts[1].startswith("curve"):
            found.setdefault(parts[2], []).append(cell["points"])
    return {
        name: [
            point | {"seconds": statistics.median(other[index]["seconds"] for other in repeats if index < len(other))}
            for index, point in enumerate(repeats[0])
        ]
        for name, repeats in found.items()
    }


def table(curves_of_methods: dict[str, list[dict[str, Any]]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Table header and rows: the best point of each finished curve, and the first point within 0.2 dB of it."""
    rows: list[tuple[str, ...]] = []
    for name, points in curves_of_methods.items():
        if not points or unfinished(points):
            continue
        best = max(points, key=lambda point: point["psnr affine"])
        near = next(point for point in points if point["psnr affine"] >= best["psnr affine"] - 0.2)
        rows.append(
            (
                name,
                best["setting"],
                f"{best['psnr affine']:.2f}",
                f"{best['psnr raw']:.2f}",
                f"{best['mse affine']:.3e}",
                f"{best['seconds']:.2f}",
                f"{near['seconds']:.2f}",
            )
        )
    rows.sort(key=lambda row: -float(row[2]))
    header = ("method", "at its best with", "PSNR (dB)", "PSNR, raw", "MSE", "seconds", "seconds to 0.2 dB of it")
    return header, rows


def unfinished(points: list[dict[str, Any]]) -> str:
    """Progress of an unfinished curve, such as "4 of 400000 steps"; empty if the method finished."""
    last = points[-1]["setting"] if points else ""
    numbers = re.fullmatch(r"(\d+) of (\d+) steps", last)
    return last if numbers and numbers[1] != numbers[2] else ""


_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")
"""The colour-blind-safe palette of Okabe and Ito. Beyond seven methods, markers differ."""


def draw(curves_of_methods: dict[str, list[dict[str, Any]]], title: str) -> Any:
    """Plot error against time; the best result of the oracle is a line, and unfinished curves are dotted."""
    from noiseflow.report import new_figure

    figure, axes = new_figure(1, width=10.5, height=5.2)
    axis = axes[0][0]
    looks = itertools.product("os^D", _COLOURS)
    for name, points in curves_of_methods.items():
        seconds, psnr = ([point[key] for point in points] for key in ("seconds", "psnr affine"))
        if not points:
            continue
        if name == "oracle":
            axis.axhline(max(psnr), color="black", linestyle="--", linewidth=1, label="oracle: true noise known")
        elif name.startswith("WBP"):
            axis.plot(
                seconds,
                psnr,
                "x",
                color="grey",
                markersize=5,
                label="WBP, window by window" if name == "WBP hann" else None,
            )
        else:
            bold, stopped = name == "joint", unfinished(points)
            marker, colour = next(looks)
            style = {"linewidth": 2.6 if bold else 1.3, "marker": marker, "markersize": 5 if bold else 3.5}
            style |= {"linestyle": ":", "label": f"{name}, unfinished: {stopped}"} if stopped else {"label": name}
            if len(points) == 1:  # single points would be hidden by curves
                style |= {"linestyle": "none", "marker": "*", "markersize": 13, "markeredgecolor": "black", "zorder": 4}
            axis.plot(seconds, psnr, color=colour, **style)
    axis.set(xscale="log", xlabel="wall time (s)", ylabel="PSNR of the volume, affinely matched (dB)", title=title)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure
