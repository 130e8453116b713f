"""The command-line program `noiseflow`: finds its commands by entry point and reports user errors in one line.

This module does not import torch, so that ``noiseflow -h`` is fast.
"""

from __future__ import annotations

import _thread
import atexit
import contextlib
import errno
import gc
import logging
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from noiseflow.commands import console
from noiseflow.commands.console import START_AGAIN, end_stopped, hide_groups, shared_options
from noiseflow.described import printable
from noiseflow.installation import DISTRIBUTION, library_version, load_plugin, package_of, plugins
from noiseflow.resources import wait_passively
from noiseflow.runs.outputs import Invocation, invoked

_ORDER = ["demo", "calibrate", "sample", "evaluate", "simulate", "reconstruct"]
_ORDER += ["batch", "export", "compare", "measure", "view", "doctor"]
_TYPED = "noiseflow.typed"
_ANY_WORDS = {"ignore_unknown_options": True, "allow_extra_args": True}


def build_app(wanted: str | None = None) -> typer.Typer:
    """Build the command-line application with all installed commands, or only the wanted one, if there is such a command."""
    app = typer.Typer(
        name="noiseflow",
        cls=_Group,
        help="Learn a microscope's noise, sample it, and reconstruct clean volumes from noisy tilt series.",
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)
    found = plugins("noiseflow.commands")
    listed = sorted(found, key=lambda n: (_ORDER.index(n) if n in _ORDER else len(_ORDER), n))
    for name in [wanted] if wanted in found else listed:
        try:
            command = load_plugin(found[name])
            if package_of(found[name]) != DISTRIBUTION:
                _require_command(command)
        except (ImportError, TypeError) as error:
            app.command(name, context_settings=_ANY_WORDS)(_broken(str(error)))
        else:
            app.command(name, cls=_ListCommand)(command)
    return app


def _require_command(command: Any) -> None:
    """Check that a plug-in is a valid command, so that a broken one does not break the help of the others. Raises TypeError if
    it is not a function, or its parameters are not valid for a command.
    """
    alone = typer.Typer()
    try:
        alone.command()(command)
        typer.main.get_command(alone)
    except Exception as error:
        raise TypeError(f"this plug-in is not a valid command ({error}); fix, update or remove its package") from error


def _broken(problem: str) -> Callable[[typer.Context], None]:
    def command(context: typer.Context) -> None:
        raise ImportError(problem)

    command.__doc__ = f"Cannot be loaded: {problem}"
    return command


class _Group(TyperGroup):
    """The top-level command group: Ctrl-C ends any command with one line and exit code 130."""

    def get_params(self, ctx: Any) -> Any:
        return _flags_without_type(super().get_params(ctx))

    def make_context(self, *words: Any, **more: Any) -> Any:
        with _in_order(None):
            return super().make_context(*words, **more)

    def invoke(self, ctx: Any) -> Any:
        with _in_order(ctx):
            return super().invoke(ctx)


@contextlib.contextmanager
def _in_order(context: Any) -> Iterator[None]:
    """End at an interrupt with one line, and escape control characters in the user's input that a usage error quotes."""
    try:
        yield
    except KeyboardInterrupt as stop:
        command = "" if context is None else f"{context.invoked_subcommand} "
        end_stopped(f"{command}stopped; {str(stop) or START_AGAIN}")
    except Exception as error:
        if isinstance(message := getattr(error, "message", None), str):
            error.message = printable(message)  # type: ignore[attr-defined]
        raise


