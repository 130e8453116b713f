"""The command `noiseflow calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from noiseflow.commands.console import DeviceOption, JsonOption, Output, OverwriteOption, SeedOption, choose_device
from noiseflow.commands.option_files import option_groups
from noiseflow.progress import progress_shown

if TYPE_CHECKING:
    from calibration.detector.models import ModelScore
    from calibration.detector.posterior import Interval
    from calibration.pipeline import Findings
    from calibration.registration.aligned import AlignedPair


@option_groups(
    {
        "Input": ("flat_time", "dark_time", "exposure_ratio"),
        "Advanced": ("kind", "seed", "device", "json", "overwrite"),
    }
)
def calibrate(
    output: Annotated[Path, typer.Option("--output", "--out", "-o", help="Noise-model file to write, .safetensors.")],
    short: Annotated[
        list[Path] | None,
        typer.Option(
            help="Short exposures, in order. Without --long: the frames of a burst, as one stack or several files."
        ),
    ] = None,
    long: Annotated[
        list[Path] | None, typer.Option(help="Long exposures: one per short exposure, or one for all.")
    ] = None,
    dark: Annotated[
        list[Path] | None, typer.Option(help="Two or more frames taken without light; they determine the offset.")
    ] = None,
    flat: Annotated[
        list[Path] | None,
        typer.Option(help="Frames of uniform illumination. Without --short: one stack per light level (EMVA 1288)."),
    ] = None,
    flat_time: Annotated[
        list[float] | None, typer.Option(help="Exposure time of each --flat level, in seconds.")
    ] = None,
    dark_time: Annotated[
        list[float] | None, typer.Option(help="Exposure time of each --dark stack, in seconds.")
    ] = None,
    kind: Annotated[
        str,
        typer.Option(
            help="Noise model: auto, gaussian, poisson, poisson-gaussian, excess-noise, signal-gaussian, mixture, flow, "
            "spline, physics-flow."
        ),
    ] = "auto",
    exposure_ratio: Annotated[
        float | None,
        typer.Option(
            help="Ratio of the long to the short exposure time, at the same detector setting; it determines the offset."
        ),
    ] = None,
    channel: Annotated[
        str | None, typer.Option(help="Name or index of the channel or image to read of files that hold several.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder to write report.html, detector.csv and detector.json to.")
    ] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
) -> None:
    """Measure a detector's gain, offset and read noise and fit a noise model, from exposure pairs, bursts, or flats and darks."""
    inputs = [*(short or []), *(long or []), *(dark or []), *(flat or [])]
    with progress_shown(json_mode=json) as progress:
        progress("Reading exposures", 0, 1, "")  # before the imports, which take most of a second
        from calibration import calibrate_exposures, read_burst, read_pairs, simplest_sufficient
        from calibration.camera import MAPS, map_path
        from calibration.detector.models import SIMPLE, require_kind
        from calibration.report.exports import FILES
        from noiseflow.io import check_folder, check_output, require_other
        from noiseflow.io.model_files import MODEL_SUFFIXES

        check_output(output, suffixes=MODEL_SUFFIXES, overwrite=overwrite)
        require_other(output, *inputs)
        if report is not None:
            check_folder(report, holds=FILES, beside=[output], overwrite=overwrite)
        require_kind(kind)
        for path in () if short else (map_path(output, name) for name in MAPS):
            check_output(path, overwrite=overwrite)
            require_other(path, *inputs)
        if short:
            _require_fitting(long, flat_time, dark_time, exposure_ratio)
            exposures = (
                read_pairs(short, long, exposure_ratio=exposure_ratio, channel=channel)
                if long
                else read_burst(short, channel=channel)
            )
            findings = calibrate_exposures(
                exposures,
                dark=read_burst(dark, name="the dark frames", calibration=True, channel=channel) if dark else None,
                flat=read_burst(flat, name="the flat frames", calibration=True, channel=channel) if flat else None,
                kinds=None if kind == "auto" else [*SIMPLE, *({kind} - set(SIMPLE))],
                seed=seed,
                device=_device(device),
                progress=progress,
            )
    if not short:
        _calibrate_camera(flat or [], dark or [], flat_time, dark_time, channel, output, report, seed, Output(json))
        return
    import noiseflow
    from calibration.pipeline import saved_model
    from calibration.report.figures import LABELS
    from calibration.report.page import write_report

    scores = findings.scores
    best = simplest_sufficient(scores) if kind == "auto" else next(score for score in scores if score.name == kind)
    model = saved_model(best.model, findings)
    page = None if report is None else write_report(report, findings, inputs=inputs, seed=seed)
    provenance = {"short": short, "long": long or [], "seed": seed, "nll": best.nll} | {"detector": _detector(findings)}
    noiseflow.save(model, output, units="counts", provenance=provenance)
    out = Output(json)
    _report(out, findings)
    out.line(f"Noise model ({LABELS[best.name]}): {output}" + (f"\nReport: {page}" if page else ""))
    out.result({"model": output, "kind": best.name, "report": page} | summary(findings))


def _require_fitting(
    long: list[Path] | None, flat_time: list[float] | None, dark_time: list[float] | None, exposure_ratio: float | None
) -> None:
    """Reject options that do not apply to exposures of a scene."""
    if flat_time or dark_time:
        raise ValueError(
            "--flat-time and --dark-time apply only to a calibration from flats and darks; remove --short or the times"
        )
    if not long and exposure_ratio is not None:
        raise ValueError(
            "--exposure-ratio requires --long, because the exposures of a burst are equal; add --long or remove the ratio"
        )


