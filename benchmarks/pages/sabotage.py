"""Writes the counts, the tables and the picture of docs/benchmarks/sabotage.md from stored results.

noiseflow benchmark sabotage --size 48 --method l2 --out docs/benchmarks/results
noiseflow benchmark sabotage --size 48 --in-turn --out docs/benchmarks/results
python -m benchmarks.pages.sabotage
"""

from __future__ import annotations

import json
from typing import Any

from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.sabotage import table
from noiseflow.io import atomic_path
from noiseflow.report import new_figure

PAGE = FOLDER / "sabotage.md"
RESULTS = PAGE.parent / "results"
TABLES = {"sabotage-48-l2-0-full.json": "table", "sabotage-48-joint-0-full.json": "joint table"}


OUTCOMES = {"right": "#009E73", "named": "#56B4E9", "other reason": "#E69F00", "missed": "#D55E00"}  # Okabe and Ito


def totals(rows: list[tuple[str, ...]]) -> list[int]:
    """Numbers of spoilt series by outcome, in the order of `OUTCOMES`."""
    counts = {row[0]: row[1] for row in rows}
    return [int(counts[f"total {kind}"]) for kind in OUTCOMES]


def counted(rows: list[tuple[str, ...]]) -> str:
    """The counts at the end of a table, in a sentence."""
    counts = {row[0]: row[1] for row in rows}
    right, named, other, missed = totals(rows)
    return (
        f"Of {right + named + other + missed} spoilt series, {right} are reconstructed right and {named} are graded `doubtful` "
        f"or `bad`, or refused, with the cause among the first two reasons; {other} are graded `doubtful` or `bad` for another "
        f"reason, and {missed} are missed. False alarms among the good series: {counts['false alarms']}."
    )


def drawn(content: dict[str, Any]) -> str:
    """Counts, table and origin of kept results; a way that spoilt one scene alone has that scene in a column of its own."""
    header, rows = table(content["cells"])
    ways = [row for row in rows if not row[0].startswith(("total", "false alarms")) and any(row[1:])]
    if all(sum(map(bool, row[1:])) == 1 for row in ways):
        scenes = [next(pair for pair in zip(header[1:], row[1:], strict=True) if pair[1]) for row in ways]
        header, ways = (
            ("spoilt by", "scene", "outcome"),
            [(row[0], *pair) for row, pair in zip(ways, scenes, strict=True)],
        )
    lines = [header, ("---",) * len(header), *ways]
    parts = [counted(rows), "\n".join(f"| {' | '.join(line)} |" for line in lines), measured_on([content])]
    return "\n\n".join(parts)


def draw(found: dict[str, list[int]]) -> None:
    """One bar for each method of reconstruction, divided by outcome."""
    figure, axes = new_figure(1, width=9, height=1.9)
    axis, hatches = axes[0, 0], ("", "//", "..", "xx")
    for row, numbers in enumerate(found.values()):
        start = 0.0
        for number, (kind, colour), hatch in zip(numbers, OUTCOMES.items(), hatches, strict=True):
            share = 100 * number / sum(numbers)
            axis.barh(row, share, left=start, color=colour, hatch=hatch, edgecolor="white", label=None if row else kind)
            axis.text(start + share / 2, row, str(number), ha="center", va="center", fontsize=9)
            start += share
    axis.set(yticks=range(len(found)), yticklabels=list(found), xlabel="share of spoilt series (%)", xlim=(0, 100))
    axis.invert_yaxis()
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncol=4, frameon=False, fontsize=9)
    with atomic_path(PAGE.with_suffix(".png")) as partial:
        figure.savefig(partial, format="png", dpi=110, facecolor="white")


def main() -> None:
    """Write the page and its picture."""
    page = PAGE.read_text(encoding="utf-8")
    found: dict[str, list[int]] = {}
    for file, name in TABLES.items():
        start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, rest = page.split(start)
        content = json.loads((RESULTS / file).read_text(encoding="utf-8"))
        rows = table(content["cells"])[1]
        found[f"{'joint fit' if name == 'joint table' else 'least squares'}, {sum(totals(rows))}"] = totals(rows)
        page = before + "\n\n".join([start, drawn(content), end]) + rest.split(end)[1]
    PAGE.write_text(page, encoding="utf-8")
    draw(found)


if __name__ == "__main__":
    main()
