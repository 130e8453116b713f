"""The command `noiseflow calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from noiseflow.console import DeviceOption, JsonOption, Output, SeedOption, choose_device, progress_bar

if TYPE_CHECKING:
    from calibration.aligned import AlignedPair
    from calibration.models import ModelScore


def calibrate(
    short: Annotated[list[Path], typer.Option(help="Short exposures, in order; alone, a stack or files of one burst.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Noise-model file to write, .safetensors.")],
    long: Annotated[list[Path] | None, typer.Option(help="Long exposures: one per short one, or one for all.")] = None,
    kind: Annotated[str, typer.Option(help="auto, or the model to save: gaussian, poisson, …, flow, spline.")] = "auto",
    exposure_ratio: Annotated[
        float | None, typer.Option(help="Long over short, if both come from one detector setting.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Folder for report.html.")] = None,
    json: JsonOption = False,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
) -> None:
    """Learn a detector's noise from short and long exposures of one scene."""
    import noiseflow
    from calibration import align_pair, collect_pixels, fit_models, read_pairs, simplest_sufficient
    from calibration.models import KINDS, NUM_STEPS, require_kind
    from calibration.report import TABLE_HEADER, describe_registration, table_rows, verdict, write_report
    from noiseflow.io import check_output
    from noiseflow.model_files import MODEL_SUFFIXES

    out = Output(json)
    check_output(output, suffixes=MODEL_SUFFIXES)
    require_kind(kind)
    chosen_device = _device(device)
    pairs = [align_pair(pair) for pair in read_pairs(short, long or [], exposure_ratio=exposure_ratio)]
    for name, pair in zip(short, pairs, strict=True):
        out.line(f"{name}: {describe_registration(pair)}")
    pixels = collect_pixels(pairs, seed=seed)
    with progress_bar("Fitting noise models", NUM_STEPS * len(KINDS), json_mode=json) as progress:
        scores = fit_models(pixels, seed=seed, device=chosen_device, progress=progress)
    best = simplest_sufficient(scores) if kind == "auto" else next(score for score in scores if score.name == kind)
    out.line("\nDivergences in units of 1e-4, each beside what the model's own samples would give")
    out.table(TABLE_HEADER, table_rows(scores))
    out.line(f"\n{verdict(scores)}")
    page = None if report is None else write_report(report, pairs, pixels, scores, title="Detector calibration")
    provenance = {"short": [str(p) for p in short], "long": [str(p) for p in long or []], "seed": seed, "nll": best.nll}
    noiseflow.save(best.model, output, units="counts", provenance=provenance)
    out.line(f"Noise model ({best.name}): {output}" + (f"\nReport: {page}" if page else ""))
    out.result(_summary(pairs, scores, best, output, page))


def _device(name: str) -> Any:
    """The device to fit on; on the processor with one thread, because batches of some thousand pixels gain nothing
    from more."""
    import torch

    chosen = choose_device(name)
    if chosen.type == "cpu":
        torch.set_num_threads(1)
    return chosen


def _summary(
    pairs: list[AlignedPair], scores: list[ModelScore], best: ModelScore, output: Path, page: Path | None
) -> dict[str, Any]:
    return {
        "model": output,
        "kind": best.name,
        "report": page,
        "registration": [_registration(pair) for pair in pairs],
        "models": {score.name: _figures(score) for score in scores},
    }


def _registration(pair: AlignedPair) -> dict[str, Any]:
    found = pair.registration
    return {
        "rms_px": found.rms_px,
        "error_px": found.error_px,
        "inliers": found.inliers,
        "matches": found.matches,
        "matrix": found.matrix,
        "method": found.method,
        "motion": found.motion,
        "shift": found.shift(pair.short.shape),
        "rotation": found.rotation,
        "scale": found.scale,
        "slope": pair.scaling.slope,
        "intercept": pair.scaling.intercept,
        "masked": vars(pair.counts),
    }


def _figures(score: ModelScore) -> dict[str, Any]:
    judged, overall = score.evaluation, score.evaluation.overall
    likelihood = {name: getattr(score, name) for name in ("nll", "nll_error", "excess", "excess_error")}
    by_signal = {"jsd_by_signal": judged.mean_jsd, "jsd_by_signal_floor": judged.mean_jsd_floor}
    return likelihood | vars(overall) | by_signal | {"ks": judged.ks, "ks_floor": judged.ks_floor}
