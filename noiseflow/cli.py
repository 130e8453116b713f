"""The program `noiseflow`: finds its commands by entry point, and turns user mistakes into one clear line.

Nothing here imports torch, so that ``noiseflow -h`` answers at once.
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points, version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

_ORDER = ("demo", "calibrate", "sample", "evaluate", "simulate", "reconstruct", "compare")


def build_app() -> typer.Typer:
    """The command-line application with every installed command."""
    app = typer.Typer(
        name="noiseflow",
        help="Learn a microscope's noise, sample it, and reconstruct clean volumes from noisy tilt series.",
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)
    found = {point.name: point for point in entry_points(group="noiseflow.commands")}
    for name in sorted(found, key=lambda n: (_ORDER.index(n) if n in _ORDER else len(_ORDER), n)):
        app.command(name, cls=_ListCommand)(found[name].load())
    return app


class _ListCommand(TyperCommand):
    """A command whose list options take several values: ``--short a b c`` for ``--short a --short b --short c``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        lists = {name for option in self.params if getattr(option, "multiple", False) for name in option.opts}
        spread: list[str] = []
        current = None
        for argument in args:
            if argument.startswith("-") and argument != "-":
                current = argument if argument in lists else None
            elif current is not None and spread[-1] != current:
                spread.append(current)
            spread.append(argument)
        rest: list[str] = super().parse_args(ctx, spread)
        return rest


def _show_version(asked: bool) -> None:
    if asked:
        print(f"noiseflow {version('noiseflow')}")
        raise typer.Exit()


def _options(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Version.")
    ] = False,
) -> None:
    """Learn a microscope's noise, sample it, and reconstruct clean volumes from noisy tilt series."""
    del context, debug, show_version


def main(arguments: list[str] | None = None) -> None:
    """Run the program and exit: 0 done, 1 could not do it (one line says why and the fix), 2 usage."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    try:
        build_app()(args=arguments, prog_name="noiseflow")
    except KeyboardInterrupt:
        print("noiseflow: stopped", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(1)
    except (ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
        if debug:
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        print(f"noiseflow: {text}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
