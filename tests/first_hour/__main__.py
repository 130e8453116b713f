"""The first hour of a new user: good commands on the shipped data, then mistakes; `python -m tests.first_hour [--write]`.

`transcript.txt` holds what they print. A line `=>` after each command gives exit code, grade and new files; these must not
change, the wording may. `--write` writes the transcript again. Each command starts once as a program of its own; when it comes
again, it is forked from this one, for importing takes longer than a mistake.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO

import calibration.report.page
import recon.commands.results
import recon.simulate.simulation
from noiseflow.commands.cli import main as noiseflow
from tests.processes import FORK

FOLDER = Path(__file__).parent
TRANSCRIPT = FOLDER / "transcript.txt"
BUSY = re.compile(r"^(seconds|expected|memory|noiseflow 0|[^:]+: \d+/\d+, ).*", re.MULTILINE)  # differs from run to run
OF_THIS_MACHINE = "doctor"
TERMINAL = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
LOADED = (
    calibration.report.page,
    recon.commands.results,
    recon.simulate.simulation,
)  # so that forks need not import them


def files(folder: Path) -> set[str]:
    """All files in a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def run(command: str, folder: Path, *, started: bool) -> str:
    """The command, what it prints, and its outcome, with paths and times left out; forked if it has `started` before."""
    before, (_, *words) = files(folder), shlex.split(command)
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as errors:
        if started:
            process = FORK.Process(target=_forked, args=(words, folder, out.fileno(), errors.fileno()))
            process.start()
            process.join()
            code = process.exitcode
        else:
            program, environment = [sys.executable, "-m", "noiseflow", *words], os.environ | TERMINAL
            code = subprocess.run(program, cwd=folder, env=environment, stdout=out, stderr=errors).returncode
        printed, complained = (_read(stream) for stream in (out, errors))
    said = "" if words[-1] == OF_THIS_MACHINE else BUSY.sub("", printed + complained).replace(str(folder), ".")
    said = "\n".join(line.rstrip() for line in said.splitlines() if line.strip())
    grade = re.search(r"^verdict: (\w+)", printed, re.MULTILINE)
    new = " ".join(sorted(files(folder) - before)) or "none"
    return f"$ {command}\n{said}\n=> exit {code}, verdict {grade[1] if grade else '-'}, new files: {new}\n"


def _forked(words: list[str], folder: Path, *outputs: int) -> None:
    for number, output in enumerate(outputs, 1):
        os.dup2(output, number)
    os.chdir(folder)
    os.environ.update(TERMINAL)
    sys.argv = ["noiseflow", *words]
    noiseflow()


def _read(stream: IO[str]) -> str:
    stream.seek(0)
    return stream.read()


def outcomes(transcript: str) -> list[str]:
    """The lines with commands and outcomes."""
    return [line for line in transcript.splitlines() if line.startswith(("$ ", "=> "))]


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        commands = (FOLDER / "commands.txt").read_text(encoding="utf-8").splitlines()
        names = [command.split()[1] for command in commands]
        found = "\n".join(
            run(command, Path(folder), started=name in names[:at])
            for at, (name, command) in enumerate(zip(names, commands, strict=True))
        )
    if "--write" in sys.argv:
        TRANSCRIPT.write_text(found, encoding="utf-8")
        return 0
    expected, now = outcomes(TRANSCRIPT.read_text(encoding="utf-8")), outcomes(found)
    wrong = [f"- {old}\n+ {new}" for old, new in zip(expected, now, strict=False) if old != new]
    print("\n".join(wrong) or f"{len(now) // 2} commands as in {TRANSCRIPT.name}")
    return bool(wrong or len(expected) != len(now))


if __name__ == "__main__":
    sys.exit(main())
