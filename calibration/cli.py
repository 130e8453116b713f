"""The command `noiseflow calibrate`."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from noiseflow.commands.console import (
    DeviceOption,
    JsonOption,
    Output,
    OverwriteOption,
    SeedOption,
    choose_device,
    completed,
    group,
    output_file,
    with_options,
)
from noiseflow.progress import Progress, progress_shown
from noiseflow.resources import kept_memory
from noiseflow.runs.outputs import TENSORS, Outputs

if TYPE_CHECKING:
    from torch import nn

    from calibration.camera import Figure
    from noiseflow.checks import Verdict

_GIVEN, _INPUT, _MODEL = group(), group("Input"), group("Model")
_Files = list[Path] | None


@dataclass(frozen=True)
class Options:
    """Arguments and options of the command."""

    output: Annotated[Path, output_file("Noise-model file to write, .safetensors.", TENSORS)]
    exposures: Annotated[
        _Files,
        typer.Argument(
            metavar="SHORT LONG",
            help="A short and a long exposure of one scene; or the frames of a burst, as one stack.",
        ),
    ] = None
    short: Annotated[
        _Files,
        _GIVEN("Short exposures, in order. Without --long: the frames of a burst, as one stack or several files."),
    ] = None
    long: Annotated[_Files, _GIVEN("Long exposures: one per short exposure, or one for all.")] = None
    dark: Annotated[_Files, _GIVEN("Two or more frames taken without light; they determine the offset.")] = None
    flat: Annotated[
        _Files, _GIVEN("Frames of uniform illumination. Without exposures: one stack per light level (EMVA 1288).")
    ] = None
    report: Annotated[Path | None, _GIVEN("Folder to write report.html, detector.csv and detector.json to.")] = None
    series: Annotated[
        Path | None, _GIVEN("Table (.csv) of several settings to add this one to, with a chart of the gains beside it.")
    ] = None
    setting: Annotated[
        float | None, typer.Option(help="ISO number, amplifier gain or multiplication of the exposures, for --series.")
    ] = None
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Also print registration, sampling and the scores of all noise models.")
    ] = False
    flat_time: Annotated[list[float] | None, _INPUT("Exposure time of each --flat level, in seconds.")] = None
    dark_time: Annotated[list[float] | None, _INPUT("Exposure time of each --dark stack, in seconds.")] = None
    exposure_ratio: Annotated[
        float | None,
        _INPUT("Ratio of the long to the short exposure time, at the same detector setting; it determines the offset."),
    ] = None
    offset: Annotated[
        float | None,
        _INPUT("Counts without light, if known and there are no --dark frames; 0 if dark frames were subtracted."),
    ] = None
    channel: Annotated[
        str | None, _INPUT("Name or index of the channel or image to read of files that hold several.")
    ] = None
    region: Annotated[
        str | None, _INPUT("Part of all frames to use, y0:y1,x0:x1 in pixels: a static scene, one half of a sensor.")
    ] = None
    kind: Annotated[
        str,
        _MODEL(
            "Noise model: auto, gaussian, poisson, counting, poisson-gaussian, excess-noise, signal-gaussian, mixture, flow, "
            "spline, physics-flow (which may shift the mean).",
            autocompletion=completed(
                "auto", "poisson-gaussian", "excess-noise", "mixture", "flow", "spline", "physics-flow"
            ),
        ),
    ] = "auto"
    overwrite: OverwriteOption = False
    json: JsonOption = False
    seed: SeedOption = 0
    device: DeviceOption = "auto"

    def scene(self) -> tuple[list[Path], list[Path]]:
        """Short and long exposures of a scene. Raises ValueError if options contradict each other."""
        if (self.series is None) != (self.setting is None) or not math.isfinite(self.setting or 0.0):
            raise ValueError("--series and --setting belong together: give the table, and the setting, a number")
        given, short, long = self.exposures or [], self.short or [], self.long or []
        if given and (short or long or len(given) > 2):
            raise ValueError(f"{' '.join(map(str, given))}: give a short and a long exposure, or --short and --long")
        short, long = (short, long) if not given else (given[:1], given[1:])
        if not short and not self.flat:
            raise ValueError("neither --short nor --flat was given; give exposures of a scene, or flats")
        if short and (self.flat_time or self.dark_time):
            raise ValueError("--flat-time and --dark-time apply only to flats and darks; remove --short or the times")
        if self.offset is not None and (self.dark or not short or not math.isfinite(self.offset)):
            raise ValueError("--offset is a number of counts, for a scene without --dark; remove one of the options")
        if short and not long and self.exposure_ratio is not None:
            raise ValueError("--exposure-ratio requires --long: frames of a burst are equal; add --long, or remove it")
        return short, long


@dataclass(frozen=True)
class _Calibrated:
    """A calibration: what is written, printed and returned."""

    model: nn.Module
    name: str
    verdict: Verdict
    figures: str
    provenance: dict[str, Any]
    result: Callable[[], dict[str, Any]]
    write_report: Callable[[Path], Path]
    print_details: Callable[[Output], None]
    table: Callable[[], list[Figure]]
    write_maps: Callable[[Path], list[Path]] | None = None


@with_options
def calibrate(options: Options) -> None:
    """Measure a detector's gain, offset and read noise and fit a noise model, from exposure pairs, bursts, or flats and darks."""
    short, long = options.scene()
    inputs = [*short, *long, *(options.dark or []), *(options.flat or [])]
    with progress_shown(json_mode=options.json) as progress, kept_memory():
        progress("Reading exposures", 0, 1, "")  # before the imports, which take most of a second
        gc.disable()  # imports leave no unreachable cycles; to search for them takes 0.2 s
        import noiseflow
        from calibration.camera import MAPS, map_path
        from calibration.detector.models import require_kind
        from calibration.report.exports import FILES, add_to_series, read_series

        gc.freeze()  # the first search would look at all that was imported, for 0.07 s
        gc.enable()
        require_kind(options.kind)
        if options.series is not None:
            read_series(options.series)
        with Outputs(*inputs, overwrite=options.overwrite) as outputs:
            outputs.file(options.output, suffixes=TENSORS)
            outputs.folder(options.report, holds=FILES)
            for name in () if short else MAPS:
                outputs.file(map_path(options.output, name))
            outputs.options(options.output)
            found = _of_scene(options, short, long, progress) if short else _of_camera(options)
            page = None if options.report is None else found.write_report(options.report)
            noiseflow.save(found.model, options.output, units="counts", provenance=found.provenance)
            maps = [] if found.write_maps is None else found.write_maps(options.output)
            if options.series is not None and options.setting is not None:
                add_to_series(options.series, options.setting, found.table(), found.verdict.grade)
    out, (first, *more) = Output(options.json), found.verdict.reasons
    out.line(f"verdict: {found.verdict.grade}. {first[0].upper()}{first[1:]}")
    out.line(found.figures)
    written = [f"noise model{found.name}: {options.output}", *(f"map: {path}" for path in maps)]
    written += [f"{kind}: {path}" for kind, path in (("series", options.series), ("report", page)) if path]
    out.line("; ".join(written))
    for reason in more:
        out.line(f"  - {reason}")
    if options.verbose:
        found.print_details(out)
    if options.json:
        out.result({"model": options.output, "report": page} | ({"maps": maps} if maps else {}) | found.result())


