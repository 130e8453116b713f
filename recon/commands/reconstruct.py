"""The command `noiseflow reconstruct`."""

from __future__ import annotations

import hashlib
import time
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
    step_report,
)
from noiseflow.commands.option_files import option_groups
from recon.commands.options import load_noise_model, method_of
from recon.commands.running import (
    chosen_slices,
    disk_line,
    memory_line,
    open_journal,
    require_blocks,
    scratch_beside,
    stoppable,
    warnings_as_lines,
)
from recon.fields.regularisers._names import DEFAULT, regulariser_names
from recon.methods._names import method_names

if TYPE_CHECKING:
    from noiseflow.checks import Guard
    from recon.joint.checkpoint import Journal
    from recon.reconstruction import Reconstruction
    from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid


@option_groups(
    {
        "Input": (
            "angles",
            "channel",
            "pixel_size",
            "exclude_views",
            "alignment",
            "alignment_binning",
            "mask",
            "mask_nan",
            "invert_contrast",
        ),
        "Geometry": ("tilt_axis", "invert_tilt", "keep_tilts", "thickness", "defocus"),
        "Method": ("preset", "regulariser", "weight", "steps", "window", "denoiser", "noise_model", "seed"),
        "Size": ("slices_at_once", "workers", "scheduler", "device"),
        "Output": ("save_noise_model", "fsc", "reference", "strict", "overwrite", "json"),
        "Advanced": ("resume", "checkpoint_interval", "dry_run"),
    }
)
def reconstruct(
    context: typer.Context,
    tilts: Annotated[
        Path,
        typer.Argument(help="Tilt series (tilt, y, x): .mrc, .st, .ali, .tif, .npy, .dm3 …, or a folder of images."),
    ],
    out: Annotated[
        Path, typer.Option("--out", "--output", "-o", help="Volume to write: .mrc, .rec, .tif, .npy or .zarr.")
    ],
    angles: Annotated[
        Path | None,
        typer.Option(
            help="Tilt angles; by default the .rawtlt, .tlt or .mdoc file next to the stack, or the stack itself."
        ),
    ] = None,
    channel: Annotated[
        str | None,
        typer.Option(help="Channel of a hyperstack, or image of a file that holds several: its name, or index from 0."),
    ] = None,
    pixel_size: Annotated[float | None, typer.Option(help="Pixel size in Å, in place of that of the files.")] = None,
    exclude_views: Annotated[
        str, typer.Option(help="Images to leave out, numbered from 1 in the order of the stack as in IMOD: 1,5-8.")
    ] = "",
    alignment: Annotated[
        Path | None,
        typer.Option(
            help="Alignment to apply: a .json file of --save-alignment, also of another channel, IMOD's .xf, "
            "AreTomo's .aln or RELION's .star."
        ),
    ] = None,
    alignment_binning: Annotated[
        float | None,
        typer.Option(help="How many times smaller the images are than those that .xf, .aln or .star were made on."),
    ] = None,
    method: Annotated[
        str,
        typer.Option(help=f"Method of reconstruction: {', '.join(method_names())}."),
    ] = "auto",
    preset: Annotated[
        str | None,
        typer.Option(help="A published method with its own settings: kniesel2022, or kniesel2022-as-published (days)."),
    ] = None,
    mode: Annotated[
        str, typer.Option(help="Image formation: transmission (bright field) or linear (HAADF, EDX).")
    ] = "transmission",
    thickness: Annotated[
        int | None, typer.Option(help="Depth of the volume in voxels; the image width by default.")
    ] = None,
    weight: Annotated[
        float | None, typer.Option(help="Weight of the regulariser; chosen automatically if not given.")
    ] = None,
    regulariser: Annotated[
        str | None,
        typer.Option(help=f"Regulariser of fitted volumes: {', '.join(regulariser_names())}; {DEFAULT} by default."),
    ] = None,
    uncertainty: Annotated[
        int,
        typer.Option(
            min=0,
            help="Write error bars, VOLUME_std and VOLUME_bias, from this number of posterior samples (typically 16).",
        ),
    ] = 0,
    steps: Annotated[int | None, typer.Option(min=1, help="Number of steps of the fit, or of iterations.")] = None,
    window: Annotated[
        str | None,
        typer.Option(
            help="Filter window of wbp: ramp, shepp-logan, cosine, hamming or hann; chosen automatically if not given."
        ),
    ] = None,
    denoiser: Annotated[
        str | None,
        typer.Option(
            help="Denoiser of the denoised methods: nlm (the default), tv, wavelet, wiener, bm3d, or your own, "
            "package.module:function (this runs that code)."
        ),
    ] = None,
    noise_model: Annotated[
        Path | None, typer.Option(help="Calibrated noise model (.safetensors); it is kept fixed.")
    ] = None,
    save_noise_model: Annotated[
        Path | None, typer.Option(help="File for the learnt noise model (.safetensors).")
    ] = None,
    invert_tilt: Annotated[bool, typer.Option("--invert-tilt", help="Flip the sign of the tilt angles.")] = False,
    invert_contrast: Annotated[
        bool, typer.Option("--invert-contrast", help="Invert the contrast of the images before all other steps.")
    ] = False,
    mask: Annotated[
        Path | None, typer.Option(help="Image or stack that is 0 at pixels to exclude from the fit.")
    ] = None,
    mask_nan: Annotated[bool, typer.Option("--mask-nan", help="Exclude NaN and infinite pixels.")] = False,
    refine_alignment: Annotated[
        bool, typer.Option("--refine-alignment", help="First find the tilt axis and the shift of every image.")
    ] = False,
    save_alignment: Annotated[
        Path | None, typer.Option(help="File for the alignment: .json, or .xf (with .tlt) for IMOD.")
    ] = None,
    tilt_axis: Annotated[
        float | None,
        typer.Option(
            help="Direction of the tilt axis in the images, degrees anticlockwise from y (up); with "
            "--refine-alignment, a rough value."
        ),
    ] = None,
    second_axis: Annotated[
        Path | None,
        typer.Option(
            help="Tilt series of the same specimen about a second axis, about 90° from the first; one volume is fitted."
        ),
    ] = None,
    second_angles: Annotated[Path | None, typer.Option(help="Tilt angles of --second-axis, as --angles.")] = None,
    keep_tilts: Annotated[
        bool, typer.Option("--keep-tilts", help="Keep tilts that are inconsistent with the others.")
    ] = False,
    defocus: Annotated[
        float,
        typer.Option(
            help="Depth-dependent blur in the model of fitted methods: pixels per voxel out of the focal plane, such as 0.02; "
            "ignored below a quarter of a pixel."
        ),
    ] = 0.0,
    slices_at_once: Annotated[
        int | None,
        typer.Option(min=1, help="Reconstruct in blocks of this many slices; chosen automatically for large volumes."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of processes that reconstruct blocks (extra 'distributed').")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler whose workers reconstruct the blocks.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume an interrupted run.")] = False,
    checkpoint_interval: Annotated[float, typer.Option(min=0, help="Seconds between checkpoints.")] = 60.0,
    report: Annotated[Path | None, typer.Option(help="Folder for an HTML report.")] = None,
    fsc: Annotated[
        bool,
        typer.Option(
            "--fsc", help="Also reconstruct the even and the odd tilts, and report their Fourier shell correlation."
        ),
    ] = False,
    reference: Annotated[
        Path | None, typer.Option(help="Volume for the Fourier shell correlation in the report, if --fsc is not given.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print the plan with its memory and expected time, and stop before fitting."),
    ] = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit with an error if the verdict is bad; the volume is still written.")
    ] = False,
    overwrite: OverwriteOption = False,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
    json: JsonOption = False,
) -> None:
    """Reconstruct a clean volume, and the noise model with it, from one noisy tilt series.

    Ctrl-C saves the state and prints how to resume; a second Ctrl-C stops at once. The tilts may be in any order.
    """
    from noiseflow.io import locked, require_other
    from noiseflow.io.mapped import is_large
    from recon.commands.inputs import check_alignment_file, files_read, load_tilt_series, prepare
    from recon.commands.results import Targets
    from recon.methods import find_method, require_two_axes, settings_of
    from recon.report.page import read_reference
    from recon.scale.cluster import client_of
    from recon.series.tilt_series import VolumeGrid
    from recon.uncertainty.result import error_bar_paths, shell_band_path

    output = Output(json)
    targets = Targets(out, report=report, noise_model=save_noise_model, overwrite=overwrite, error_bars=uncertainty > 0)
    if save_alignment is not None:
        check_alignment_file(save_alignment, alignment, tilts, overwrite=overwrite)
    for path in (out, *error_bar_paths(out).values(), shell_band_path(out)):
        require_other(path, tilts, angles, alignment, second_axis, second_angles, mask, reference, noise_model)
    if save_noise_model is not None:
        require_other(save_noise_model, noise_model, tilts)
    method, chosen_device = method_of(method, preset), choose_device(device)
    options: dict[str, Any] = {"method": method, "weight": weight, "num_steps": steps, "seed": seed}
    options |= {"regulariser": regulariser, "uncertainty": uncertainty}
    options |= {"window": window, "denoiser": denoiser, "defocus": defocus}
    settings_of(**options)
    if second_axis is not None:
        blocks = any(each is not None for each in (slices_at_once, workers, scheduler))
        require_two_axes(find_method(method), blocks=blocks)
    if workers is not None and scheduler is not None:
        raise ValueError("--scheduler provides the workers; remove --workers")
    if workers is not None or scheduler is not None:
        require_blocks(method, "--workers" if scheduler is None else "--scheduler")
    if fsc and report is None:
        raise ValueError("--fsc needs a report; name its folder with --report")
    if save_noise_model is not None and not find_method(method).learns_noise:
        raise ValueError(f"--save-noise-model: method {method} does not fit a noise model; use --method joint")
    with locked(out), warnings_as_lines(output) as warned:
        fixed = load_noise_model(noise_model)
        read = partial(
            load_tilt_series,
            mode=mode,
            invert_tilt=invert_tilt,
            invert_contrast=invert_contrast,
            mask_nan=mask_nan,
            channel=channel,
            pixel_size=pixel_size,
        )
        tilt_series = read(
            tilts,
            angles=angles,
            mask=mask,
            exclude_views=exclude_views,
            mapped=slices_at_once is not None or workers is not None or scheduler is not None or is_large(tilts),
        )
        with step_report(json_mode=json) as progress:
            prepared = prepare(
                tilt_series,
                tilt_axis=tilt_axis,
                refine_alignment=refine_alignment,
                alignment=alignment,
                alignment_binning=alignment_binning,
                save_alignment=save_alignment,
                second_axis=None if second_axis is None else read(second_axis, angles=second_angles, mask=None),
                keep_tilts=keep_tilts,
                device=chosen_device,
                output=output,
                report=progress,
            )
        tilt_series = prepared.tilt_series
        grid = VolumeGrid.of(tilt_series, thickness)
        truth = None if reference is None else read_reference(reference, grid)
        settings = _settings(tilt_series, grid, {**options, "fsc": fsc, "slices at once": slices_at_once}, noise_model)
        options |= {"noise_model": fixed, "device": chosen_device}
        journal = open_journal(out, settings, resume=resume, interval=checkpoint_interval, output=output)
        if slices_at_once is None and second_axis is None:
            many = workers if scheduler is None else 2
            slices_at_once = chosen_slices(journal, tilt_series, grid, method, chosen_device, many)
        memory = memory_line(tilt_series, grid, method, chosen_device, slices_at_once, workers or 1)
        output.line(memory)
        disk = disk_line(tilt_series, grid, slices_at_once, error_bars=uncertainty > 0, halves=fsc)
        if slices_at_once is not None or dry_run:
            output.line(disk)
        if dry_run:
            _show_plan(tilt_series, grid, options, slices_at_once, {"memory": memory, "disk": disk}, output)
            return
        started = time.perf_counter()
        with stoppable(journal, context), scratch_beside(out) as scratch, client_of(workers, scheduler) as client:
            if slices_at_once is not None:
                options |= {"slices_at_once": slices_at_once, "scratch": scratch, "client": client}
                options |= {"keep": journal.keep, "forget": journal.forget}
            with step_report(json_mode=json) as journal.report:
                outcome, halves = _solve(tilt_series, grid, options, journal, fsc=fsc, guard=prepared.guard)
            verdict = targets.write(
                output,
                tilt_series,
                outcome,
                seconds=time.perf_counter() - started,
                inputs=files_read(tilts, angles, alignment, second_axis, second_angles, mask, noise_model, reference),
                seed=seed,
                prepared=prepared,
                halves=halves,
                reference=truth,
                warned=warned,
                filled=None if slices_at_once is None else scratch,
            )
        journal.discard()
    if strict and verdict.grade == "bad":
        raise ValueError(f"--strict: the verdict is bad ({out} is written). {verdict.reasons[0]}")


