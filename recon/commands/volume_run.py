"""The interruptible reconstruction of one prepared series by `noiseflow reconstruct`, from the plan to the files."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from noiseflow.checks import Guard
from noiseflow.commands.console import START_AGAIN, Output, end_stopped
from noiseflow.described import bytes_in_words
from noiseflow.io import partial_folder
from noiseflow.io.mapped import is_filled_by_parts, is_mapped
from noiseflow.progress import progress_shown
from noiseflow.runs.outputs import invocation
from recon.commands.options import ReconstructOptions
from recon.commands.results import Targets
from recon.fields.fields import field_kinds
from recon.joint.checkpoint import Journal
from recon.joint.plan import describe
from recon.methods import find_method, reconstruct, settings_of
from recon.reconstruction import Reconstruction
from recon.report.page import even_odd, read_reference
from recon.scale.blocks import HALO, block_memory, blocks, client_of, fitted_slices
from recon.scale.memory import (
    PLENTY,
    available_memory,
    choose_slices,
    expected_seconds,
    needed_memory,
    require_memory,
    sampled_memory,
)
from recon.series.prepare import Prepared
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid


@dataclass(frozen=True)
class VolumeRun:
    """The options of a run; a call reconstructs one volume.

    Attributes:
        noise_model: a fitted noise model that is kept fixed.
        warned: warnings of the run so far.
    """

    options: ReconstructOptions
    output: Output
    device: str
    noise_model: nn.Module | None = None
    warned: Sequence[str] = ()

    def __call__(self, prepared: Prepared, targets: Targets, inputs: Sequence[Path]) -> dict[str, Any]:
        """Reconstruct one volume, write its files and print its results; the results for programs."""
        series, options, output = prepared.tilt_series, self.options, self.output
        grid, settings = VolumeGrid.of(series, options.thickness), options.settings()
        truth = None if options.reference is None else read_reference(options.reference, grid)
        journal = self._journal(series, grid, targets.volume)
        slices_at_once = options.slices_at_once
        if slices_at_once is None and series.axes is None:
            slices_at_once = self.slices(journal, series, grid)
        targets.check(series, slices_at_once)
        memory, disk = self._memory(series, grid, slices_at_once), self._disk(series, grid, slices_at_once)
        output.line(memory)
        if slices_at_once is not None or options.dry_run:
            output.line(disk)
        settings |= {"noise_model": self.noise_model, "device": self.device}
        if options.dry_run:
            return _show_plan(series, grid, settings, slices_at_once, {"memory": memory, "disk": disk}, output)
        started = time.perf_counter()
        with (
            stoppable(journal),
            partial_folder(targets.volume) as folder,
            client_of(options.workers, options.scheduler) as client,
        ):
            suffix = targets.volume.suffix if is_filled_by_parts(targets.volume) else ".npy"
            scratch = folder / f"blocks{suffix}"
            if slices_at_once is not None:
                settings |= {"slices_at_once": slices_at_once, "scratch": scratch, "client": client}
                settings |= {"keep": journal.keep, "forget": journal.forget}
            with progress_shown(json_mode=output.json_mode) as journal.report:
                outcome, halves = _solve(series, grid, settings, journal, fsc=options.fsc, guard=prepared.guard)
            result = targets.write(
                output,
                series,
                outcome,
                seconds=time.perf_counter() - started,
                inputs=inputs,
                seed=options.seed,
                prepared=prepared,
                halves=halves,
                reference=truth,
                warned=self.warned,
                filled=None if slices_at_once is None else scratch,
            )
        journal.discard()
        return result

    def slices(self, journal: Journal, series: TiltSeries, grid: VolumeGrid) -> int | None:
        """Slices per block if the volume is large, does not fit into memory, or is shared by workers; otherwise None. Raises
        MemoryError if even a few slices do not fit, and ValueError if workers are requested for a run that started with the
        whole volume in one piece.

        A resumed run keeps its blocks, whatever memory is free now, because finished blocks of another size cannot be used.
        """
        workers = self.options.workers if self.options.scheduler is None else 2
        found: int | None = journal.choose("slices at once", lambda: self._slices_for(series, grid, workers))
        if found is None and journal.resumed and (workers or 1) > 1:
            raise ValueError(
                "the checkpoint is of a run that reconstructs the whole volume in one piece, which workers cannot share; "
                f"remove --workers and --scheduler, or remove --resume to start over ({journal.folder})"
            )
        return found

    def _slices_for(self, series: TiltSeries, grid: VolumeGrid, workers: int | None) -> int | None:
        available = available_memory(self.device)
        if find_method(self.options.method).blockwise is None:
            return None
        if available is None:
            return None if workers is None else -(-grid.height // workers)
        plenty = PLENTY if str(self.device).startswith("cpu") else available  # block sizes were not tuned on GPUs
        return choose_slices(series, grid, available, workers=workers or 1, plenty=plenty, **self._needs)

    @property
    def _needs(self) -> dict[str, Any]:
        """What the method needs memory for."""
        method = find_method(self.options.method)
        return {"fitted": method.fitted, "more": method.more_memory(self.options.field)}

    def _memory(self, series: TiltSeries, grid: VolumeGrid, slices_at_once: int | None) -> str:
        """One line about required and available memory. Raises MemoryError if it does not suffice."""
        needs = self._needs
        if self.options.voxel_size is not None and series.pixel_size is not None:
            needs["more"] += sampled_memory(grid.shape, self.options.voxel_size, series.pixel_size)
        if slices_at_once is None:
            return require_memory(needed_memory(series, grid, **needs), self.device)
        block = block_memory(series, grid, slices_at_once, fitted=needs["fitted"])
        held = 0 if is_mapped(series.images) else series.images.nbytes
        return require_memory(needed_memory(*block, **needs) * (self.options.workers or 1) + held, self.device)

    def _disk(self, series: TiltSeries, grid: VolumeGrid, slices_at_once: int | None) -> str:
        """One line about the blocks, and the disk space that is taken until the volume is complete."""
        slice_bytes, bars = 4 * grid.depth * grid.width, 4 if self.options.uncertainty else 1
        if slices_at_once is None:
            return f"blocks: none; disk: about {bytes_in_words(bars * slice_bytes * grid.height)}"
        parts, halves = blocks(grid.height, slices_at_once, HALO), 2 if self.options.fsc else 0
        listed = sum(part.wide.stop - part.wide.start for part in parts)
        num_bytes = (bars + halves) * slice_bytes * (listed + 2 * grid.height)
        num_bytes += 4 * series.num_tilts * max(1, halves) * series.images.shape[2] * (listed + grid.height)
        large = f"at most {slices_at_once} slices; disk: about {bytes_in_words(num_bytes)} during the run"
        return f"blocks: {len(parts)} of {large}"

    def _journal(self, series: TiltSeries, grid: VolumeGrid, out: Path) -> Journal:
        """Open the journal of a run next to its output. Raises as `Journal`."""
        options, output = self.options, self.output
        folder = out.with_name(f"{out.name}.checkpoint")
        settings = _determining(series, grid, options)
        journal = Journal(folder, settings, resume=options.resume, interval=options.checkpoint_interval)
        if options.resume and not journal.resumed:
            output.line(f"no checkpoint {folder}: starting from the beginning")
        elif journal.exists and not options.resume:
            output.line(f"starting over; the checkpoint of an earlier run, {folder}, will be replaced")
        return journal


def _solve(
    tilt_series: TiltSeries, grid: VolumeGrid, options: dict[str, Any], journal: Journal, *, fsc: bool, guard: Guard
) -> tuple[Reconstruction, tuple[Volume, Volume] | None]:
    """The reconstruction, and those of the even and the odd tilts if requested."""

    def halves() -> tuple[Volume, Volume]:
        found: dict[str, Volume] = {}
        for name, half in zip(("even", "odd"), even_odd(tilt_series), strict=True):
            scratch = options.get("scratch")
            own = {"uncertainty": 0, "scratch": scratch and scratch.with_name(f"{name}-{scratch.name}")}
            found[name] = reconstruct(half, grid, **options | own, prefix=f"{name} tilts: ").volume
        return found["even"], found["odd"]

    options = {**options, "run_fit": journal.fit, "run_stage": journal.run_stage, "progress": journal.report}
    outcome = reconstruct(tilt_series, grid, **options)
    return outcome, guard("Fourier shell correlation", halves, otherwise=None) if fsc else None


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


def _determining(tilt_series: TiltSeries, grid: VolumeGrid, options: ReconstructOptions) -> dict[str, Any]:
    """All settings that determine the volume, with digests of the data."""
    digest = hashlib.blake2b(digest_size=16)
    for array in (tilt_series.images, tilt_series.tilt_angles, tilt_series.mask, tilt_series.beam, tilt_series.axes):
        if array is not None:
            digest.update(f"{array.dtype}{array.shape}".encode())
            for part in array:
                digest.update(np.ascontiguousarray(part).tobytes())
    chosen = options.settings() | {"fsc": options.fsc, "slices at once": options.slices_at_once}
    data = {"tilt series": digest.hexdigest(), "mode": tilt_series.mode, "grid": list(grid.shape)}
    model = None
    if options.noise_model is not None and options.noise_model.is_file():
        model = hashlib.blake2b(options.noise_model.read_bytes(), digest_size=16).hexdigest()
    return {**chosen, **data, "noise model": model}


class StopSignal:
    """Within the ``with`` block, Ctrl-C or SIGTERM stops a run: once after the current step, twice immediately."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal

    def __enter__(self) -> StopSignal:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, handler)

    def _handle(self, number: int, frame: Any) -> None:
        journal = self._journal
        if journal.stop_requested or not journal.in_fit:
            journal.abandoned = True
            raise KeyboardInterrupt
        journal.stop_requested = True
        with contextlib.suppress(OSError, ValueError, AttributeError):
            # bypasses the buffer, which the interrupted code may be writing to
            os.write(sys.stderr.fileno(), b"noiseflow: finishing this step; press Ctrl-C again to stop immediately\n")


@contextlib.contextmanager
def stoppable(journal: Journal) -> Iterator[None]:
    """Run interruptible fits. An interrupted run prints how to resume and exits with code 130. Raises SystemExit if the run was
    interrupted, and OSError if the disk is full or not available; the message says how to resume if there is a saved state.
    """
    try:  # also covers the signal handlers: a second Ctrl-C may arrive while they are restored
        with StopSignal(journal):
            try:
                yield
            except OSError as error:
                if journal.abandoned:  # a file was being closed when the interrupt came
                    raise KeyboardInterrupt from None
                if journal.resumed and journal.exists:
                    error.add_note(f"the last state is kept: after fixing this, resume with: {resume_command()}")
                raise
    except KeyboardInterrupt as stop:
        advice = f"resume with: {resume_command()}" if journal.resumed else START_AGAIN
        end_stopped(f"{str(stop) or ('stopped immediately' if journal.abandoned else 'stopped')}; {advice}")


def resume_command() -> str:
    """The command line that resumes the current command."""
    called = invocation()
    words = () if called is None else called.words
    return shlex.join(["noiseflow", *(word for word in words if word != "--resume"), "--resume"])
