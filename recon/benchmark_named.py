"""The benchmarks that `noiseflow benchmark` knows by name. A benchmark is added by one function here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from noiseflow import io
from noiseflow.console import Output
from recon import benchmark_rivals
from recon.benchmark import Results, make_scene
from recon.benchmark_rivals import Effort
from recon.classical import part_of
from recon.methods import reconstruct
from recon.metrics import fourier_shell_correlation, resolution


@dataclass(frozen=True)
class Options:
    """What to run and where to put it.

    Attributes:
        size: voxels along each edge.
        scene: further arguments of `make_scene`.
        effort: how much to spend.
        out: folder of results and figures.
        output: tells people what is going on.
    """

    size: int
    scene: dict[str, Any]
    effort: Effort
    out: Path
    output: Output

    def results(self, name: str) -> Results:
        """The kept results of a benchmark on this scene; another scene or effort has another file."""
        spent = "quick" if self.effort is benchmark_rivals.QUICK else "full"
        words = [name, str(self.size), *(str(value).replace(":", "_") for value in self.scene.values()), spent]
        return Results(self.out / f"{'-'.join(words)}.json", name)


def rivals(options: Options) -> dict[str, Any]:
    """Run time against error of every method that takes seconds or minutes."""
    results = options.results("rivals")
    benchmark_rivals.run(options.size, results, effort=options.effort, line=options.output.line, **options.scene)
    return _shown(options, results)


def slow_rivals(options: Options) -> dict[str, Any]:
    """The rivals that take hours, as far as the budget goes."""
    results = options.results("slow-rivals")
    benchmark_rivals.run_slow(options.size, results, effort=options.effort, line=options.output.line, **options.scene)
    return _shown(options, results)


def _shown(options: Options, results: Results) -> dict[str, Any]:
    found = benchmark_rivals.summary(results, options.size)
    options.output.table(*benchmark_rivals.table(found))
    picture = results.path.with_suffix(".png")
    with io.atomic_path(picture) as partial:
        benchmark_rivals.draw(found, make_scene(options.size, **options.scene).name).savefig(partial, dpi=120)
    options.output.line(f"results: {results.path}\nfigure: {picture}")
    return {"results": results.path, "figure": picture, "machine": results.content["machine"], "curves": found}


def even_odd(options: Options) -> dict[str, Any]:
    """Fourier shell correlation of volumes from even and from odd tilts, and of each method's volume with the truth."""
    scene, results = make_scene(options.size, **options.scene), options.results("resolution")
    steps = None if options.effort is not benchmark_rivals.QUICK else 60

    def cell(method: str) -> dict[str, Any]:
        whole, even, odd = (
            reconstruct(part_of(scene.noisy, tilts), scene.grid, method=method, num_steps=steps).volume.attenuation
            for tilts in (slice(None), slice(0, None, 2), slice(1, None, 2))
        )
        halves, truth = fourier_shell_correlation(even, odd), fourier_shell_correlation(whole, scene.truth)
        return {"halves 0.143": resolution(*halves, 0.143), "truth 0.5": resolution(*truth, 0.5)}

    rows = []
    for method in ("wbp", "sirt", "tv", "l2", "joint"):
        found = results.cell(method, lambda m=method: cell(m))  # type: ignore[misc]
        rows.append((method, *(f"{value:.3f}" for value in list(found.values())[:2])))
    options.output.line(f"{scene.name}: resolution in cycles per voxel")
    options.output.table(("method", "even against odd tilts, 0.143", "against the truth, 0.5"), rows)
    return {"results": results.path, "cells": results.cells}


BENCHMARKS: dict[str, Callable[[Options], dict[str, Any]]] = {
    "rivals": rivals,
    "slow-rivals": slow_rivals,
    "resolution": even_odd,
}
"""Benchmarks by name."""
