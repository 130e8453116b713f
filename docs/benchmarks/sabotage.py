"""Writes the counts and the table of docs/benchmarks/sabotage.md from kept results.

noiseflow benchmark sabotage --size 48 --method l2 --out docs/benchmarks/results
noiseflow benchmark sabotage --size 48 --in-turn --out docs/benchmarks/results
python docs/benchmarks/sabotage.py
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from recon.benchmarks.provenance import measured_on
from recon.benchmarks.sabotage import table

PAGE = Path(__file__).with_suffix(".md")
RESULTS = PAGE.parent / "results"
TABLES = {"sabotage-48-l2-0-full.json": "table", "sabotage-48-joint-0-full.json": "joint table"}


def counted(rows: list[tuple[str, ...]]) -> str:
    """The counts at the end of a table, in a sentence."""
    counts = {row[0]: row[1] for row in rows}
    right, named, other, missed = (
        int(counts[f"total {kind}"]) for kind in ("right", "named", "other reason", "missed")
    )
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


def main() -> None:
    """Write the page."""
    page = PAGE.read_text(encoding="utf-8")
    for file, name in TABLES.items():
        start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, rest = page.split(start)
        content = json.loads((RESULTS / file).read_text(encoding="utf-8"))
        page = before + "\n\n".join([start, drawn(content), end]) + rest.split(end)[1]
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