def _solve(
    tilt_series: TiltSeries, grid: VolumeGrid, options: dict[str, Any], journal: Journal, *, fsc: bool, guard: Guard
) -> tuple[Reconstruction, tuple[Volume, Volume] | None]:
    """The reconstruction, and those of the even and the odd tilts if requested."""
    from recon.methods import reconstruct
    from recon.report.page import even_odd

    def progress(done: int, total: int, note: str) -> None:
        if journal.report is not None:
            journal.report("reconstructing", done, total, note)

    def halves() -> tuple[Volume, Volume]:
        even, odd = (
            reconstruct(half, grid, **options | _of_half(options, name), prefix=f"{name} tilts: ").volume
            for name, half in zip(("even", "odd"), even_odd(tilt_series), strict=True)
        )
        return even, odd

    options = {**options, "run_fit": journal.fit, "run_stage": journal.run_stage, "progress": progress}
    outcome = reconstruct(tilt_series, grid, **options)
    return outcome, guard("Fourier shell correlation", halves, otherwise=None) if fsc else None


def _of_half(options: dict[str, Any], name: str) -> dict[str, Any]:
    """The options that differ for a half of the tilts."""
    scratch = options.get("scratch")
    return {"uncertainty": 0} | ({} if scratch is None else {"scratch": scratch.with_name(f"{name}-{scratch.name}")})


