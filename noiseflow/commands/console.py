"""Shared parts of all commands: options, progress, and output for people and programs. Does not import torch."""

from __future__ import annotations

import contextlib
import json
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn

import typer

from noiseflow.described import printable

JsonOption = Annotated[bool, typer.Option("--json", help="Print the results as one JSON object, last on stdout.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, max=2**32 - 1, help="Seed of every random choice.")]
DeviceOption = Annotated[str, typer.Option("--device", help="Device to compute on: auto, cpu or cuda.")]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing outputs even if noiseflow did not write them.")
]

Progress = Callable[[int, str], None]
"""``progress(done, note)``: number of completed steps, and a short note such as the current likelihood."""
StepReport = Callable[[str, int, int, str], None]
"""``report(title, done, total, note)``: the same for several tasks in sequence."""
START_AGAIN = "no partial results were kept; run the same command to start again"
"""Message for interrupted work that keeps no state."""
_LOG_SECONDS = 10.0


def end_stopped(text: str) -> NoReturn:
    """Exit with one line and code 130 after an interrupt; further interrupts are ignored."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    from noiseflow.io.partials import clear_unfinished

    clear_unfinished()
    print(f"noiseflow: {printable(text)}", file=sys.stderr, flush=True)
    sys.exit(130)  # not typer.Exit, which a command that runs other commands would not see


class Output:
    """Output as lines and tables for people, or as one JSON object for programs.

    Args:
        json_mode: print only the JSON object on stdout; lines go to stderr.
    """

    def __init__(self, json_mode: bool) -> None:
        self.json_mode = json_mode

    def line(self, text: str) -> None:
        """Print one line."""
        print(printable(text), file=sys.stderr if self.json_mode else sys.stdout, flush=True)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print an aligned table; the first column is left-aligned, the others right-aligned."""
        cells = [list(header), *[list(row) for row in rows]]
        widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
        for row in cells:
            first, rest = row[0].ljust(widths[0]), [c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)]
            self.line("  ".join([first, *rest]).rstrip())

    def result(self, values: dict[str, Any]) -> None:
        """Print the command's result in JSON mode; non-finite numbers become null."""
        if self.json_mode:
            print(json.dumps(_plain(values), allow_nan=False), flush=True)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if value == value and abs(value) != float("inf") else None
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)


_SHOWN: ContextVar[bool] = ContextVar("shown", default=False)


@contextlib.contextmanager
def progress_shown() -> Iterator[None]:
    """Show progress in JSON mode too, for commands that another command runs for their JSON result."""
    token = _SHOWN.set(True)
    try:
        yield
    finally:
        _SHOWN.reset(token)


@contextlib.contextmanager
def progress_bar(title: str, total: int, *, json_mode: bool = False) -> Iterator[Progress]:
    """Progress of one task of `total` steps; see `step_report`."""
    with step_report(json_mode=json_mode) as report:
        yield lambda done, note: report(title, done, total, note)


@contextlib.contextmanager
def step_report(*, json_mode: bool = False) -> Iterator[StepReport]:
    """Progress with rate and remaining time: a bar on a terminal, occasional lines in a log, nothing in JSON mode."""
    if json_mode and not _SHOWN.get():
        yield lambda title, done, total, note: None
    elif not sys.stderr.isatty():
        yield _LogLines()
    else:
        yield from _bars()


class _Rate:
    """Steps per second of the current task; a new title or a smaller count starts a new measurement."""

    title, first, last, started = "", 0, 0, 0.0

    def __call__(self, title: str, done: int) -> float:
        now = time.monotonic()
        if title != self.title or done < self.last:
            self.title, self.first, self.started = title, done - 1, now
        self.last = done
        return (done - self.first - 1) / (now - self.started) if now > self.started else 0.0


class _LogLines:
    def __init__(self) -> None:
        self.rate, self.last = _Rate(), time.monotonic()

    def __call__(self, title: str, done: int, total: int, note: str) -> None:
        rate, now = self.rate(title, done), time.monotonic()
        if now - self.last >= _LOG_SECONDS and rate > 0:
            self.last = now
            speed = f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}"
            left = _duration((total - done) / rate)
            line = f"{title}: {done}/{total}, {speed} steps/s, {left} left, {note}"
            print(printable(line), file=sys.stderr, flush=True)


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _bars() -> Iterator[StepReport]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    more = (TextColumn("{task.fields[rate]:.1f}/s"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"))
    with RichProgress(*columns, *more, console=Console(stderr=True)) as bars:
        task, measure = bars.add_task("", total=None, rate=0.0, note="", visible=False), _Rate()

        def report(title: str, done: int, total: int, note: str) -> None:
            if title != measure.title:
                bars.reset(task, total=total, description=title, visible=True)
            bars.update(task, completed=done, rate=measure(title, done), note=note)

        yield report


def choose_device(name: str) -> Any:
    """The torch device of ``auto``, ``cpu`` or ``cuda``.

    Raises:
        ValueError: the name is unknown, or CUDA is not available.
    """
    import torch

    if name not in ("auto", "cpu", "cuda"):
        raise ValueError(f"--device {name}: choose auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch finds no CUDA GPU; use --device cpu, or install a CUDA build of torch")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


@dataclass(frozen=True)
class Invocation:
    """How the running command was called.

    Attributes:
        words: the command's name and its arguments as typed.
        options: parameter name → its value, and whether the user set it.
    """

    words: tuple[str, ...]
    options: dict[str, tuple[Any, bool]]

    @property
    def command_line(self) -> str:
        """The command line that repeats this call."""
        return shlex.join(["noiseflow", *self.words])


_INVOCATION: ContextVar[Invocation | None] = ContextVar("invocation", default=None)


def invocation() -> Invocation | None:
    """The invocation of the running command; None if no command is running."""
    return _INVOCATION.get()


@contextlib.contextmanager
def invoked(call: Invocation) -> Iterator[None]:
    """Make `invocation` return this call within the block."""
    token = _INVOCATION.set(call)
    try:
        yield
    finally:
        _INVOCATION.reset(token)
