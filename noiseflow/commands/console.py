"""Shared parts of all commands: options, and output for people and programs. Does not import torch."""

from __future__ import annotations

import contextlib
import json
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
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

START_AGAIN = "no partial results were kept; run the same command to start again"
"""Message for interrupted work that keeps no state."""


def end_stopped(text: str) -> NoReturn:
    """Exit with one line and code 130 after an interrupt; further interrupts are ignored."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    from noiseflow.runs.partials import clear_unfinished

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
