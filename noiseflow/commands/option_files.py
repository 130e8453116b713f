"""Long lists of options: groups in the help, and options read from and written to a TOML file."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

_GROUPS = "__option_groups__"
_Command = TypeVar("_Command", bound=Callable[..., None])


def option_groups(groups: Mapping[str, Sequence[str]]) -> Callable[[_Command], _Command]:
    """Decorate a command: its help shows these groups only with ``--help-all``, all other options always.

    Args:
        groups: title → names of the parameters.
    """

    def decorate(command: _Command) -> _Command:
        setattr(command, _GROUPS, groups)
        return command

    return decorate


def shared_options(command: Any) -> list[Any]:
    """The options that every command has for its options: ``--options``, and ``--help-all`` where groups are hidden."""
    titles = ", ".join(groups_of(command)).lower()

    def declare(
        options: Annotated[
            Path | None,
            typer.Option(
                is_eager=True,
                expose_value=False,
                callback=_from_file,
                help="TOML file with options, such as options.toml in the report of an earlier run.",
            ),
        ] = None,
        help_all: Annotated[
            bool, typer.Option("--help-all", is_eager=True, expose_value=False, callback=_show_all)
        ] = False,
    ) -> None: ...

    app = typer.Typer(add_completion=False)
    app.command()(declare)
    made: dict[str | None, Any] = {parameter.name: parameter for parameter in typer.main.get_command(app).params}
    made["help_all"].help = f"Show all options: {titles}."
    own = {parameter.name for parameter in command.params}
    wanted = ["options", "help_all"] if titles else ["options"]
    return [made[name] for name in wanted if name not in own]


def groups_of(command: Any) -> Mapping[str, Sequence[str]]:
    """Title → parameters of the groups of a command; empty without groups."""
    found: Mapping[str, Sequence[str]] = getattr(command.callback, _GROUPS, {})
    return found


def arrange(command: Any, parameters: Sequence[Any], *, everything: bool) -> None:
    """Give every grouped parameter its title, and hide it unless `everything` is shown."""
    titles = {name: title for title, names in groups_of(command).items() for name in names}
    for parameter in parameters:
        if parameter.name in titles:
            parameter.rich_help_panel, parameter.hidden = titles[parameter.name], not everything


def write_options(path: Path, options: Mapping[str, tuple[Any, bool]]) -> None:
    """Write the options that the user set as a TOML file for ``--options``; inputs are written like other options.

    Args:
        path: file to write.
        options: parameter → value, and whether the user set it.
    """
    from noiseflow.io import atomic_path

    lines = ["# noiseflow: options of this run, for --options"]
    lines += [f"{name.replace('_', '-')} = {_toml(value)}" for name, (value, given) in options.items() if given]
    with atomic_path(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value if isinstance(value, (bool, int, float)) else str(value), ensure_ascii=False)


def _from_file(context: typer.Context, value: Path | None) -> None:
    if value is None:
        return
    try:
        found = tomllib.loads(value.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(
            f"--options {value} is not a TOML file ({error}); write one line for each, mode = 'linear'"
        ) from error
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
        context.meta[_GROUPS] = True
        typer.echo(context.get_help())
        raise typer.Exit()


def shows_everything(context: typer.Context) -> bool:
    """Whether ``--help-all`` was given."""
    return bool(context.meta.get(_GROUPS))
