"""The command `noiseflow demo`: runs the other commands on small example files and writes one report."""

from __future__ import annotations

import contextlib
import io as textio
import json as jsonlib
import shutil
import time
from collections.abc import Callable
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any

import typer

from noiseflow.commands.console import JsonOption, Output, OverwriteOption, SeedOption
from noiseflow.progress import in_json_mode_too

_FILES = (
    *("report.html", "detector.safetensors", "clean.tif", "sampled.tif", "needle.mrc", "phantom.mrc"),
    *("calibration/report.html", "needle/index.html", "phantom-report/index.html", "comparison/index.html"),
)


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for all results.")] = Path("noiseflow-demo"),
    files_only: Annotated[bool, typer.Option("--files-only", help="Only copy the example data there.")] = False,
    overwrite: OverwriteOption = False,
    seed: SeedOption = 0,
    json: JsonOption = False,
) -> None:
    """Calibrate, sample and reconstruct on the example data of the library, and write one report."""
    from noiseflow.report import Report
    from noiseflow.runs.outputs import Outputs

    output, started = Output(json), time.perf_counter()
    if files_only:
        output.result({"files": _copy_files(out, output, overwrite=overwrite)})
        return
    report = Report("noiseflow demo", "The commands shown produced all results below; run them on your own files.")
    report.text(
        "Calibrate a detector from two exposures, sample its noise, and reconstruct volumes from noisy tilt series."
    )
    with Outputs(overwrite=overwrite) as outputs, as_file(files("noiseflow") / "data") as data:
        outputs.folder(out, holds=_FILES, creates=True)
        outputs.file(out / "report.html", suffixes=frozenset({".html"}))
        outputs.options(out)
        _run_all(partial(_run, output, report, ["--overwrite"] * overwrite + ["--seed", str(seed)]), report, data, out)
        page = report.save(out / "report.html")
    output.line(f"\ndone in {time.perf_counter() - started:.0f} s; open the report: {page.resolve()}")
    output.result({"report": page.resolve(), "seconds": time.perf_counter() - started})


def _copy_files(out: Path, output: Output, *, overwrite: bool) -> list[Path]:
    from noiseflow.runs.outputs import Outputs, atomic_path

    with as_file(files("noiseflow") / "data") as data, Outputs(overwrite=overwrite) as outputs:
        names = sorted(path.relative_to(data) for path in data.rglob("*") if path.is_file())
        outputs.folder(out, holds=list(map(str, names)), creates=True)
        for name in names:
            outputs.folder(out / name.parent, creates=True)
            with atomic_path(out / name) as partial:
                shutil.copyfile(data / name, partial)
            output.line(str(out / name))
    return [out / name for name in names]


def _run_all(run: Callable[..., dict[str, Any]], report: Any, data: Path, out: Path) -> None:
    from noiseflow import io

    short, long = data / "exposures_miro" / "channel1_050ms.tif", data / "exposures_miro" / "channel1_long.tif"
    model, clean, noisy = out / "detector.safetensors", out / "clean.tif", out / "sampled.tif"
    calibration = run("calibrate", short, long, "-o", model, "--report", out / "calibration")
    # the long exposure at the scale of the short one: a nearly noise-free image in detector units
    scale = calibration["registration"][0]
    scaled = scale["slope"] * io.read_image(long).astype("float32") + scale["intercept"]
    io.write(clean, scaled.astype("float32"))
    run("sample", model, clean, "-o", noisy)
    _draw_samples(report, short, clean, noisy)
    needle, phantom = data / "tilt_needle" / "needle_aligned.mrc", out / "phantom"
    run("reconstruct", needle, "-o", out / "needle.mrc", "--mode", "linear", "--report", out / "needle")
    run("simulate", phantom, "--size", "64")
    tilts, truth, volume = phantom / "tilts.mrc", phantom / "truth.mrc", out / "phantom.mrc"
    run("reconstruct", tilts, "-o", volume, "--report", out / "phantom-report", "--reference", truth)
    run("compare", volume, truth, "--report", out / "comparison")


def _run(output: Output, report: Any, more: list[str], command: str, *arguments: str | Path) -> dict[str, Any]:
    """Run a command of this program, print it, and add its report to the page."""
    from noiseflow.commands.cli import build_app

    words = [command, *map(str, arguments)]
    shown = "noiseflow " + " ".join(words)
    output.line(f"\n$ {shown}")
    report.text(f"$ {shown}", kind="command")
    words += more if command != "compare" else [word for word in more if word == "--overwrite"]
    printed = textio.StringIO()
    shown_progress = contextlib.nullcontext() if output.json_mode else in_json_mode_too()
    with contextlib.redirect_stdout(printed), shown_progress:
        build_app(command)([*words, "--json"], prog_name="noiseflow", standalone_mode=False)
    result: dict[str, Any] = jsonlib.loads(printed.getvalue().splitlines()[-1])
    if (verdict := result.get("verdict")) is not None:
        report.text(f"Verdict: {'; '.join([verdict['grade'], *verdict['reasons']])}.")
    if result.get("report"):
        report.include(result["report"])
    return result


def _draw_samples(report: Any, short: Path, clean: Path, noisy: Path) -> None:
    from noiseflow import io
    from noiseflow.report import grey_range, new_figure, show_image

    images = [io.read_image(path) for path in (clean, noisy, short)]
    (figure, axes), limits = new_figure(3), grey_range(images[2])
    middle = slice(100, 300)
    titles = ("clean (long exposure)", "sampled noise", "real short exposure")
    for axis, image, title in zip(axes[0], images, titles, strict=True):
        show_image(axis, image[middle, middle], title, limits=limits)
    report.figure(figure, caption="The sampled image should look like the real short exposure.")
