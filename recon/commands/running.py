"""Long work that can be stopped: Ctrl-C, the command that goes on, and warnings as plain lines."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from noiseflow.commands.console import START_AGAIN, end_stopped
from noiseflow.described import printable
from noiseflow.io import locked, partial_folder
from noiseflow.io.mapped import is_filled_by_parts

if TYPE_CHECKING:
    from noiseflow.commands.console import Output
    from recon.joint.checkpoint import Journal
    from recon.series.tilt_series import TiltSeries, VolumeGrid


class StopSignal:
    """Within the ``with`` block, Ctrl-C or SIGTERM stops a journal's run: once after the running step, twice at once.

    Args:
        journal: whose fits are running.
    """

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
            # past the buffer, which a line that was stopped may be writing to
            os.write(sys.stderr.fileno(), b"noiseflow: finishing this step; Ctrl-C again stops at once\n")


@contextlib.contextmanager
def stoppable(journal: Journal, context: typer.Context) -> Iterator[None]:
    """Run fits that can be stopped, alone on their journal; says how to go on, and ends with exit code 130.

    Raises:
        SystemExit: the run was stopped.
        BlockingIOError: another run holds the journal.
        OSError: the disk is full or gone; the error says how to go on where there is a state.
    """
    try:  # around the signals too: the second Ctrl-C may come while they are handed back
        with locked(journal.folder.with_suffix("")), StopSignal(journal):
            try:
                yield
            except OSError as error:
                if journal.resumed and journal.exists:
                    error.add_note(
                        f"the last state is kept: when that is mended, go on with: {resume_command(context)}"
                    )
                raise
    except KeyboardInterrupt as stop:
        advice = f"go on with: {resume_command(context)}" if journal.resumed else START_AGAIN
        end_stopped(f"{str(stop) or ('stopped at once' if journal.abandoned else 'stopped')}; {advice}")


def resume_command(context: typer.Context) -> str:
    """The command line that goes on with the present command."""
    words = ["noiseflow", context.command.name or ""]
    for parameter in context.command.params:
        value, name = context.params.get(parameter.name or ""), max(parameter.opts, key=len)
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif value is True and name != "--resume":
            words.append(name)
        elif not isinstance(value, bool | None) and value != parameter.default:
            words += [name, str(value)]
    return shlex.join([*words, "--resume"])


@contextlib.contextmanager
def warnings_as_lines(output: Output) -> Iterator[list[str]]:
    """Show each warning once, as one line; yields the list that collects them."""
    told: list[str] = []

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = " ".join(str(message).split())
        if issubclass(category, UserWarning) and text not in told:
            told.append(text)
            print(f"noiseflow: warning: {printable(text)}", file=sys.stderr, flush=True)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield told


def memory_line(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    method: str,
    device: Any,
    slices_at_once: int | None = None,
    workers: int = 1,
) -> str:
    """One line about the memory needed and available.

    Raises:
        MemoryError: it does not fit.
    """
    from noiseflow.io.mapped import is_mapped
    from recon.scale.blocks import block_memory
    from recon.scale.memory import needed_memory, require_memory

    fitted = not method.startswith(("sirt", "wbp"))
    if slices_at_once is None:
        return require_memory(needed_memory(tilt_series, grid, fitted=fitted), device)
    block = block_memory(tilt_series, grid, slices_at_once, fitted=fitted)
    held = 0 if is_mapped(tilt_series.images) else tilt_series.images.nbytes
    return require_memory(needed_memory(*block, fitted=fitted) * workers + held, device)


def chosen_slices(
    journal: Journal, tilt_series: TiltSeries, grid: VolumeGrid, method: str, device: Any, workers: int | None
) -> int | None:
    """Slices of a block, where the whole volume is large, does not fit into memory, or workers share it; else None. A run that
    resumes keeps its blocks, however much memory is free by now: with others, none of them would be finished.

    Raises:
        MemoryError: not even a few slices fit.
        ValueError: workers are to share a volume whose fit was begun in one piece.
    """
    found: int | None = journal.choose(
        "slices at once", lambda: _slices_for(tilt_series, grid, method, device, workers)
    )
    if found is None and journal.resumed and (workers or 1) > 1:
        raise ValueError(
            "the checkpoint is of a run that reconstructs the whole volume in one piece, which workers cannot share; leave out "
            f"--workers and --scheduler, or leave out --resume to start over ({journal.folder})"
        )
    return found


def require_blocks(method: str, option: str) -> None:
    """Refuse an option that shares the blocks of a volume, where a method makes none.

    Raises:
        ValueError: it makes none.
    """
    from recon.methods import find_method, method_names

    if find_method(method).blockwise is None:
        able = [name for name in method_names() if find_method(name).blockwise is not None]
        raise ValueError(
            f"{option}: method {method} reconstructs no blocks to share; use --method {', '.join(able)}, or leave out {option}"
        )


def _slices_for(tilt_series: TiltSeries, grid: VolumeGrid, method: str, device: Any, workers: int | None) -> int | None:
    from recon.methods import find_method
    from recon.scale.memory import PLENTY, available_memory, choose_slices

    found, available = find_method(method), available_memory(device)
    if found.blockwise is None:
        return None
    if available is None:
        return None if workers is None else -(-grid.height // workers)
    plenty = PLENTY if str(device).startswith("cpu") else available  # blocks on a GPU are not measured
    return choose_slices(tilt_series, grid, available, fitted=found.fitted, workers=workers or 1, plenty=plenty)


def disk_line(
    tilt_series: TiltSeries,
    grid: VolumeGrid,
    slices_at_once: int | None,
    *,
    error_bars: bool = False,
    halves: bool = False,
) -> str:
    """One line about the blocks and the room on the disk that they take until the volume is whole; with `halves`, those of the
    even and of the odd tilts, too."""
    from recon.scale.blocks import HALO, blocks

    if slices_at_once is None:
        num_bytes = 4 * (3 if error_bars else 1) * grid.height * grid.depth * grid.width
        return f"blocks: none; disk: about {num_bytes / 2**30:.1f} GiB"
    parts = blocks(grid.height, slices_at_once, HALO)
    listed = sum(part.wide.stop - part.wide.start for part in parts)
    volumes = (3 if error_bars else 1) + (2 if halves else 0)
    num_bytes = 4 * volumes * (listed + 2 * grid.height) * grid.depth * grid.width
    num_images = tilt_series.num_tilts * (2 if halves else 1)
    num_bytes += 4 * num_images * tilt_series.images.shape[2] * (listed + grid.height)
    return f"blocks: {len(parts)} of {slices_at_once} slices at most; disk: about {num_bytes / 2**30:.1f} GiB meanwhile"


@contextlib.contextmanager
def scratch_beside(out: Path) -> Iterator[Path]:
    """A name for a volume beside `out`, gone at the end if it did not take its place; what a killed run left is cleared by the
    next one."""
    with partial_folder(out) as folder:
        yield folder / f"blocks{out.suffix if is_filled_by_parts(out) else '.npy'}"


def open_journal(out: Path, settings: dict[str, Any], *, resume: bool, interval: float, output: Output) -> Journal:
    """The journal of the run that makes `out`, beside it. Raises as `Journal`."""
    from recon.joint.checkpoint import Journal

    folder = out.with_name(f"{out.name}.checkpoint")
    journal = Journal(folder, settings, resume=resume, interval=interval)
    if resume and not journal.resumed:
        output.line(f"no checkpoint {folder}: starting from the beginning")
    elif journal.exists and not resume:
        output.line(f"starting over; the checkpoint of an earlier run, {folder}, will be replaced")
    return journal
