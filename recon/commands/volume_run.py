"""The reconstruction of one prepared series by `noiseflow reconstruct`, from the plan to the files."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from noiseflow.commands.console import Output
from noiseflow.progress import progress_shown
from recon.commands.results import Targets
from recon.commands.running import chosen_slices, disk_line, memory_line, open_journal, scratch_beside, stoppable
from recon.fields.files import field_kinds
from recon.joint.plan import describe
from recon.methods import find_method, reconstruct, settings_of
from recon.report.page import even_odd, read_reference
from recon.scale.blocks import fitted_slices
from recon.scale.memory import expected_seconds
from recon.scale.running import client_of
from recon.series.tilt_series import VolumeGrid

if TYPE_CHECKING:
    from torch import nn

    from noiseflow.checks import Guard
    from recon.joint.checkpoint import Journal
    from recon.reconstruction import Reconstruction
    from recon.series.prepare import Prepared
    from recon.series.tilt_series import TiltSeries, Volume


@dataclass(frozen=True)
class VolumeRun:
    """The options of a run; a call reconstructs one volume.

    Attributes:
        context: the command, for the line that resumes it.
        output: where results are printed.
        options: settings of `recon.reconstruct`.
        noise_model: a fitted noise model that is kept fixed, and its file.
        device: torch device.
        thickness, reference, fsc, resume, checkpoint_interval, slices_at_once, workers, scheduler, dry_run: options of the
            command.
    """

    context: typer.Context
    output: Output
    options: dict[str, Any]
    device: str
    noise_model: tuple[nn.Module | None, Path | None] = (None, None)
    thickness: int | None = None
    reference: Path | None = None
    fsc: bool = False
    resume: bool = False
    checkpoint_interval: float = 60.0
    slices_at_once: int | None = None
    workers: int | None = None
    scheduler: str | None = None
    dry_run: bool = False
    warned: Sequence[str] = ()

    def __call__(self, prepared: Prepared, targets: Targets, inputs: Sequence[Path]) -> dict[str, Any]:
        """Reconstruct one volume, write its files and print its results; the results for programs."""
        series, out, output = prepared.tilt_series, targets.volume, self.output
        grid = VolumeGrid.of(series, self.thickness)
        truth = None if self.reference is None else read_reference(self.reference, grid)
        fixed, model_file = self.noise_model
        settings = _settings(
            series, grid, {**self.options, "fsc": self.fsc, "slices at once": self.slices_at_once}, model_file
        )
        options = self.options | {"noise_model": fixed, "device": self.device}
        journal = open_journal(out, settings, resume=self.resume, interval=self.checkpoint_interval, output=output)
        slices_at_once, method = self.slices_at_once, self.options["method"]
        if slices_at_once is None and series.axes is None:
            many = self.workers if self.scheduler is None else 2
            slices_at_once = chosen_slices(journal, series, grid, method, self.device, many, field=options["field"])
        targets.check(series, slices_at_once)
        memory = memory_line(
            series, grid, method, self.device, slices_at_once, self.workers or 1, field=options["field"]
        )
        output.line(memory)
        disk = disk_line(series, grid, slices_at_once, error_bars=options["uncertainty"] > 0, halves=self.fsc)
        if slices_at_once is not None or self.dry_run:
            output.line(disk)
        if self.dry_run:
            return _show_plan(series, grid, options, slices_at_once, {"memory": memory, "disk": disk}, output)
        started = time.perf_counter()
        with (
            stoppable(journal, self.context),
            scratch_beside(out) as scratch,
            client_of(self.workers, self.scheduler) as client,
        ):
            if slices_at_once is not None:
                options |= {"slices_at_once": slices_at_once, "scratch": scratch, "client": client}
                options |= {"keep": journal.keep, "forget": journal.forget}
            with progress_shown(json_mode=output.json_mode) as journal.report:
                outcome, halves = _solve(series, grid, options, journal, fsc=self.fsc, guard=prepared.guard)
            result = targets.write(
                output,
                series,
                outcome,
                seconds=time.perf_counter() - started,
                inputs=inputs,
                seed=options["seed"],
                prepared=prepared,
                halves=halves,
                reference=truth,
                warned=self.warned,
                filled=None if slices_at_once is None else scratch,
            )
        journal.discard()
        return result


def _solve(
    tilt_series: TiltSeries, grid: VolumeGrid, options: dict[str, Any], journal: Journal, *, fsc: bool, guard: Guard
) -> tuple[Reconstruction, tuple[Volume, Volume] | None]:
    """The reconstruction, and those of the even and the odd tilts if requested."""

    def halves() -> tuple[Volume, Volume]:
        even, odd = (
            reconstruct(half, grid, **options | _of_half(options, name), prefix=f"{name} tilts: ").volume
            for name, half in zip(("even", "odd"), even_odd(tilt_series), strict=True)
        )
        return even, odd

    options = {**options, "run_fit": journal.fit, "run_stage": journal.run_stage, "progress": journal.report}
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
) -> dict[str, Any]:
    """Print the plan; its JSON form."""
    method = find_method(options["method"])
    result: dict[str, Any] = {"method": method.name, **needed, "slices_at_once": slices_at_once}
    result |= {"stages": [], "expected_seconds": None}
    if method.plan is None:
        output.line(f"{method.name}: {method.description} This method has no plan of stages.")
    else:
        made = {name: value for name, value in options.items() if name != "method"}
        stages, slab, share = method.plan(tilt_series, grid, settings_of(method.name, **made))
        fitted = None if slices_at_once is None else fitted_slices(grid.height, slices_at_once)
        dearest = max(kind.step_cost for kind in field_kinds(options["field"]).values())
        seconds = expected_seconds(stages, tilt_series, grid, slab, share, fitted, dearest)
        output.line(f"slab: {slab} of {grid.height} slices")
        output.line(describe(stages))
        output.line(f"expected: about {seconds:.0f} s on this machine")
        result |= {"stages": [asdict(stage) for stage in stages], "expected_seconds": seconds}
    return result


def _settings(
    tilt_series: TiltSeries, grid: VolumeGrid, options: dict[str, Any], noise_model: Path | None
) -> dict[str, Any]:
    """All settings that determine the volume, with digests of the data."""
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