def _calibrate_camera(
    flat: list[Path],
    dark: list[Path],
    flat_time: list[float] | None,
    dark_time: list[float] | None,
    channel: str | None,
    output: Path,
    report: Path | None,
    seed: int,
    out: Output,
) -> None:
    """Calibrate from flats and darks: report EMVA 1288 figures, and write maps next to the model file."""
    import noiseflow
    from calibration.camera import calibrate_camera, rows_of, summary_of, write_maps
    from calibration.exposures.frames import read_burst, read_levels
    from calibration.report.camera_page import write_camera_report
    from calibration.report.page import describe_verdict

    if not flat:
        raise ValueError(
            "neither --short nor --flat was given; give exposures of a scene, or flat frames at several light levels"
        )
    darks = []
    if dark:
        darks = (
            read_levels(dark, name="the dark frames", channel=channel)
            if dark_time
            else [read_burst(dark, name="the dark frames", calibration=True, channel=channel)]
        )
    camera = calibrate_camera(
        read_levels(flat, channel=channel), darks, flat_times=flat_time or None, dark_times=dark_time or None
    )
    page = None if report is None else write_camera_report(report, camera, inputs=[*flat, *dark], seed=seed)
    found = summary_of(camera)
    noiseflow.save(
        camera.model, output, units="counts", provenance={"flat": flat, "dark": dark, "camera": found["camera"]}
    )
    maps = write_maps(camera, output)
    out.table(("figure", "value"), rows_of(camera))
    out.line("\n" + "\n".join(describe_verdict(camera.verdict)))
    out.line(
        f"Noise model: {output}; maps: {', '.join(path.name for path in maps)}" + (f"\nReport: {page}" if page else "")
    )
    out.result({"model": output, "maps": maps, "report": page} | found)


def summary(findings: Findings) -> dict[str, Any]:
    """Return the findings as plain values: those of `said`, ``detector``, ``registration``, ``models``, ``burst``."""
    from calibration.detector.models import foremost
    from calibration.verdict import said

    found: dict[str, Any] = {
        **said(findings.verdict),
        "detector": _detector(findings),
        "registration": [_registration(pair) for pair in findings.pairs],
        "models": {score.name: _figures(score, score in foremost(findings.scores)) for score in findings.scores},
    }
    if findings.burst is not None:
        found["burst"] = vars(findings.burst)
    return found


def _device(name: str) -> Any:
    """Return the device to fit on, and limit a CPU to one thread: batches of a few thousand pixels gain nothing from more."""
    import torch

    chosen = choose_device(name)
    if chosen.type == "cpu":
        torch.set_num_threads(1)
    return chosen


def _report(out: Output, findings: Findings) -> None:
    from calibration.report.page import (
        TABLE_HEADER,
        describe_burst,
        describe_detector,
        describe_registration,
        judge,
        table_rows,
    )

    if findings.burst is not None:
        out.line(describe_burst(findings.burst))
    for number, pair in enumerate(findings.pairs if findings.burst is None else [], 1):
        out.line(f"Pair {number}: {describe_registration(pair)}")
    out.line("\nDetector: " + describe_detector(findings))
    out.line("\nDivergences in units of 1e-4; floor: expected value for samples drawn from the model itself")
    out.table(TABLE_HEADER, table_rows(findings.scores))
    out.line("\n" + "\n".join(judge(findings)))


def _detector(findings: Findings) -> dict[str, Any] | None:
    from calibration.detector.measure import EXCESS_NOISE
    from calibration.report.page import unknown_read_noise

    detector, figures = findings.detector, findings.figures
    if detector is None or figures is None:
        return None

    def interval(value: Interval | None) -> dict[str, float] | None:
        return None if value is None else vars(value)

    found = detector.posterior
    return {
        "gain": interval(figures.gain),
        "gain_if_linear": interval(figures.linear),
        "response": {name: getattr(detector.response, name) for name in ("exponent", "error", "known")},
        "offset": interval(figures.offset),
        "read_noise": interval(figures.read_noise),
        "source": figures.source,
        "correlation_factor": figures.factor,
        "rhat": found.rhat,
        "effective_samples": found.effective,
        "num_draws": found.num_draws,
        "misfit": detector.misfit,
        "photon_transfer_gain": detector.line.gain,
        "offset_measured": detector.offset is not None,
        "read_noise_identifiable": not unknown_read_noise(figures),
        "caveat": EXCESS_NOISE,
    }


def _registration(pair: AlignedPair) -> dict[str, Any]:
    from calibration.detector.residual import structured_share

    found = pair.registration
    names = ("rms_px", "error_px", "inliers", "matches", "matrix", "method", "motion", "rotation", "scale", "inverted")
    scaling = {
        "slope": pair.scaling.slope,
        "intercept": pair.scaling.intercept,
        "exposure_ratio": 1 / pair.scaling.slope,
    }
    values = {name: getattr(found, name) for name in names} | {"shift": found.shift(pair.short.shape)}
    return values | scaling | {"structured_share": structured_share(pair), "masked": vars(pair.counts)}


def _figures(score: ModelScore, compared: bool) -> dict[str, Any]:
    likelihood = {name: getattr(score, name) for name in ("nll", "nll_error", "excess", "excess_error")}
    if not compared:
        return likelihood
    judged, overall = score.evaluation, score.evaluation.overall
    by_signal = {"jsd_by_signal": judged.mean_jsd, "jsd_by_signal_floor": judged.mean_jsd_floor}
    return (
        likelihood
        | vars(overall)
        | by_signal
        | {"ks": judged.ks, "ks_floor": judged.ks_floor, "tails": [vars(one) for one in judged.tails]}
    )
