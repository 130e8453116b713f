"""The benchmarks of `noiseflow benchmark`, one function each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks import ablations as benchmark_ablations
from benchmarks import needle as benchmark_needle
from benchmarks import paper as benchmark_paper
from benchmarks import rivals as benchmark_rivals
from benchmarks import sabotage as benchmark_sabotage
from benchmarks.rivals import Effort
from benchmarks.scenes import Results, Scene, make_scene
from noiseflow import io
from noiseflow.commands.console import Output
from noiseflow.runs.ownership import require_own, signature
from recon.methods._registry import reconstruct
from recon.metrics.metrics import fourier_shell_correlation, resolution


@dataclass(frozen=True)
class Options:
    """Options of a benchmark run.

    Attributes:
        size: voxels along each edge.
        scene: further arguments of `make_scene`.
        effort: computational effort.
        again: results whose name contains this text are computed again; none if empty.
        out: folder of results and figures.
        output: console output.
        overwrite: replace existing figures; otherwise only those that this program wrote.
        method: method of `sabotage`; None for SIRT.
        device: of the fits of `paper_table` and `ablations`.
    """

    size: int
    scene: dict[str, Any]
    effort: Effort
    again: str
    out: Path
    output: Output
    overwrite: bool = False
    method: str | None = None
    device: str = "cpu"

    def on_device(self, size: int) -> Scene:
        """The scene at a size, to be fitted on the device."""
        return replace(make_scene(size, **self.scene), device=self.device)

    def results(self, name: str) -> Results:
        """The stored results of a benchmark on this scene; each scene and effort has its own file."""
        return self._kept(name, str(self.size), *(str(value).replace(":", "_") for value in self.scene.values()))

    @property
    def quick(self) -> bool:
        """Whether to use a small scene and few settings."""
        return self.effort is benchmark_rivals.QUICK

    def _kept(self, name: str, *words: str) -> Results:
        spent = "quick" if self.quick else "full"
        results = Results(self.out / f"{'-'.join([name, *words, spent])}.json", name)
        if self.again:
            results.forget(self.again)
        return results

    def results_of_series(self, name: str, method: str) -> Results:
        """The stored results of a benchmark with its own scenes, for this size and method."""
        return self._kept(name, str(self.size), method, str(self.scene["seed"]))

    def results_on_real_data(self, name: str) -> Results:
        """The stored results of a benchmark with its own data."""
        return self._kept(name, str(self.scene["seed"]))


def check_figures(names: Sequence[str], options: Options) -> None:
    """Check before a long run that the figures of these benchmarks do not replace files of other programs.

    Raises:
        FileExistsError: a figure would replace such a file.
    """
    for name in sorted({"rivals", "slow-rivals"} & set(names)):
        require_own(_figure(options.results(name)), overwrite=options.overwrite)


def _figure(results: Results) -> Path:
    return results.path.with_suffix(".png")


def rivals(options: Options) -> dict[str, Any]:
    """Run time against error for every method that takes seconds or minutes."""
    results = options.results("rivals")
    benchmark_rivals.run(options.size, results, effort=options.effort, line=options.output.line, **options.scene)
    return _shown(options, results)


def slow_rivals(options: Options) -> dict[str, Any]:
    """Run time against error for other methods that take hours, within a time budget."""
    results = options.results("slow-rivals")
    benchmark_rivals.run_slow(options.size, results, effort=options.effort, line=options.output.line, **options.scene)
    return _shown(options, results)


def _shown(options: Options, results: Results) -> dict[str, Any]:
    found = benchmark_rivals.summary(results, options.size)
    options.output.table(*benchmark_rivals.table(found))
    picture = _figure(results)
    with io.atomic_path(picture) as partial:
        benchmark_rivals.draw(found, make_scene(options.size, **options.scene).name).savefig(
            partial, dpi=120, metadata={"Software": signature()}
        )
    options.output.line(f"results: {results.path}\nfigure: {picture}")
    return {"results": results.path, "figure": picture, "machines": results.content["machines"], "curves": found}


def even_odd(options: Options) -> dict[str, Any]:
    """Fourier shell correlation between volumes from even and odd tilts, and between each method's volume and the truth."""
    scene, results = make_scene(options.size, **options.scene), options.results("resolution")
    steps = 60 if options.quick else None

    def cell(method: str) -> dict[str, Any]:
        whole, even, odd = (
            reconstruct(scene.noisy.select(tilts), scene.grid, method=method, num_steps=steps).volume.attenuation
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


def paper_table(options: Options) -> dict[str, Any]:
    """The main table of Kniesel et al. (CVPR 2022) compared with the published values."""
    scene, results = options.on_device(options.size), options.results("paper-table")
    options.output.line(f"{scene.name}: settings of the other methods are tuned against the ground truth")
    benchmark_paper.run(scene, results, options.output.line)
    return _told(options, results, benchmark_paper.table(results.cells))


def ablations(options: Options) -> dict[str, Any]:
    """Ablations of the reconstruction."""
    scene, results = options.on_device(options.size), options.results("ablations")
    large = options.size if options.device.startswith("cuda") else benchmark_ablations.OF_NETWORKS
    small = options.on_device(min(options.size, large))
    options.output.line(scene.name)
    benchmark_ablations.run(scene, results, options.output.line, quick=options.quick, small=small)
    return _told(options, results, benchmark_ablations.table(results.cells))


def needle(options: Options) -> dict[str, Any]:
    """Every method on a real tilt series, evaluated on held-out tilts."""
    results = options.results_on_real_data("needle")
    benchmark_needle.run(results, options.output.line, quick=options.quick, seed=options.scene["seed"])
    return _told(options, results, benchmark_needle.table(results.cells))


def sabotage(options: Options) -> dict[str, Any]:
    """Tilt series with deliberate defects: whether the verdict detects them and names the reason."""
    method = options.method or "sirt"
    results = options.results_of_series("sabotage", method)
    benchmark_sabotage.run(
        results,
        options.output.line,
        size=options.size,
        method=method,
        seed=options.scene["seed"],
        quick=options.quick,
    )
    return _told(options, results, benchmark_sabotage.table(results.cells))


def _told(options: Options, results: Results, table: tuple[tuple[str, ...], list[tuple[str, ...]]]) -> dict[str, Any]:
    options.output.table(*table)
    options.output.line(f"results: {results.path}")
    return {"results": results.path, "machines": results.content["machines"], "cells": results.cells}


BENCHMARKS: dict[str, Callable[[Options], dict[str, Any]]] = {
    "rivals": rivals,
    "slow-rivals": slow_rivals,
    "resolution": even_odd,
    "paper-table": paper_table,
    "ablations": ablations,
    "needle": needle,
    "sabotage": sabotage,
}
"""Benchmarks by name."""
