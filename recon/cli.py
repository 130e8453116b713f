"""The commands `noiseflow simulate`, `reconstruct` and `compare`. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from noiseflow.console import DeviceOption, JsonOption, Output, SeedOption, choose_device, progress_bar

if TYPE_CHECKING:
    from torch import nn

    from recon.methods import Outcome
    from recon.simulation import Acquisition
    from recon.tilt_series import Mode, TiltSeries


def simulate(
    folder: Annotated[Path, typer.Argument(help="New folder for tilts.mrc, tilts.rawtlt, clean.mrc and truth.mrc.")],
    size: Annotated[int, typer.Option(help="Voxels along each edge.")] = 64,
    tilts: Annotated[str, typer.Option(help="START:STOP:STEP in degrees, both ends included.")] = "-59.5:57.5:1.5",
    phantom: Annotated[str, typer.Option(help="shells, virions, filaments, particles or slab.")] = "shells",
    noise: Annotated[
        str, typer.Option(help="clipped, skewed, outliers, low-dose (linear mode), 8-bit, none, or a noise-model file.")
    ] = "clipped",
    mode: Annotated[str | None, typer.Option(help="transmission or linear; by default the noise's own.")] = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
) -> None:
    """Simulate a tilt series of a known volume, with known noise."""
    import numpy as np

    from recon.phantoms import make_phantom
    from recon.simulation import add_noise, clean_tilt_series, tilt_range
    from recon.tilt_series import Volume, write_tilt_series

    output = Output(json)
    angles = tilt_range(tilts)
    acquisition, noise_model = _acquisition(noise, mode)
    volume = make_phantom(phantom, size, generator=np.random.default_rng(seed))
    clean, unit = clean_tilt_series(volume, angles, acquisition=acquisition)
    noisy = clean if noise_model is None else add_noise(clean, noise_model, seed=seed)
    folder.mkdir(parents=True, exist_ok=True)
    write_tilt_series(folder / "tilts.mrc", noisy)
    write_tilt_series(folder / "clean.mrc", clean)
    Volume(volume * np.float32(unit)).write(folder / "truth.mrc")
    output.line(f"{len(angles)} tilts of a {size}³ volume ({phantom}, {acquisition.mode}, noise: {noise}) in {folder}")
    output.result(
        {"folder": folder, "tilts": folder / "tilts.mrc", "truth": folder / "truth.mrc", "num_tilts": len(angles)}
    )


def reconstruct(
    tilts: Annotated[
        Path, typer.Argument(help="Tilt series (tilt, y, x): .mrc, .st, .ali, .tif or .npy; tilt axis along y.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Volume to write: .mrc, .rec, .tif or .npy.")],
    angles: Annotated[
        Path | None, typer.Option(help="Angle file; by default the .rawtlt or .tlt beside the stack.")
    ] = None,
    method: Annotated[str, typer.Option(help="auto, joint, l2, tv, sirt or wbp.")] = "auto",
    mode: Annotated[str, typer.Option(help="transmission (bright field) or linear (HAADF, EDX).")] = "transmission",
    thickness: Annotated[
        int | None, typer.Option(help="Depth of the volume in voxels; the image width by default.")
    ] = None,
    weight: Annotated[float | None, typer.Option(help="Weight of the total variation.")] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of the fit, or iterations.")] = None,
    noise_model: Annotated[Path | None, typer.Option(help="Calibrated noise model to keep fixed.")] = None,
    save_noise_model: Annotated[Path | None, typer.Option(help="Write the learnt noise model here.")] = None,
    invert_tilt: Annotated[bool, typer.Option("--invert-tilt", help="Flip the sign of the tilt angles.")] = False,
    report: Annotated[Path | None, typer.Option(help="Folder for an HTML report.")] = None,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
    json: JsonOption = False,
) -> None:
    """Reconstruct a clean volume, and the noise model with it, from one noisy tilt series."""
    from noiseflow import io
    from recon.methods import reconstruct as run
    from recon.report import reconstruction_report
    from recon.tilt_series import TiltSeries, VolumeGrid, read_tilt_series

    output = Output(json)
    io.check_output(out)
    if report is not None and report.exists() and not report.is_dir():
        raise ValueError(f"{report} is a file; name a folder for the report")
    tilt_series = read_tilt_series(tilts, angles=angles, mode=_mode(mode))
    if invert_tilt:
        tilt_series = TiltSeries(tilt_series.images, -tilt_series.tilt_angles, tilt_series.pixel_size, tilt_series.mode)
    fixed = _load_noise_model(noise_model)
    started = time.perf_counter()
    with progress_bar(f"reconstruct ({method})", steps or 150, json_mode=json) as progress:
        outcome = run(
            tilt_series,
            VolumeGrid.of(tilt_series, thickness),
            method=method,
            weight=weight,
            num_steps=steps,
            noise_model=fixed,
            seed=seed,
            device=choose_device(device),
            progress=progress,
        )
    rows = _figures(tilt_series, outcome, time.perf_counter() - started)
    outcome.volume.write(out)
    if save_noise_model is not None:
        _save_noise_model(outcome, save_noise_model, tilts)
    output.table(("figure", "value"), list(rows.items()))
    output.line(f"volume: {out}")
    page = None
    if report is not None:
        report.mkdir(parents=True, exist_ok=True)
        page = reconstruction_report(tilt_series, outcome, list(rows.items())).save(report / "index.html")
        output.line(f"report: {page}")
    fit = outcome.fit_result
    output.result(
        {"volume": out, "report": page, "method": outcome.method, "choices": outcome.choices, "figures": rows}
        | {"weights_tried": outcome.weights_tried}
        | ({"held_out_nll": fit.held_out_nll, "seconds": fit.seconds} if fit else {})
    )


def compare(
    volume: Annotated[Path, typer.Argument(help="Volume to judge.")],
    reference: Annotated[Path, typer.Argument(help="The truth, or another volume.")],
    json: JsonOption = False,
) -> None:
    """Compare a volume with a reference: MSE, PSNR, DSSIM (raw, affine, min-max) and Fourier shell correlation."""
    import numpy as np

    from noiseflow import io
    from recon.metrics import SCALINGS, fourier_shell_correlation
    from recon.metrics import compare as errors_of

    output = Output(json)
    first, second = io.read(volume).data, io.read(reference).data
    errors = {scaling: errors_of(first, second, scaling=scaling) for scaling in SCALINGS}
    rows = [(scaling, f"{e.mse:.3e}", f"{e.psnr:.2f}", f"{e.dssim:.4f}") for scaling, e in errors.items()]
    output.table(("scaling", "MSE", "PSNR (dB)", "DSSIM"), rows)
    frequency, correlation = fourier_shell_correlation(first, second)
    below = np.flatnonzero(correlation[1:] < 0.5)
    crossing = float(frequency[below[0] + 1]) if below.size else 0.5
    output.line(f"Fourier shell correlation stays above 0.5 up to {crossing:.3f} cycles per voxel")
    output.result({"errors": {name: vars(e) for name, e in errors.items()}, "fsc_0.5": crossing, "fsc": correlation})


def _mode(text: str) -> Mode:
    if text not in ("transmission", "linear"):
        raise ValueError(f"--mode {text}: choose transmission (bright field) or linear (HAADF, EDX)")
    return "linear" if text == "linear" else "transmission"


def _acquisition(noise: str, mode: str | None) -> tuple[Acquisition, nn.Module | None]:
    from dataclasses import replace

    from recon.simulation import ACQUISITIONS

    acquisition = ACQUISITIONS.get(noise, ACQUISITIONS["none"])
    noise_model = acquisition.noise() if acquisition.noise is not None else None
    if noise not in ACQUISITIONS:
        noise_model = _load_noise_model(Path(noise))
    return acquisition if mode is None else replace(acquisition, mode=_mode(mode)), noise_model


def _load_noise_model(path: Path | None) -> nn.Module | None:
    if path is None:
        return None
    import noiseflow

    return noiseflow.load(path)


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
