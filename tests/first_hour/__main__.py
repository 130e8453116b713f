"""The first hour of a new user: good commands on the shipped data, then mistakes; `python -m tests.first_hour [--write]`.

`transcript.txt` holds what they print. A line `=>` after each command gives exit code, grade and new files; these must not
change, the wording may. `--write` writes the transcript again.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parent
TRANSCRIPT = FOLDER / "transcript.txt"
BUSY = re.compile(r"^(seconds|expected|memory|noiseflow 0|[^:]+: \d+/\d+, ).*", re.MULTILINE)  # differs from run to run
OF_THIS_MACHINE = "doctor"


def files(folder: Path) -> set[str]:
    """All files in a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def run(command: str, folder: Path) -> str:
    """The command, what it prints, and its outcome, with paths and times left out."""
    before, (_, *words) = files(folder), shlex.split(command)
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    words = [sys.executable, "-m", "noiseflow", *words]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    said = "" if words[-1] == OF_THIS_MACHINE else BUSY.sub("", done.stdout + done.stderr).replace(str(folder), ".")
    said = "\n".join(line.rstrip() for line in said.splitlines() if line.strip())
    grade = re.search(r"^verdict: (\w+)", done.stdout, re.MULTILINE)
    new = " ".join(sorted(files(folder) - before)) or "none"
    return f"$ {command}\n{said}\n=> exit {done.returncode}, verdict {grade[1] if grade else '-'}, new files: {new}\n"


def outcomes(transcript: str) -> list[str]:
    """The lines with commands and outcomes."""
    return [line for line in transcript.splitlines() if line.startswith(("$ ", "=> "))]


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        commands = (FOLDER / "commands.txt").read_text(encoding="utf-8").splitlines()
        found = "\n".join(run(command, Path(folder)) for command in commands)
    if "--write" in sys.argv:
        TRANSCRIPT.write_text(found, encoding="utf-8")
        return 0
    expected, now = outcomes(TRANSCRIPT.read_text(encoding="utf-8")), outcomes(found)
    wrong = [f"- {old}\n+ {new}" for old, new in zip(expected, now, strict=False) if old != new]
    print("\n".join(wrong) or f"{len(now) // 2} commands as in {TRANSCRIPT.name}")
    return bool(wrong or len(expected) != len(now))


if __name__ == "__main__":
    sys.exit(main())
