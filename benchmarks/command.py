"""The command `noiseflow benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from noiseflow.commands.console import JsonOption, Output, OverwriteOption, SeedOption, choose_device


def benchmark(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Benchmarks to run: rivals, slow-rivals, resolution, paper-table, ablations, needle, sabotage; "
            "the first by default."
        ),
    ] = None,
    size: Annotated[int | None, typer.Option(help="Voxels along each edge; 64, or 48 with --quick.")] = None,
    noise: Annotated[str, typer.Option(help="Noise of the scene, as in `noiseflow simulate`.")] = "clipped",
    phantom: Annotated[str, typer.Option(help="Volume of the scene, as in `noiseflow simulate`.")] = "shells",
    quick: Annotated[
        bool, typer.Option("--quick", help="Use a small scene and few settings; takes less than three minutes.")
    ] = False,
    device: Annotated[
        str, typer.Option(help="Device of the fits of paper-table and ablations: auto, cpu or cuda.")
    ] = "cpu",
    method: Annotated[str | None, typer.Option(help="Method of sabotage; sirt by default.")] = None,
    repeats: Annotated[int, typer.Option(help="Repeats of every timed curve; medians are reported.")] = 3,
    budget: Annotated[float, typer.Option(help="Seconds for each of the slow methods.")] = 600.0,
    again: Annotated[str, typer.Option(help="Recompute stored results whose name contains this text.")] = "",
    out: Annotated[
        Path, typer.Option("--out", help="Folder for results and figures; an interrupted run resumes there.")
    ] = Path("noiseflow-benchmark"),
    overwrite: OverwriteOption = False,
    seed: SeedOption = 0,
    json: JsonOption = False,
) -> None:
    """Measure run time against error of every method, on this machine. Interrupted runs resume."""
    from dataclasses import replace

    from benchmarks.named import BENCHMARKS, Options, check_figures
    from benchmarks.rivals import QUICK, Effort

    output = Output(json)
    names = names or ["rivals"]
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        raise ValueError(f"benchmark '{unknown[0]}': choose from {', '.join(BENCHMARKS)}")
    if repeats < 1:
        raise ValueError(f"--repeats {repeats} must be at least 1")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; name a folder with --out")
    _check_scene(size, noise, phantom)
    _check_method(method, names)
    out.mkdir(parents=True, exist_ok=True)
    effort = QUICK if quick else replace(Effort(), repeats=repeats, budget=budget)
    scene = {"noise": noise, "phantom": phantom, "seed": seed}
    if quick:
        scene["tilts"] = "-60:60:4"
    options = Options(
        size or (48 if quick else 64), scene, effort, again, out, output, overwrite, method, str(choose_device(device))
    )
    check_figures(names, options)
    try:
        output.result({name: BENCHMARKS[name](options) for name in names})
    except KeyboardInterrupt:
        kept = f"finished results are kept in {out}; run the same command to resume"
        raise KeyboardInterrupt(kept) from None


def _check_method(method: str | None, names: list[str]) -> None:
    from recon.names import method_names

    if method is None:
        return
    if names != ["sabotage"]:
        raise ValueError("--method is only for the benchmark sabotage; the others run every method")
    if method not in method_names():
        raise ValueError(f"--method {method}: choose from {', '.join(method_names())}")


def _check_scene(size: int | None, noise: str, phantom: str) -> None:
    from recon.simulate.phantoms import PHANTOMS
    from recon.simulate.simulation import ACQUISITIONS

    noises = [name for name, acquisition in ACQUISITIONS.items() if acquisition.noise is not None]
    if size is not None and size < 8:
        raise ValueError(f"--size {size}: give at least 8 voxels")
    if noise not in noises:
        raise ValueError(f"--noise {noise}: a benchmark needs one of {', '.join(noises)}")
    if phantom not in PHANTOMS:
        raise ValueError(f"--phantom {phantom}: choose one of {', '.join(PHANTOMS)}")
