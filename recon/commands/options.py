"""Options of `noiseflow reconstruct`, and the parsing of options that the commands of this package share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from noiseflow.commands.console import (
    DeviceOption,
    JsonOption,
    OverwriteOption,
    SeedOption,
    completed,
    group,
    output_file,
)
from noiseflow.runs.outputs import TENSORS
from recon.names import ALIGNMENTS, FIELDS, REGULARISERS, field_names, method_names, regulariser_names

if TYPE_CHECKING:
    from recon.series.tilt_series import Mode

_INPUT, _GEOMETRY, _METHOD = group("Input"), group("Geometry"), group("Method")
_SIZE, _OUTPUT, _ADVANCED = group("Size"), group("Output"), group("Advanced")


@dataclass(frozen=True)
class ReconstructOptions:
    """Arguments and options of the command; the first seven are shown by ``-h``."""

    tilts: Annotated[
        list[Path],
        typer.Argument(
            help="Tilt series (tilt, y, x): .mrc, .st, .tif, .npy, .dm3 …, a folder of images, or channels of a series."
        ),
    ]
    out: Annotated[Path, output_file("Volume: .mrc, .rec, .tif, .npy or .zarr; of several channels, OUT_CHANNEL.")]
    method: Annotated[str, typer.Option(help=f"{', '.join(method_names())}.", autocompletion=method_names)] = "auto"
    mode: Annotated[
        str,
        typer.Option(
            help="Image formation: transmission (bright field), linear (HAADF, EDX), or auto, by the background.",
            autocompletion=completed("auto", "transmission", "linear"),
        ),
    ] = "auto"
    uncertainty: Annotated[
        int, typer.Option(min=0, help="Error bars, VOLUME_std, _bias and _wedge, from so many samples (typically 16).")
    ] = 0
    refine_alignment: Annotated[bool, typer.Option("--refine-alignment", help="Find tilt axis and shifts.")] = False
    report: Annotated[Path | None, typer.Option(help="Folder for an HTML report.")] = None
    angles: Annotated[Path | None, _INPUT("Tilt angles; by default .rawtlt, .tlt or .mdoc beside the stack.")] = None
    channel: Annotated[str | None, _INPUT("Channel, or image of a file with several: name, or index from 0.")] = None
    pixel_size: Annotated[float | None, _INPUT("Pixel size in Å, in place of that of the files.")] = None
    exclude_views: Annotated[str, _INPUT("Images to leave out, numbered from 1 in stack order as in IMOD: 1,5-8.")] = ""
    alignment: Annotated[Path | None, _INPUT("Alignment: .json, IMOD's .xf, AreTomo's .aln or RELION's .star.")] = None
    alignment_binning: Annotated[float | None, _INPUT("Binning of the images relative to .xf, .aln or .star.")] = None
    invert_contrast: Annotated[bool, _INPUT("First invert the contrast of the images.", "--invert-contrast")] = False
    mask: Annotated[Path | None, _INPUT("Image or stack that is 0 at pixels to exclude from the fit.")] = None
    mask_nan: Annotated[bool, _INPUT("Exclude NaN and infinite pixels.", "--mask-nan")] = False
    align_on: Annotated[str | None, _INPUT("Series that aligns all channels, or 'sum' of all (the default).")] = None
    save_alignment: Annotated[Path | None, _INPUT("Alignment: .json, or .xf for IMOD.", writes=ALIGNMENTS)] = None
    second_axis: Annotated[Path | None, _INPUT("Tilt series about a second axis, about 90° from the first.")] = None
    second_angles: Annotated[Path | None, _INPUT("Tilt angles of --second-axis, as --angles.")] = None
    thickness: Annotated[int | None, _GEOMETRY("Depth of the volume in voxels; the image width by default.")] = None
    invert_tilt: Annotated[bool, _GEOMETRY("Flip the sign of the tilt angles.", "--invert-tilt")] = False
    tilt_axis: Annotated[
        float | None,
        _GEOMETRY("Tilt axis in images, degrees anticlockwise from y (up); with --refine-alignment, a rough value."),
    ] = None
    keep_tilts: Annotated[bool, _GEOMETRY("Keep tilts that are inconsistent with the others.", "--keep-tilts")] = False
    defocus: Annotated[
        float,
        _GEOMETRY("Blur by depth in fitted methods, pixels per voxel out of focus, such as 0.02; ignored below 0.25."),
    ] = 0.0
    defocus_kernel: Annotated[
        str,
        _GEOMETRY("depth: of each voxel; image: distance from the tilt axis times tan(tilt), as Kniesel et al. 2022."),
    ] = "depth"
    detector_blur: Annotated[float | None, _GEOMETRY("Blur of the detector, pixels rms; found if not given.")] = None
    preset: Annotated[str | None, _METHOD("kniesel2022 (200 steps) or kniesel2022-as-published (days).")] = None
    weight: Annotated[float | None, _METHOD("Weight of the regulariser; chosen automatically if not given.")] = None
    regulariser: Annotated[
        str | None,
        _METHOD(
            f"{', '.join(regulariser_names())}; {REGULARISERS.first} by default.",
            autocompletion=regulariser_names,
        ),
    ] = None
    field: Annotated[
        str | None,
        _METHOD(
            f"What a fitted volume is made of: {', '.join(field_names())} (chosen by the likelihood of tilts left out); "
            f"{FIELDS.first} by default.",
            autocompletion=field_names,
        ),
    ] = None
    steps: Annotated[int | None, _METHOD("Number of steps of the fit, or of iterations.", min=1)] = None
    window: Annotated[
        str | None,
        _METHOD(
            "Filter window of wbp: ramp, shepp-logan, cosine, hamming or hann; chosen automatically if not given.",
            autocompletion=completed("ramp", "shepp-logan", "cosine", "hamming", "hann"),
        ),
    ] = None
    denoiser: Annotated[
        str | None,
        _METHOD("nlm (default), tv, wavelet, wiener, bm3d, or your own, package.module:function (runs that code)."),
    ] = None
    noise_model: Annotated[Path | None, _METHOD("Calibrated noise model (.safetensors); it is kept fixed.")] = None
    slices_at_once: Annotated[int | None, _SIZE("Slices of a block; chosen for large volumes.", min=1)] = None
    workers: Annotated[int | None, _SIZE("Processes that reconstruct blocks (extra 'distributed').", min=1)] = None
    scheduler: Annotated[str | None, _SIZE("Address of a Dask scheduler whose workers reconstruct the blocks.")] = None
    save_noise_model: Annotated[Path | None, _OUTPUT("Learnt noise model (.safetensors).", writes=TENSORS)] = None
    voxel_size: Annotated[float | None, _OUTPUT("Voxel size to write, Å, from the field between its voxels.")] = None
    save_field: Annotated[Path | None, _OUTPUT("Field for `noiseflow export` (.safetensors).", writes=TENSORS)] = None
    fsc: Annotated[bool, _OUTPUT("Report the shell correlation of even and odd tilts.", "--fsc")] = False
    reference: Annotated[Path | None, _OUTPUT("Volume for the report's shell correlation, without --fsc.")] = None
    strict: Annotated[bool, _OUTPUT("Fail if the verdict is bad; the volume is still written.", "--strict")] = False
    resume: Annotated[bool, _ADVANCED("Resume an interrupted run.", "--resume")] = False
    checkpoint_interval: Annotated[float, _ADVANCED("Seconds between checkpoints.", min=0)] = 60.0
    dry_run: Annotated[bool, _ADVANCED("Only print the plan, its memory and expected time.", "--dry-run")] = False
    overwrite: OverwriteOption = False
    seed: SeedOption = 0
    device: DeviceOption = "auto"
    json: JsonOption = False

    @property
    def shared_inputs(self) -> list[Path]:
        """Files that are read beside the tilts and their angles."""
        given = (self.alignment, self.second_axis, self.second_angles, self.mask, self.noise_model, self.reference)
        return [path for path in given if path is not None]

    @property
    def reference_channel(self) -> Path | None:
        """The tilt series that determines the alignment of several channels, if one is named."""
        return None if self.align_on in (None, "sum") else Path(str(self.align_on))

    @property
    def asks_for_blocks(self) -> bool:
        """Whether the volume is to be reconstructed in blocks."""
        return any(each is not None for each in (self.slices_at_once, self.workers, self.scheduler))

    def settings(self) -> dict[str, Any]:
        """Settings of `recon.reconstruct`, without noise model and device."""
        names = ("method", "weight", "seed", "regulariser", "field", "uncertainty", "window", "denoiser", "defocus")
        chosen = {name: getattr(self, name) for name in (*names, "defocus_kernel", "detector_blur")}
        return chosen | {"num_steps": self.steps}

    def check(self, *, several: bool) -> None:
        """Check that the options agree with each other and with the method. Raises ValueError if they do not."""
        from recon.methods import settings_of
        from recon.methods._registry import require_setting, require_two_axes

        if self.align_on is not None and not several:
            raise ValueError("--align-on is for several channels; remove it, or give more series or --channel all")
        if self.second_axis is not None and several:
            raise ValueError("--second-axis is for one channel; reconstruct channels one by one")
        if self.workers is not None and self.scheduler is not None:
            raise ValueError("--scheduler provides the workers; remove --workers")
        if self.fsc and self.report is None:
            raise ValueError("--fsc needs a report; name its folder with --report")
        if self.voxel_size is not None and self.uncertainty:
            raise ValueError("--voxel-size: error bars have the fit's voxels; remove --uncertainty or --voxel-size")
        settings_of(**self.settings())
        for name in ("voxel_size", "save_field", "workers", "scheduler", "save_noise_model"):
            if getattr(self, name) is not None:
                require_setting(self.method, name.replace("_", "-"))
        if self.second_axis is not None:
            require_two_axes(self.method, blocks=self.asks_for_blocks)


def parse_mode(text: str) -> Mode:
    """The mode of image formation that `--mode` names. Raises ValueError if the mode is unknown."""
    modes: dict[str, Mode] = dict.fromkeys(("transmission", "bright-field", "bf"), "transmission")
    modes |= dict.fromkeys(("linear", "haadf", "adf", "edx", "eds"), "linear")
    if text.lower() not in modes:
        raise ValueError(f"--mode {text}: choose transmission (bright field) or linear (HAADF, EDX)")
    return modes[text.lower()]


def method_of(method: str, preset: str | None) -> str:
    """The method that `--method`, in upper or lower case, or `--preset` names. Raises ValueError if the preset is unknown, or
    `--method` is given too.
    """
    method = {name.lower(): name for name in method_names()}.get(method.lower(), method)
    if preset is None:
        return method
    from recon.methods.kniesel2022 import PRESETS

    if preset not in PRESETS:
        raise ValueError(f"--preset {preset}: choose {' or '.join(PRESETS)}")
    if method not in ("auto", preset):
        raise ValueError(f"--preset {preset} is itself a method; remove --method {method}")
    return preset
