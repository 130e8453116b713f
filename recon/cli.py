"""The command `noiseflow reconstruct`, and the door to the others. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from noiseflow.console import DeviceOption, JsonOption, Output, SeedOption, choose_device, progress_bar
from recon.commands.compare import compare as compare
from recon.commands.options import load_noise_model, parse_mode
from recon.commands.simulate import simulate as simulate

if TYPE_CHECKING:
    from recon.methods import Outcome
    from recon.tilt_series import TiltSeries


def reconstruct(
    tilts: Annotated[
        Path,
        typer.Argument(help="Tilt series (tilt, y, x): .mrc, .st, .ali, .tif, .npy, .dm3 …, or a folder of images."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Volume to write: .mrc, .rec, .tif, .npy or .zarr.")],
    angles: Annotated[
        Path | None,
        typer.Option(help="Angle file; by default the .rawtlt, .tlt or .mdoc beside the stack, or its own."),
    ] = None,
    transforms: Annotated[Path | None, typer.Option(help="IMOD's .xf alignment to apply to the stack.")] = None,
    method: Annotated[
        str,
        typer.Option(
            help="auto, joint, joint-supervised, l2, l1, tv, explicit, l2-denoised, wbp-denoised, sirt or wbp."
        ),
    ] = "auto",
    mode: Annotated[str, typer.Option(help="transmission (bright field) or linear (HAADF, EDX).")] = "transmission",
    thickness: Annotated[
        int | None, typer.Option(help="Depth of the volume in voxels; the image width by default.")
    ] = None,
    weight: Annotated[float | None, typer.Option(help="Weight of the total variation.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of the fit, or iterations.")] = None,
    window: Annotated[
        str | None,
        typer.Option(help="Of wbp: ramp, shepp-logan, cosine, hamming or hann; chosen by itself if not given."),
    ] = None,
    denoiser: Annotated[
        str, typer.Option(help="Of the denoised methods: nlm, tv, wavelet, wiener, bm3d, or package.module:function.")
    ] = "nlm",
    noise_model: Annotated[Path | None, typer.Option(help="Calibrated noise model to keep fixed.")] = None,
    save_noise_model: Annotated[Path | None, typer.Option(help="Write the learnt noise model here.")] = None,
    invert_tilt: Annotated[bool, typer.Option("--invert-tilt", help="Flip the sign of the tilt angles.")] = False,
    report: Annotated[Path | None, typer.Option(help="Folder for an HTML report.")] = None,
    fsc: Annotated[
        bool,
        typer.Option("--fsc", help="Reconstruct the even and the odd tilts too: their correlation is in the report."),
    ] = False,
    reference: Annotated[
        Path | None, typer.Option(help="Volume that the report correlates the result with, where --fsc is not given.")
    ] = None,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
    json: JsonOption = False,
) -> None:
    """Reconstruct a clean volume, and the noise model with it, from one noisy tilt series."""
    from noiseflow import io
    from recon.methods import reconstruct as run
    from recon.report import even_odd, read_reference, reconstruction_report
    from recon.tilt_series import TiltSeries, VolumeGrid, read_tilt_series

    output = Output(json)
    io.check_output(out)
    if report is not None:
        io.check_folder(report)
    tilt_series = read_tilt_series(tilts, angles=angles, transforms=transforms, mode=parse_mode(mode))
    if invert_tilt:
        tilt_series = TiltSeries(tilt_series.images, -tilt_series.tilt_angles, tilt_series.pixel_size, tilt_series.mode)
    fixed = load_noise_model(noise_model)
    grid = VolumeGrid.of(tilt_series, thickness)
    truth = None if reference is None else read_reference(reference, grid)
    solve = partial(
        run,
        grid=grid,
        method=method,
        weight=weight,
        num_steps=steps,
        window=window,
        denoiser=denoiser,
        noise_model=fixed,
        seed=seed,
        device=choose_device(device),
    )
    started = time.perf_counter()
    with progress_bar(f"reconstruct ({method})", steps or 150, json_mode=json) as progress:
        outcome = solve(tilt_series, progress=progress)
    halves = None
    if fsc and report is not None:
        first, second = (solve(half).volume for half in even_odd(tilt_series))
        halves = first, second
    rows = _figures(tilt_series, outcome, time.perf_counter() - started)
    outcome.volume.write(out)
    if save_noise_model is not None:
        _save_noise_model(outcome, save_noise_model, tilts)
    output.table(("figure", "value"), list(rows.items()))
    output.line(f"volume: {out}")
    page = None
    if report is not None:
        report.mkdir(parents=True, exist_ok=True)
        inputs = [path for path in (tilts, angles, noise_model) if path is not None]
        content = reconstruction_report(
            tilt_series, outcome, list(rows.items()), inputs=inputs, seed=seed, halves=halves, reference=truth
        )
        page = content.save(report / "index.html")
        output.line(f"report: {page}")
    fit = outcome.fit_result
    output.result(
        {"volume": out, "report": page, "method": outcome.method, "choices": outcome.choices, "figures": rows}
        | {"weights_tried": outcome.weights_tried}
        | ({"held_out_nll": fit.held_out_nll, "seconds": fit.seconds} if fit else {})
    )


def _save_noise_model(outcome: Outcome, path: Path, source: Path) -> None:
    import noiseflow

    if outcome.noise_model is None:
        raise ValueError(f"--save-noise-model: method {outcome.method} learns no noise model; use --method joint")
    noiseflow.save(outcome.noise_model, path, provenance={"tilt_series": source.name, "method": outcome.method})


def _figures(tilt_series: TiltSeries, outcome: Outcome, seconds: float) -> dict[str, str]:
    import numpy as np

    residual = tilt_series.images.astype(np.float32) - outcome.projections
    rows = {
        "method": outcome.method,
        "volume (z, y, x)": " x ".join(str(size) for size in outcome.volume.attenuation.shape),
        "voxel size (Å)": "unknown" if outcome.volume.voxel_size is None else f"{outcome.volume.voxel_size:.4g}",
        "tilts": f"{tilt_series.num_tilts}, {tilt_series.tilt_angles.min():g}° to {tilt_series.tilt_angles.max():g}°",
        "residual rms": f"{float(np.sqrt(np.mean(residual**2))):.4g}",
    }
    rows |= {
        name: f"{value:.4g}" if isinstance(value, float) else str(value) for name, value in outcome.choices.items()
    }
    if outcome.fit_result is not None:
        rows["held-out NLL (nats per pixel)"] = f"{outcome.fit_result.held_out_nll:.4f}"
    return rows | {"seconds": f"{seconds:.1f}"}
