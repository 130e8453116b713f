"""Reading of the tilt series of `noiseflow reconstruct` according to its options."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from noiseflow import WithMaps, load
from noiseflow.commands.console import Output
from noiseflow.io.mapped import is_large
from noiseflow.progress import Progress
from recon.commands.options import ReconstructOptions, parse_mode
from recon.names import AUTO
from recon.series.alignment_files import read_alignment, write_alignment
from recon.series.files import read_tilt_series
from recon.series.first_guess import invert_contrast
from recon.series.prepare import Prepared, prepare, prepare_channels
from recon.series.screening import mode_of_good_tilts
from recon.series.tilt_series import TiltSeries

_BACKGROUND = {"transmission": "bright", "linear": "dark"}


def load_tilt_series(
    path: Path, options: ReconstructOptions, output: Output, *, mapped: bool = False, second: bool = False
) -> TiltSeries:
    """Read a tilt series according to the options of the command; the mode ``auto`` is decided by the images.
    They are corrected by the maps of a given noise model, if it has any.

    Args:
        second: whether this is the series about the second axis, which has its own angles.

    Raises:
        FileNotFoundError, ValueError: as `read_tilt_series`, or the mask does not match.
    """
    automatic = options.mode.lower() == AUTO
    series = read_tilt_series(
        path,
        angles=options.second_angles if second else options.angles,
        mode="transmission" if automatic else parse_mode(options.mode),
        mask=None if second else options.mask,
        mask_nan=options.mask_nan,
        mapped=mapped,
        channel=options.channel,
        pixel_size=options.pixel_size,
        exclude_views="" if second else options.exclude_views,
    )
    camera = None if options.noise_model is None else load(options.noise_model)
    if isinstance(camera, WithMaps):
        series = replace(series, images=camera.correct(series.images))
    if options.invert_tilt:
        series = replace(series, tilt_angles=-series.tilt_angles, x_tilt=-series.x_tilt)
    if options.invert_contrast:
        series = invert_contrast(series)
    if automatic:
        found = mode_of_good_tilts(series)
        series = replace(series, mode=found or series.mode)
        reason = "as the images do not decide" if found is None else f"as its background is {_BACKGROUND[found]}"
        other = ", or --invert-contrast for dark field that was inverted" * (found == "transmission")
        output.line(f"{path.name}: mode {series.mode}, {reason}; --mode sets it{other}")
    return series


def prepared_channels(
    channels: Mapping[str, Path], options: ReconstructOptions, output: Output, device: str, progress: Progress
) -> dict[str, Prepared]:
    """Read and prepare the channels, as `recon.prepare` or `recon.prepare_channels`, and print what was found."""
    mapped = {name: options.asks_for_blocks or is_large(path) for name, path in channels.items()}
    series = {name: load_tilt_series(path, options, output, mapped=mapped[name]) for name, path in channels.items()}
    chosen: dict[str, Any] = {"tilt_axis": options.tilt_axis, "refine_alignment": options.refine_alignment}
    chosen |= {"keep_tilts": options.keep_tilts, "device": device, "progress": progress}
    reference = options.reference_channel
    align_on = None if reference is None else load_tilt_series(reference, options, output)
    if options.alignment is not None:
        first = align_on or next(iter(series.values()))
        chosen["alignment"] = read_alignment(options.alignment, first, binning=options.alignment_binning)
    if "" not in channels:
        prepared = prepare_channels(series, align_on=align_on, **chosen)
    else:
        if options.second_axis is not None:
            chosen["second_axis"] = load_tilt_series(options.second_axis, options, output, second=True)
        prepared = {"": prepare(series[""], **chosen)}
    found = next(iter(prepared.values()))
    if options.refine_alignment and found.alignment is not None:
        output.line(found.alignment.in_words())
    if found.registration is not None:
        output.line(found.registration.in_words())
    if options.save_alignment is not None:
        if found.alignment is None:
            raise ValueError("--save-alignment: there is no alignment; find it with --refine-alignment")
        for path in write_alignment(options.save_alignment, found.alignment):
            output.line(f"alignment: {path}")
    return prepared
