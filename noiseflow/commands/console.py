"""Shared parts of all commands: options, output for people and programs, and streams that never raise. Does not import torch."""

import contextlib
import io
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn

import typer

from noiseflow.described import printable
from noiseflow.runs.ownership import clear_unfinished, signature

JsonOption = Annotated[bool, typer.Option("--json", help="Print the results as one JSON object, last on stdout.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, max=2**32 - 1, help="Seed of every random choice.")]
DEVICES = ["auto", "cpu", "cuda"]
DeviceOption = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.", autocompletion=lambda: DEVICES)]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace outputs that noiseflow did not write.")]

START_AGAIN = "no partial results were kept; run the same command to start again"
"""Message for interrupted work that keeps no state."""


def end_stopped(text: str) -> NoReturn:
    """Exit with one line and code 130 after an interrupt; further interrupts are ignored."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    clear_unfinished()
    print(f"noiseflow: {printable(text)}", file=sys.stderr, flush=True)
    sys.exit(130)  # not typer.Exit, which a command that runs other commands would not see


def show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning for users as one line; others are not shown."""
    if issubclass(category, UserWarning):
        print(f"noiseflow: warning: {printable(' '.join(str(message).split()))}", file=sys.stderr, flush=True)


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
    """The torch device of ``auto``, ``cpu`` or ``cuda``. Raises ValueError if the name is unknown, or CUDA is not available."""
    import torch

    if name not in DEVICES:
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

    def as_toml(self) -> str:
        """The options that the user set, for ``--options``; inputs are written like other options."""
        given = {name.replace("_", "-"): value for name, (value, was_set) in self.options.items() if was_set}
        title = f"# {signature()}: options of noiseflow {self.words[0]}, for --options"
        return "\n".join([title, *(f"{name} = {_toml(value)}" for name, value in given.items())]) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value if isinstance(value, (bool, int, float)) else str(value), ensure_ascii=False)


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


class SteadyStream:
    """A text stream whose writes never raise. Text that cannot be written is dropped."""

    def __init__(self, stream: Any) -> None:
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115
        if isinstance(self._stream, io.TextIOWrapper):
            self._stream.reconfigure(errors="backslashreplace")
        self.error: Exception | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text; characters that the encoding lacks are escaped."""
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush the underlying stream."""
        self._try(self._stream.flush)

    def _try(self, action: Callable[..., object], *values: str) -> None:
        if self.error is not None:
            return
        try:
            action(*values)
        except (OSError, ValueError) as error:
            self.error = error
            with contextlib.suppress(OSError, ValueError, AttributeError):  # Python flushes once more at exit
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


@contextlib.contextmanager
def steady_streams() -> Iterator[SteadyStream]:
    """Replace ``sys.stdout`` and ``sys.stderr`` within the block by streams that never raise; yield the former."""
    _open_standard_files()
    before = sys.stdout, sys.stderr
    out, err = (SteadyStream(stream) for stream in before)
    sys.stdout, sys.stderr = out, err
    try:
        yield out
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def was_lost(stream: SteadyStream) -> str | None:
    """Message about lost output, or None. A closed pipe is not reported, because its reader wanted no more."""
    error = stream.error
    if error is None or isinstance(error, BrokenPipeError):  # as Python raises EPIPE
        return None
    reason = getattr(error, "strerror", None) or str(error)
    return f"console output was lost ({reason.lower()}); all files are written"


def _open_standard_files() -> None:
    """Open closed standard streams to the null device; otherwise the next output file would get their descriptor."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