def _show_plan(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    options: dict[str, Any],
    slices_at_once: int | None,
    needed: dict[str, str],
    output: Output,
) -> None:
    """Print the plan, and its JSON form."""
    from dataclasses import asdict

    from recon.joint.plan import describe
    from recon.methods import find_method, settings_of
    from recon.scale.blocks import fitted_slices
    from recon.scale.cost import expected_seconds

    method = find_method(options["method"])
    result: dict[str, Any] = {"method": method.name, **needed, "slices_at_once": slices_at_once}
    result |= {"stages": [], "expected_seconds": None}
    if method.plan is None:
        output.line(f"{method.name}: {method.description} This method has no plan of stages.")
    else:
        made = {name: value for name, value in options.items() if name != "method"}
        stages, slab, share = method.plan(tilt_series, grid, settings_of(method.name, **made))
        fitted = None if slices_at_once is None else fitted_slices(grid.height, slices_at_once)
        seconds = expected_seconds(stages, tilt_series, grid, slab, share, fitted)
        output.line(f"slab: {slab} of {grid.height} slices")
        output.line(describe(stages))
        output.line(f"expected: about {seconds:.0f} s on this machine")
        result |= {"stages": [asdict(stage) for stage in stages], "expected_seconds": seconds}
    output.result(result)


def _settings(
    tilt_series: TiltSeries, grid: VolumeGrid, options: dict[str, Any], noise_model: Path | None
) -> dict[str, Any]:
    """All settings that determine the volume, with digests of the data."""
    import numpy as np

    digest = hashlib.blake2b(digest_size=16)
    for array in (tilt_series.images, tilt_series.tilt_angles, tilt_series.mask, tilt_series.beam, tilt_series.axes):
        if array is not None:
            digest.update(f"{array.dtype}{array.shape}".encode())
            for part in array:
                digest.update(np.ascontiguousarray(part).tobytes())
    data = {"tilt series": digest.hexdigest(), "mode": tilt_series.mode, "grid": list(grid.shape)}
    known = noise_model is not None and noise_model.is_file()
    model = hashlib.blake2b(noise_model.read_bytes(), digest_size=16).hexdigest() if noise_model and known else None
    return {**options, **data, "noise model": model}
