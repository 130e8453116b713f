"""Draws the import graph of the three packages: one dot per file, one group per folder, one line per import.

python docs/gallery/import_graph.py [PICTURE.svg [COMMIT]]    # without arguments: docs/images/imports_now.svg
"""

from __future__ import annotations

import ast
import math
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from drawing import BLUE, GREEN, ORANGE, main, new_figure

ROOT = Path(__file__).parent.parent.parent
PACKAGES = {"noiseflow": BLUE, "calibration": GREEN, "recon": ORANGE}


def sources(commit: str | None) -> dict[str, str]:
    """Module name → source, of the working tree or of a commit."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout

    if commit is None:
        found = {
            str(f.relative_to(ROOT)): f.read_text(encoding="utf-8") for p in PACKAGES for f in (ROOT / p).rglob("*.py")
        }
    else:
        names = [n for n in git("ls-tree", "-r", "--name-only", commit, *PACKAGES).split() if n.endswith(".py")]
        found = {name: git("show", f"{commit}:{name}") for name in names}
    return {n[:-3].replace("/", "."): s for n, s in found.items() if not n.endswith("__init__.py")}


def imports(modules: dict[str, str]) -> set[tuple[str, str]]:
    """Pairs of a module and one that it imports, anywhere in its file."""
    found = set()
    for name, source in modules.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                given = {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                given = {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            else:
                continue
            found |= {(name, other) for other in given if other in modules and other != name}
    return found


def in_circles(modules: dict[str, str], edges: set[tuple[str, str]]) -> set[str]:
    """The modules that import one another in a circle, or lie between such circles."""
    left = set(modules)
    while True:
        used = {a for a, b in edges if a in left and b in left} & {b for a, b in edges if a in left and b in left}
        if used == left:
            return left
        left = used


def places(modules: dict[str, str]) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float, float]]]:
    """Where each module stands, and the middle and radius of each folder."""
    folders: dict[str, list[str]] = defaultdict(list)
    for name in sorted(modules):
        folders[name.rpartition(".")[0]].append(name)
    at, rings, row = {}, {}, 0.0
    for package in PACKAGES:
        x = line = 0.0
        for folder, names in folders.items():
            if folder.split(".")[0] != package:
                continue
            radius = 0.25 + 0.075 * len(names)
            if x + 2 * radius > 16:
                row, x, line = row - line - 1.1, 0.0, 0.0
            middle = (x + radius, row - radius)
            rings[folder] = (*middle, radius)
            for place, name in enumerate(names):
                angle = 2 * math.pi * place / len(names)
                at[name] = (middle[0] + radius * math.sin(angle), middle[1] + radius * math.cos(angle))
            x, line = x + 2 * radius + 1.4, max(line, 2 * radius)
        row -= line + 1.4
    return at, rings


def draw(commit: str | None = None) -> Any:
    """Draw the graph of the working tree, or of a commit."""
    modules = sources(commit)
    edges, (at, rings) = imports(modules), places(modules)
    circles = in_circles(modules, edges)
    figure, panels = new_figure(width=9, height=9 * (1.5 - min(y - r for _, y, r in rings.values())) / 18)
    axes = panels[0, 0]
    for a, b in edges:
        bad = a in circles and b in circles
        (x0, y0), (x1, y1) = at[a], at[b]
        axes.plot(
            (x0, x1),
            (y0, y1),
            color="black" if bad else PACKAGES[a.split(".")[0]],
            lw=1.2 if bad else 0.35,
            alpha=0.8 if bad else 0.25,
        )
    for name, (x, y) in at.items():
        axes.plot(x, y, ".", color=PACKAGES[name.split(".")[0]], ms=5)
    for folder, (x, y, radius) in rings.items():
        words = folder.replace(".", "/").replace(
            "distributions/", "distributions/\n"
        )  # these stand close to each other
        axes.text(x, y + radius + 0.12, words, ha="center", va="bottom", fontsize=7)
    axes.set_aspect("equal")
    axes.axis("off")
    what = "now" if commit is None else f"at {commit}"
    size = max(sum(name.rpartition(".")[0] == folder for name in modules) for folder in rings)
    axes.set_title(
        f"Imports {what}: {len(modules)} files in {len(rings)} folders (largest: {size} files), {len(edges)} imports, "
        f"{len(circles)} files in circles (black)",
        fontsize=9,
    )
    return figure


if __name__ == "__main__":
    main(lambda: draw(*sys.argv[2:3]), "imports_now.svg")
