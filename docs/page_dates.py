"""Adds to each benchmark page that names no commit the one that recorded its figures; Sphinx calls it for each page.

A page's figures are those of results/PAGE.json, or of files that begin with PAGE; where it has none, of the page itself.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "benchmarks"


def add(_: Any, name: str, source: list[str]) -> None:
    """Append the line, where git knows of a commit."""
    folder, _, page = name.rpartition("/")
    if folder == "benchmarks" and "commit" not in source[0] and (found := recorded(page)):
        source[0] += f"\n*Figures recorded by commit {found[0]}, {found[1]}.*\n"


def recorded(page: str) -> tuple[str, str] | None:
    """Commit and date of the last change of a page's figures; None outside a git checkout."""
    results = sorted((FOLDER / "results").glob(f"{page}*")) or [FOLDER / f"{page}.md"]
    words = ["git", "log", "-1", "--format=%h %cs", "--", *map(str, results)]
    try:
        found = subprocess.run(words, cwd=FOLDER, capture_output=True, text=True, check=True).stdout.split()
    except (OSError, subprocess.CalledProcessError):
        return None
    return (found[0], found[1]) if found else None