def _of_scene(options: Options, short: list[Path], long: list[Path], progress: Progress) -> _Calibrated:
    from calibration import calibrate_exposures, read_burst, read_pairs, simplest_sufficient
    from calibration.detector.models import SIMPLE
    from calibration.exposures.frames import cropped
    from calibration.pipeline import saved_model
    from calibration.report.exports import detector_summary, figures_of_exposures, summary
    from calibration.report.page import interval_line, named_figures, print_details, write_report

    frames: dict[str, Any] = {"calibration": True, "channel": options.channel}
    dark, flat, kind, seed = options.dark, options.flat, options.kind, options.seed
    part = partial(cropped, region=options.region)
    findings = calibrate_exposures(
        part(read_pairs(short, long, exposure_ratio=options.exposure_ratio, channel=options.channel))
        if long
        else part(read_burst(short, channel=options.channel)),
        dark=part(read_burst(dark, name="the dark frames", **frames)) if dark else None,
        flat=part(read_burst(flat, name="the flat frames", **frames)) if flat else None,
        offset=options.offset,
        kinds=None if kind == "auto" else [*SIMPLE, *({kind} - set(SIMPLE))],
        seed=seed,
        device=_device(options.device),
        progress=progress,
    )
    scores = findings.scores
    best = simplest_sufficient(scores) if kind == "auto" else next(score for score in scores if score.name == kind)
    inputs = [*short, *long, *(dark or []), *(flat or [])]
    return _Calibrated(
        saved_model(best.model, findings),
        f" ({best.label})",
        findings.verdict,
        f"not measured: {findings.no_detector}"
        if findings.figures is None
        else interval_line(named_figures(findings.figures)),
        {"short": short, "long": long, "seed": seed, "nll": best.nll, "detector": detector_summary(findings)},
        lambda: {"kind": best.name} | summary(findings),
        partial(write_report, findings=findings, inputs=inputs, seed=seed),
        partial(print_details, findings),
        partial(figures_of_exposures, findings),
    )


def _of_camera(options: Options) -> _Calibrated:
    """Calibrate from flats and darks: EMVA 1288 figures, and maps next to the model file."""
    from calibration.camera import calibrate_camera, figures_of_camera, summary_of, write_maps
    from calibration.exposures.frames import cropped, read_burst, read_levels
    from calibration.report.page import intervals_of_camera, write_camera_report

    flat, dark, channel, read = options.flat or [], options.dark or [], options.channel, []
    if dark:
        named: dict[str, Any] = {"name": "the dark frames", "channel": channel}
        read = read_levels(dark, **named) if options.dark_time else [read_burst(dark, calibration=True, **named)]
    times: dict[str, Any] = {"flat_times": options.flat_time or None, "dark_times": options.dark_time or None}
    levels = cropped(read_levels(flat, channel=channel), options.region)
    camera = calibrate_camera(levels, cropped(read, options.region), **times)
    found = summary_of(camera)
    return _Calibrated(
        camera.model,
        "",
        camera.verdict,
        intervals_of_camera(camera),
        {"flat": flat, "dark": dark, "camera": found["camera"]},
        lambda: found,
        partial(write_camera_report, camera=camera, inputs=[*flat, *dark], seed=options.seed),
        lambda out: out.table(("figure", "value"), [one.row for one in figures_of_camera(camera)]),
        partial(figures_of_camera, camera),
        partial(write_maps, camera),
    )


def _device(name: str) -> Any:
    """Return the device to fit on, and limit a CPU to one thread: batches of a few thousand pixels gain nothing from more."""
    import torch

    chosen = choose_device(name)
    if chosen.type == "cpu":
        torch.set_num_threads(1)
    return chosen
