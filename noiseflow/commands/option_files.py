"""Long lists of options: groups in the help, and options read from a TOML file."""

import difflib
import functools
import inspect
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import typer

from noiseflow.runs.outputs import require_ending

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
