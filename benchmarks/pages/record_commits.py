"""Writes into the results measured before rows kept their commit, in which commit, and when, each row was first recorded.

python -m benchmarks.pages.record_commits [FILE ...]    # all results if none is named; then draw the pages again
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.pages import FOLDER

RESULTS = FOLDER / "results"
OWN = ("commit", "recorded", "date")  # what this script and the benchmarks say about a row


def record(path: Path) -> int:
    """Complete the rows of one file; how many."""
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    missing = {name: cell for name, cell in found["cells"].items() if not any(cell.get(key) for key in OWN[:2])}
    if missing:
        versions = history(path)
        for name, cell in missing.items():
            cell["recorded"], cell["date"] = first_with(name, cell, versions)
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return len(missing)


def history(path: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """(commit, date, rows) of every version of a file, newest first."""
    commits = [line.split() for line in _git(path, "log", "--format=%h %cs", "--", path.name).splitlines()]
    versions = ((commit, date, _git(path, "show", f"{commit}:./{path.name}")) for commit, date in commits)
    return [(commit, date, json.loads(text)["cells"]) for commit, date, text in versions]


def first_with(name: str, cell: dict[str, Any], versions: list[tuple[str, str, dict[str, Any]]]) -> tuple[str, str]:
    """Commit and date of the oldest version since which a row has its figures.

    Raises:
        ValueError: not even the newest version has them.
    """
    since = None
    for commit, date, rows in versions:
        if _figures(rows.get(name, {})) != _figures(cell):
            break
        since = commit, date
    if since is None:
        raise ValueError(f"{name!r} is in no commit; commit the results first")
    return since


def _figures(cell: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in cell.items() if key not in OWN}


def _git(path: Path, *words: str) -> str:
    return subprocess.run(["git", *words], cwd=path.parent, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]) if sys.argv[1:] else sorted(RESULTS.glob("*.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(content, dict) and "machines" in content:  # of `noiseflow benchmark` and joint.py
            print(f"{path.name}: {record(path)} rows completed")
