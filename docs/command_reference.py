"""Writes the reference of all commands, docs/api/generated/commands.md, from the commands; Sphinx calls it on each build."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import typer

from noiseflow.commands.cli import build_app

PAGE = Path(__file__).parent / "api" / "generated" / "commands.md"


def write(*_: Any) -> None:
    """Write the page."""
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")


def page() -> str:
    """All commands, their arguments and options, as Markdown."""
    program: Any = typer.main.get_command(build_app())
    parts = [
        "# Commands",
        "Exit codes: 0 (done), 1 (failed; one line states why and what to do), 2 (wrong usage), 130 (interrupted; one line "
        "states how to resume). With `--json` the last line of standard output is one JSON object.",
    ]
    for name, command in program.commands.items():
        parts.append(f"## noiseflow {name}")
        parts += [_options_as_code(" ".join(each.split())) for each in (command.help or "").split("\n\n")]
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        options = [p for p in command.params if p.param_type_name == "option"]
        words = [f"`{_metavar(p)}`: {_help(p)}" for p in arguments]
        if words:
            parts.append("\n".join(f"- {each}" for each in words))
        parts.append("| option | default | meaning |\n|---|---|---|\n" + "\n".join(map(_row, options)))
    return "\n\n".join(parts) + "\n"


def _metavar(parameter: Any) -> str:
    return str(parameter.name).upper()


def _row(option: Any) -> str:
    names = ", ".join(f"`{name}`" for name in [*option.opts, *option.secondary_opts])
    default = option.default
    unset = default is None or default is False or default in ((), [], "") or callable(default)
    shown = "required" if option.required else "" if unset else f"`{default}`"
    return f"| {names} | {shown} | {_help(option)} |"


def _help(parameter: Any) -> str:
    return _options_as_code(" ".join((getattr(parameter, "help", None) or "").split()).replace("|", "\\|"))


def _options_as_code(text: str) -> str:
    """Options of a command as code: elsewhere two hyphens become a dash."""
    return re.sub(r"(`[^`]*`)|(--[a-z][a-z-]*)", lambda found: found[1] or f"`{found[2]}`", text)


if __name__ == "__main__":
    write()
