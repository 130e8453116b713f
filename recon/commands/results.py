"""The tilt series that `noiseflow reconstruct` reads according to its options, and its outputs."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import noiseflow
from noiseflow import WithMaps, io, load
from noiseflow.commands.console import Output
from noiseflow.io.mapped import is_large
from noiseflow.progress import Progress
from noiseflow.report import Report
from noiseflow.runs.outputs import TENSORS, Outputs, put_in_place
from noiseflow.runs.ownership import is_own
from recon.commands.options import ReconstructOptions, parse_mode
from recon.fields.fields import save_field
from recon.names import AUTO
from recon.reconstruction import Reconstruction
from recon.report.page import reconstruction_report
from recon.series.alignment_files import read_alignment, write_alignment
from recon.series.files import read_tilt_series
from recon.series.first_guess import invert_contrast
from recon.series.prepare import Prepared, prepare, prepare_channels
from recon.series.screening import mode_of_good_tilts
from recon.series.tilt_series import TiltSeries, Volume
from recon.uncertainty.result import error_bar_paths, shell_band_path
from recon.verdict.judge import judge

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


@dataclass(frozen=True)
class Targets:
    """Output files, checked before the computation.

    Attributes:
        voxel_size: voxel size of the written volume, Å; None for that of the fit.
    """

    volume: Path
    report: Path | None = None
    noise_model: Path | None = None
    field: Path | None = None
    voxel_size: float | None = None

    @classmethod
    def of(cls, options: ReconstructOptions, channel: str, outputs: Outputs) -> Targets:
        """The outputs of one channel. Raises as `Outputs.file` and `Outputs.folder`."""
        volume, report = named(options.out, channel), options.report
        model, field = (
            None if path is None else named(path, channel) for path in (options.save_noise_model, options.save_field)
        )
        outputs.file(volume)
        for path in (*error_bar_paths(volume).values(), shell_band_path(volume)):
            outputs.no_input(path)  # those of a former volume are removed
        if options.uncertainty:
            for path in error_bar_paths(volume).values():
                outputs.file(path)
            outputs.file(shell_band_path(volume), suffixes=frozenset({".csv"}))
        outputs.file(model, suffixes=TENSORS)
        outputs.file(field, suffixes=TENSORS)
        report = report if report is None or not channel else report / file_name(channel)
        outputs.folder(report, holds=["index.html"])
        return cls(volume, report, model, field, options.voxel_size)

    def check(self, tilt_series: TiltSeries, slices_at_once: int | None) -> None:
        """Raise ValueError if a volume in blocks would have no single field, or the voxel size refer to an unknown one."""
        if slices_at_once is not None and (self.field is not None or self.voxel_size is not None):
            what = "--save-field" if self.voxel_size is None else "--voxel-size"
            raise ValueError(f"{what}: a volume in blocks has no single field; remove {what}, bin or crop the images")
        if self.voxel_size is not None and tilt_series.pixel_size is None:
            raise ValueError("--voxel-size: the file of the tilts has no pixel size; give it with --pixel-size, in Å")

    def write(
        self,
        output: Output,
        tilt_series: TiltSeries,
        outcome: Reconstruction,
        *,
        seconds: float,
        inputs: Sequence[Path],
        seed: int,
        prepared: Prepared,
        halves: tuple[Volume, Volume] | None = None,
        reference: Volume | None = None,
        warned: Sequence[str] = (),
        filled: Path | None = None,
    ) -> dict[str, Any]:
        """Write the requested files, print the results, and return those for programs. A volume that is already `filled`, in a
        file of the same format next to its target, is renamed to it."""
        given, turn = outcome, tilt_series.x_tilt
        outcome = replace(outcome, choices=outcome.choices | prepared.choices).levelled(turn)
        halves = None if halves is None else (halves[0].levelled(turn), halves[1].levelled(turn))
        rows = _figures(tilt_series, outcome, seconds)
        bars = self._write_volume(outcome, turn, filled, output)
        verdict = judge(
            tilt_series, given, screening=prepared.screening, alignment=prepared.alignment, guard=prepared.guard
        )
        self._write_parts(outcome, inputs[0], output)
        self._print(rows, bars, outcome, output)
        page = None
        if self.report is not None:
            content = reconstruction_report(
                tilt_series,
                outcome,
                list(rows.items()),
                inputs=inputs,
                seed=seed,
                halves=halves,
                reference=reference,
                verdict=verdict,
                guard=prepared.guard,
            )
            page = content.save(self.report / "index.html")
            output.line(f"report: {page}")
        for line in verdict.lines():  # after the report, whose parts may fail
            output.line(line)
        fit = outcome.fit_result
        return (
            {"volume": self.volume, "report": page, "method": outcome.method, "choices": outcome.choices}
            | {"figures": rows, "weights_tried": outcome.weights_tried, "warnings": list(warned)}
            | {"response": {"tilt_angles": tilt_series.tilt_angles, **outcome.response} if outcome.response else None}
            | prepared.as_dict()
            | ({"uncertainty": bars, "caution": outcome.caution} if bars else {})
            | {"slices_at_once": outcome.slices_at_once}
            | {"seconds": seconds, "verdict": verdict.as_dict()}
            | ({"held_out_nll": fit.held_out_nll} if fit else {})
        )

    def _write_volume(
        self, outcome: Reconstruction, turn: float, filled: Path | None, output: Output
    ) -> dict[str, Path]:
        """Write the volume, and the error bars, whose paths are returned."""
        if filled is not None and filled.suffix == self.volume.suffix and not turn:
            put_in_place(filled, self.volume)
        else:
            volume = outcome.volume if self.voxel_size is None else outcome.sampled(self.voxel_size).levelled(turn)
            volume.write(self.volume)
        bars = {} if outcome.uncertainty is None else outcome.uncertainty.write(self.volume)
        self._remove_former(bars, output)
        return bars

    def _write_parts(self, outcome: Reconstruction, source: Path, output: Output) -> None:
        """Write the noise model and the field, where they are asked for."""
        provenance = {"tilt_series": source.name, "method": outcome.method}
        if self.noise_model is not None:
            if outcome.noise_model is None:
                raise ValueError(f"--save-noise-model: method {outcome.method} fits no noise model; use --method joint")
            noiseflow.save(outcome.noise_model, self.noise_model, provenance=provenance)
        if self.field is not None and outcome.field is not None:
            save_field(outcome.field, self.field, provenance=provenance)
            output.line(f"field: {self.field}")

    def _print(self, rows: dict[str, str], bars: dict[str, Path], outcome: Reconstruction, output: Output) -> None:
        """Print the figures, and what they do not say."""
        output.table(("figure", "value"), list(rows.items()))
        output.line(f"volume: {self.volume}" + (f", voxels of {self.voxel_size:g} Å" if self.voxel_size else ""))
        for path in bars.values():
            output.line(f"error bars: {path}")
        if outcome.caution is not None:
            output.line(outcome.caution)
        if outcome.uncertainty is not None and outcome.uncertainty.shells is not None:
            reach = outcome.uncertainty.shells.in_words(outcome.volume.voxel_size)
            output.line(f"expected resolution (correlation of 0.5 with the truth): {reach}")

    def _remove_former(self, written: dict[str, Path], output: Output) -> None:
        """Remove error bars of the previous volume, which would be read as those of the new one."""
        pair, band = error_bar_paths(self.volume), shell_band_path(self.volume)
        # a single one of the files is an unrelated volume of that name
        beside = (pair if all(path.exists() for path in pair.values()) else {}) | {"fsc": band}
        for path in (path for name, path in beside.items() if name not in written and path.exists()):
            if not is_own(path):
                output.line(f"{path} was not written by noiseflow and does not belong to the new volume")
                continue
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            output.line(f"removed: {path}, which belonged to the previous volume")


def _figures(tilt_series: TiltSeries, outcome: Reconstruction, seconds: float) -> dict[str, str]:
    rows = {
        "method": outcome.method,
        "volume (z, y, x)": " x ".join(str(size) for size in outcome.volume.attenuation.shape),
        "voxel size (Å)": "unknown" if outcome.volume.voxel_size is None else f"{outcome.volume.voxel_size:.4g}",
        "tilts": f"{tilt_series.num_tilts}, {tilt_series.tilt_angles.min():g}° to {tilt_series.tilt_angles.max():g}°",
        "residual rms": f"{_residual_rms(tilt_series, outcome.projections):.4g}",
    }
    rows |= {name: f"{each:.4g}" if isinstance(each, float) else str(each) for name, each in outcome.choices.items()}
    if outcome.fit_result is not None:
        rows["held-out NLL (nats per pixel)"] = f"{outcome.fit_result.held_out_nll:.4f}"
    return rows | {"seconds": f"{seconds:.1f}"}


def _residual_rms(tilt_series: TiltSeries, projections: NDArray[np.float32]) -> float:
    """RMS of the residuals, computed image by image because a series may be larger than memory."""
    total, count = 0.0, 0
    for number, (image, predicted) in enumerate(zip(tilt_series.images, projections, strict=True)):
        residual = image.astype(np.float32) - predicted
        used = residual if tilt_series.mask is None else residual[tilt_series.mask[number]]
        total += float(np.sum(used**2, dtype=np.float64))
        count += used.size
    return math.sqrt(total / count)


_ALL = "all"


def channels_of(tilts: Sequence[Path], channel: str | None) -> tuple[dict[str, Path], str | None]:
    """The channels by name, and the channel to read of each file; one unnamed channel for a single series. Raises ValueError if
    two channels have the same name, or `--channel all` comes with several files.
    """
    if len(tilts) == 1 and channel != _ALL:
        return {"": tilts[0]}, channel
    if len(tilts) == 1:
        try:
            io.read(tilts[0], mapped=True)
        except io.SeveralImages as several:
            return {name: Path(f"{tilts[0]}::{name}") for name in several.names}, None
        return {"": tilts[0]}, None
    if channel == _ALL:
        raise ValueError("--channel all is for one file; name channels as FILE::NAME")
    names = [str(path).partition("::")[2] or Path(path).stem for path in tilts]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two channels are named {twice}; rename a file, so that each has its own volume")
    return dict(zip(names, tilts, strict=True)), channel


def file_name(channel: str) -> str:
    """The name of a channel as a part of a file name."""
    return re.sub(r"[^\w.+-]+", "-", channel)


def named(path: Path, channel: str) -> Path:
    """The output of one channel."""
    return path.with_name(f"{path.stem}_{file_name(channel)}{path.suffix}") if channel else path


def joined_results(results: Mapping[str, dict[str, Any]], report: Path | None, output: Output) -> dict[str, Any]:
    """The results of all channels for programs; their reports become parts of one page."""
    pages = {name: result.get("report") for name, result in results.items()}
    page = None
    if report is not None and all(pages.values()):
        whole = Report("Channels of one tilt series", f"{len(results)} channels with one alignment, one volume each")
        verdicts = ((name, each["verdict"], each["choices"]) for name, each in results.items())
        rows = [(name, v["grade"], v["reasons"][0], str(found.get("noise model", ""))) for name, v, found in verdicts]
        whole.table(("channel", "verdict", "first reason", "noise model"), rows, prose=True)
        for path in pages.values():
            whole.include(str(path))
        page = whole.save(report / "index.html")
        output.line(f"report: {page}")
    return {"channels": dict(results), "report": page}
