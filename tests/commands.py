"""Commands run in this process."""

from __future__ import annotations

import json
from typing import Any

from typer.testing import CliRunner

from noiseflow.commands.cli import build_app


def run_command(*arguments: object) -> dict[str, Any]:
    """Run a command with ``--json``; returns its result, or prints what it printed and raises what it raised."""
    result = CliRunner().invoke(build_app(str(arguments[0])), [*map(str, arguments), "--json"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        print(result.stdout, end="")
        raise result.exception
    found: dict[str, Any] = json.loads(result.stdout.splitlines()[-1])
    return found
