"""Writes the counts and the table of docs/benchmarks/sabotage.md from kept results.

noiseflow benchmark sabotage --size 48 --method l2 --out docs/benchmarks/results
python docs/benchmarks/sabotage.py
"""

from __future__ import annotations

import json
from pathlib import Path

from recon.benchmarks.provenance import measured_on
from recon.benchmarks.sabotage import table

PAGE = Path(__file__).with_suffix(".md")
RESULTS = PAGE.parent / "results" / "sabotage-48-l2-0-full.json"
START, END = "<!-- table -->", "<!-- end of table -->"


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


def main() -> None:
    """Write the page."""
    content = json.loads(RESULTS.read_text(encoding="utf-8"))
    header, rows = table(content["cells"])
    ways = [row for row in rows if not row[0].startswith(("total", "false alarms"))]
    lines = [header, ("---",) * len(header), *ways]
    drawn = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    before, rest = PAGE.read_text(encoding="utf-8").split(START)
    parts = [START, counted(rows), drawn, measured_on([content]), END]
    PAGE.write_text(before + "\n\n".join(parts) + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
