"""Shared parts of all commands: options, also from files, output, and streams that never raise. Does not import torch."""

import contextlib
import difflib
import functools
import inspect
import io
import json
import os
import signal
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar, get_type_hints

import typer

from noiseflow.described import printable
from noiseflow.runs.outputs import require_ending
from noiseflow.runs.ownership import clear_unfinished

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


_EVERYTHING = "__show_everything__"
_COMMON, _COMMON_TITLE = ("overwrite", "json", "seed", "device"), "Run"
_Options = TypeVar("_Options")


def group(title: str | None = None) -> Callable[..., Any]:
    """The declaration of an option, by help text and names, that the help shows under a title, only with ``--help-all``; of an
    option for a file that the command `writes`, with its endings."""

    def declare(help: str, *names: str, writes: frozenset[str] | None = None, **more: Any) -> Any:
        more["callback"] = None if writes is None else lambda path: path and require_ending(path, writes)
        return typer.Option(*names, help=help, rich_help_panel=title, **more)

    return declare


def output_file(help: str, suffixes: frozenset[str] | None = None, *names: str) -> Any:
    """The declaration of an option for an output, whose ending is checked before the command's imports (`require_ending`)."""
    names = names or ("--out", "--output", "-o")
    return typer.Option(*names, help=help, callback=lambda path: path and require_ending(path, suffixes))


def completed(*values: str) -> Any:
    """The function by which the shell completes these values of an option."""
    return lambda: list(values)


def with_options(run: Callable[[_Options], None]) -> Callable[..., None]:
    """Make a command of a function whose one argument is a dataclass: its fields are the arguments and options."""
    (options,) = (kind for name, kind in get_type_hints(run).items() if name != "return")

    @functools.wraps(run)
    def command(**values: Any) -> None:
        run(options(**values))

    command.__signature__ = inspect.signature(options, eval_str=True)  # type: ignore[attr-defined]
    return command


def shared_options(command: Any) -> list[Any]:
    """The options that every command has for its options: ``--options``, and ``--help-all`` where groups are hidden."""
    titles = [title for parameter in command.params if (title := getattr(parameter, "rich_help_panel", None))]
    if titles:
        titles.append(_COMMON_TITLE)
        for parameter in command.params:
            if parameter.name in _COMMON:
                parameter.rich_help_panel = _COMMON_TITLE

    eager: dict[str, Any] = {"is_eager": True, "expose_value": False}
    words = "TOML file with options, such as OUTPUT.options.toml of an earlier run."

    def declare(
        options: Annotated[Path | None, typer.Option(callback=_from_file, help=words, **eager)] = None,
        help_all: Annotated[bool, typer.Option("--help-all", callback=_show_all, **eager)] = False,
    ) -> None: ...

    app = typer.Typer(add_completion=False)
    app.command()(declare)
    made: dict[str | None, Any] = {parameter.name: parameter for parameter in typer.main.get_command(app).params}
    made["help_all"].help = f"Show all options: {', '.join(dict.fromkeys(titles)).lower()}."
    own = {parameter.name for parameter in command.params}
    wanted = ["options", "help_all"] if titles else ["options"]
    return [made[name] for name in wanted if name not in own]


def hide_groups(parameters: Sequence[Any], context: typer.Context) -> None:
    """Hide every option that has a title, unless ``--help-all`` was given."""
    for parameter in parameters:
        if getattr(parameter, "rich_help_panel", None):
            parameter.hidden = not context.meta.get(_EVERYTHING)


def _from_file(context: typer.Context, value: Path | None) -> None:
    if value is None:
        return
    try:
        found = tomllib.loads(value.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"--options {value} is not TOML ({error}); write one line each: mode = 'linear'") from error
    known = {parameter.name: parameter for parameter in context.command.params}
    known |= {word.lstrip("-").replace("-", "_"): p for p in context.command.params for word in p.opts}
    settings = {}
    for name, each in found.items():
        parameter = known.get(name.replace("-", "_"))
        if parameter is None or isinstance(each, dict):
            near = difflib.get_close_matches(name.replace("-", "_"), [key for key in known if key], n=1)
            hint = f"did you mean {near[0].replace('_', '-')}?" if near else "--help-all lists the options"
            raise ValueError(f"--options {value}: '{name}' is not an option of {context.info_name}; {hint}")
        settings[parameter.name] = each
    context.default_map = {**(context.default_map or {}), **settings}


def _show_all(context: typer.Context, asked: bool) -> None:
    if asked:
        context.meta[_EVERYTHING] = True
        typer.echo(context.get_help())
        raise typer.Exit()
