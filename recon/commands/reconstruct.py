"""The command `noiseflow reconstruct`."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from noiseflow.commands.console import DeviceOption, JsonOption, Output, OverwriteOption, SeedOption, choose_device
from noiseflow.commands.option_files import option_groups
from noiseflow.progress import progress_shown
from recon.commands.options import load_noise_model, method_of
from recon.commands.running import warnings_as_lines
from recon.names import FIELDS, REGULARISERS, field_names, method_names, regulariser_names


@option_groups(
    {
        "Input": (
            "angles",
            "channel",
            "align_on",
            "second_axis",
            "second_angles",
            "pixel_size",
            "exclude_views",
            "alignment",
            "save_alignment",
            "alignment_binning",
            "mask",
            "mask_nan",
            "invert_contrast",
        ),
        "Geometry": ("tilt_axis", "invert_tilt", "keep_tilts", "thickness", "defocus", "defocus_kernel"),
        "Method": ("preset", "field", "regulariser", "weight", "steps", "window", "denoiser", "noise_model", "seed"),
        "Size": ("slices_at_once", "workers", "scheduler", "device"),
        "Output": ("voxel_size", "save_field", "save_noise_model", "fsc", "reference", "strict", "overwrite", "json"),
        "Advanced": ("resume", "checkpoint_interval", "dry_run"),
    }
)
def reconstruct(
    context: typer.Context,
    tilts: Annotated[
        list[Path],
        typer.Argument(
            help="Tilt series (tilt, y, x): .mrc, .st, .ali, .tif, .npy, .dm3 …, or a folder of images; or several channels of "
            "one series, for one volume each."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "--output",
            "-o",
            help="Volume to write: .mrc, .rec, .tif, .npy or .zarr; of several channels, OUT_CHANNEL.",
        ),
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
    method: Annotated[str, typer.Option(help=f"Method of reconstruction: {', '.join(method_names())}.")] = "auto",
    preset: Annotated[
        str | None,
        typer.Option(help="A published method with its own settings: kniesel2022, or kniesel2022-as-published (days)."),
    ] = None,
    mode: Annotated[
        str,
        typer.Option(
            help="Image formation: transmission (bright field), linear (HAADF, EDX), or auto, by the background."
        ),
    ] = "auto",
    thickness: Annotated[
        int | None, typer.Option(help="Depth of the volume in voxels; the image width by default.")
    ] = None,
    weight: Annotated[
        float | None, typer.Option(help="Weight of the regulariser; chosen automatically if not given.")
    ] = None,
    regulariser: Annotated[
        str | None,
        typer.Option(
            help=f"Regulariser of fitted volumes: {', '.join(regulariser_names())}; {REGULARISERS.first} by default."
        ),
    ] = None,
    field: Annotated[
        str | None,
        typer.Option(
            help=f"What a fitted volume is made of: {', '.join(field_names())} (chosen by the likelihood of held-out pixels); "
            f"{FIELDS.first} by default."
        ),
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
    voxel_size: Annotated[
        float | None,
        typer.Option(
            help="Voxel size of the written volume, Å; the field is evaluated between pixels. Those by default."
        ),
    ] = None,
    save_field: Annotated[
        Path | None, typer.Option(help="File for the fitted field (.safetensors), for `noiseflow export`.")
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
    align_on: Annotated[
        str | None,
        typer.Option(
            help="What determines the alignment of several channels: a tilt series, or 'sum' of all (the default)."
        ),
    ] = None,
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
    defocus_kernel: Annotated[
        str,
        typer.Option(
            help="What the blur depends on: depth of each voxel; or image: distance of the pixel from the tilt axis times "
            "tan(tilt), as in Kniesel et al. 2022."
        ),
    ] = "depth",
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
    from recon.commands.channels import channels_of, file_name, joined_results, named
    from recon.commands.inputs import check_alignment_file, files_read, load_tilt_series, prepare
    from recon.commands.results import Targets
    from recon.commands.volume_run import VolumeRun
    from recon.methods import settings_of
    from recon.methods._registry import require_setting, require_two_axes
    from recon.uncertainty.result import error_bar_paths, shell_band_path

    output = Output(json)
    channels, channel = channels_of(tilts, channel)
    several = "" not in channels
    reference_channel = None if align_on in (None, "sum") else Path(str(align_on))
    if align_on is not None and not several:
        raise ValueError(
            f"--align-on {align_on} is for several channels; remove it, or give more series or --channel all"
        )
    if second_axis is not None and several:
        raise ValueError("--second-axis is for one channel; reconstruct channels one by one")
    inputs = (*channels.values(), reference_channel, angles, alignment, second_axis, second_angles, mask, reference)
    if save_alignment is not None:
        check_alignment_file(save_alignment, *inputs, overwrite=overwrite)
    targets = {
        name: Targets(
            named(out, name),
            report=report if report is None or not name else report / file_name(name),
            noise_model=None if save_noise_model is None else named(save_noise_model, name),
            field=None if save_field is None else named(save_field, name),
            voxel_size=voxel_size,
            overwrite=overwrite,
            error_bars=uncertainty > 0,
        )
        for name in channels
    }
    for target in targets.values():
        volume = target.volume
        for path in (volume, *error_bar_paths(volume).values(), shell_band_path(volume)):
            require_other(path, *inputs, noise_model)
        for beside in (path for path in (target.noise_model, target.field) if path is not None):
            require_other(beside, noise_model, *channels.values())
    method, chosen_device = method_of(method, preset), choose_device(device)
    options: dict[str, Any] = {"method": method, "weight": weight, "num_steps": steps, "seed": seed}
    options |= {"regulariser": regulariser, "field": field, "uncertainty": uncertainty}
    options |= {"window": window, "denoiser": denoiser, "defocus": defocus, "defocus_kernel": defocus_kernel}
    settings_of(**options)
    if voxel_size is not None or save_field is not None:
        require_setting(method, "voxel-size" if save_field is None else "save-field")
    blocks = any(each is not None for each in (slices_at_once, workers, scheduler))
    if second_axis is not None:
        require_two_axes(method, blocks=blocks)
    if workers is not None and scheduler is not None:
        raise ValueError("--scheduler provides the workers; remove --workers")
    if workers is not None or scheduler is not None:
        require_setting(method, "workers" if scheduler is None else "scheduler")
    if fsc and report is None:
        raise ValueError("--fsc needs a report; name its folder with --report")
    if save_noise_model is not None:
        require_setting(method, "save-noise-model")
    with ExitStack() as locks, warnings_as_lines() as warned:
        for target in targets.values():
            locks.enter_context(locked(target.volume))
        fixed = load_noise_model(noise_model)
        read = partial(
            load_tilt_series,
            output=output,
            mode=mode,
            invert_tilt=invert_tilt,
            invert_contrast=invert_contrast,
            mask_nan=mask_nan,
            channel=channel,
            pixel_size=pixel_size,
        )
        use: dict[str, Any] = {"angles": angles, "mask": mask, "exclude_views": exclude_views}
        series = {name: read(path, mapped=blocks or is_large(path), **use) for name, path in channels.items()}
        with progress_shown(json_mode=json) as progress:
            prepared = prepare(
                series,
                align_on=None if reference_channel is None else read(reference_channel, **use),
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
        run = VolumeRun(
            context,
            output,
            options,
            chosen_device,
            noise_model=(fixed, noise_model),
            thickness=thickness,
            reference=reference,
            fsc=fsc,
            resume=resume,
            checkpoint_interval=checkpoint_interval,
            slices_at_once=slices_at_once,
            workers=workers,
            scheduler=scheduler,
            dry_run=dry_run,
            warned=warned,
        )
        shared = (angles, alignment, second_axis, second_angles, mask, noise_model, reference)
        results = {
            name: run(each, targets[name], files_read(channels[name], *shared)) for name, each in prepared.items()
        }
        written = joined_results(results, report, output) if several else results[""]
    output.result(written)
    worst = next((result for result in results.values() if result.get("verdict", {}).get("grade") == "bad"), None)
    if strict and worst is not None:
        raise ValueError(
            f"--strict: the verdict is bad ({worst['volume']} is written). {worst['verdict']['reasons'][0]}"
        )