class _ListCommand(TyperCommand):
    """A command that records how it was called, and whose list options accept several values.

    ``--short a b c`` means ``--short a --short b --short c``.
    """

    def __init__(self, *words: Any, **more: Any) -> None:
        super().__init__(*words, **more)
        self.params += shared_options(self)

    def get_params(self, ctx: Any) -> Any:
        parameters = _flags_without_type(super().get_params(ctx))
        hide_groups(parameters, ctx)
        return parameters

    def invoke(self, ctx: Any) -> Any:
        given = {name: ctx.get_parameter_source(name).name != "DEFAULT" for name in ctx.params}
        options = {name: (value, given[name]) for name, value in ctx.params.items()}
        with invoked(Invocation((ctx.info_name, *ctx.meta[_TYPED]), options)):
            return super().invoke(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta[_TYPED] = tuple(args)
        lists = {name for option in self.params if getattr(option, "multiple", False) for name in option.opts}
        spread: list[str] = []
        current = None
        for argument in args:
            if argument.startswith("-") and argument != "-":
                current = argument if argument in lists else None
            elif current is not None and spread[-1] != current:
                spread.append(current)
            spread.append(argument)
        return super().parse_args(ctx, spread)


def _flags_without_type(parameters: list[Any]) -> list[Any]:
    """Hide the type of flags in the help, because it would look like a value that the user must give."""
    for parameter in parameters:
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    return parameters


def _show_version(asked: bool) -> None:
    if asked:
        print(f"noiseflow {library_version()}")
        raise typer.Exit()


def _options(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Learn a microscope's noise, sample it, and reconstruct clean volumes from noisy tilt series."""
    del context, debug, show_version


def main(arguments: list[str] | None = None) -> None:
    """Run the program and exit: 0 success, 1 error (reported in one line, with the fix), 2 usage error, 130 interrupted."""
    wait_passively()
    if arguments is None:
        atexit.register(gc.freeze)  # else the exit searches torch's objects for unreachable cycles, for 0.4 s
    with console.steady_streams() as stdout:
        interrupts = _Interrupts(until_exit=arguments is None)
        _run(sys.argv[1:] if arguments is None else arguments, stdout, interrupts)


def _run(arguments: list[str], stdout: console.SteadyStream, interrupts: _Interrupts) -> None:
    debug = "--debug" in arguments
    if not debug:
        warnings.showwarning = console.show_warning
        logging.getLogger().addHandler(logging.NullHandler())  # libraries log what our own message already reports
    try:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, interrupts)  # a batch system's stop signal must not leave partial outputs
            if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
                signal.signal(signal.SIGINT, interrupts)
            _keep_ctrl_c()
        words = [word for word in arguments if word != "--debug"]
        build_app(words[0] if words else None)(args=words, prog_name="noiseflow")
    except KeyboardInterrupt:
        end_stopped(f"stopped; {START_AGAIN}")
    except SystemExit as end:
        interrupts.done = True
        untold = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN  # stopped again, before a line was printed
        if end.code == 130 and untold:
            end_stopped(f"stopped; {START_AGAIN}")
        interrupts.ignore()
        stdout.flush()
        if not end.code and (lost := console.was_lost(stdout)) is not None:
            print(f"noiseflow: {lost}", file=sys.stderr)
            sys.exit(1)
        raise
    except Exception as error:
        if interrupts.came:
            end_stopped(f"stopped; {START_AGAIN}")
        interrupts.ignore()
        if debug:
            raise
        print(f"noiseflow: {_in_one_line(error)}", file=sys.stderr)
        sys.exit(1)


class _Interrupts:
    """Signal handler that raises `KeyboardInterrupt` and records it, as compiled libraries may raise another error instead.

    Args:
        until_exit: whether the process ends with the command; if so, interrupts are ignored once the work is `done`.
    """

    came = done = False

    def __init__(self, *, until_exit: bool) -> None:
        self.until_exit = until_exit

    def ignore(self) -> None:
        """Ignore further interrupts, also while Python removes handlers at shutdown."""
        if self.until_exit and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def __call__(self, number: int, frame: Any) -> None:
        if self.done and self.until_exit:
            return
        self.came = True
        raise KeyboardInterrupt


def _keep_ctrl_c() -> None:
    """Raise an interrupt again if it arrived in an object's destructor, where Python discards exceptions."""
    others, main_thread = sys.unraisablehook, threading.main_thread().ident
    if others.__module__ == __name__ or not hasattr(signal, "pthread_kill") or main_thread is None:
        return

    def again(found: Any) -> Any:
        if not isinstance(found.exc_value, KeyboardInterrupt):
            return others(found)
        return _thread.start_new_thread(resend, ())  # a Timer would wait here, where an interrupt is lost

    def resend() -> None:
        while sys._current_frames()[main_thread].f_code is again.__code__:
            time.sleep(0)
        signal.pthread_kill(main_thread, signal.SIGINT)

    sys.unraisablehook = again


def _in_one_line(error: Exception) -> str:
    notes = getattr(error, "__notes__", ())
    text = printable(" ".join([*str(error).split(), *notes]))
    if isinstance(error, (ValueError, ImportError)):
        return text or type(error).__name__
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return f"out of memory ({text[:200] or 'allocation failed'}); use a smaller or binned input, or fewer voxels"
    if isinstance(error, OSError):
        return printable("; ".join([_system_error(error), *notes]))
    return f"unexpected {type(error).__name__}: {text[:300]}; this is a bug in noiseflow: please report it with --debug"


def _system_error(error: OSError) -> str:
    if error.errno is None or (error.filename is None and error.strerror is None):
        return " ".join(str(error).split())
    where = "" if error.filename is None else f"{error.filename}: "
    fix = {
        **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some space, or write to another disk"),
        errno.EFBIG: "the file-size limit is reached: write to another disk, or raise the limit (ulimit -f)",
        **dict.fromkeys((errno.EACCES, errno.EPERM), "check the permissions, or choose another path"),
        errno.EROFS: "choose a writable folder",
        errno.ENOENT: "check the path",
        errno.ENAMETOOLONG: "choose a shorter name",
    }.get(error.errno, "check the path and the disk")
    return f"{where}{(error.strerror or 'system error').lower()}; {fix}"
