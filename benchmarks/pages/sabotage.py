"""Writes docs/benchmarks/sabotage.md and its picture from stored evidence, graded anew by the present limits.

noiseflow benchmark sabotage --size 48 --out docs/benchmarks/results
python -m benchmarks.pages.sabotage
python -m benchmarks.pages.sabotage limits
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.pages import FOLDER
from benchmarks.provenance import measured_on
from benchmarks.sabotage import PHANTOMS, false_alarm, graded_anew, judging, kept, outcome, table
from noiseflow.checks import SIGNIFICANT
from noiseflow.io import atomic_path
from noiseflow.report import new_figure
from recon.verdict.table import CHECKS

PAGE = FOLDER / "sabotage.md"
RESULTS = PAGE.parent / "results" / "sabotage-48-sirt-0-full.json"
START, END = "<!-- table -->", "<!-- end of table -->"
COSTLY = 1.0  # dB: smaller losses are those of another noise
OUTCOMES = {"right reason": "#009E73", "other reason": "#E69F00", "missed": "#D55E00"}  # Okabe and Ito
Cells = dict[str, Any]


def costly(cells: Cells, half: str) -> dict[str, int]:
    """Number of faults of a half, or of both, that cost more than a decibel, or leave no comparable volume, by outcome."""
    counts, judges = dict.fromkeys(OUTCOMES, 0), judging()
    for key, cell in cells.items():
        kind, *names = key.split("/", 2)
        if kind == "spoilt" and half in ("both", "kept" if names[0] in judges else "used"):
            found, loss = outcome(names[0], cell, cells[f"reference/{names[1]}"]["psnr"])
            if loss is None or loss > COSTLY:
                counts[found] += 1
    return counts


def unspoilt(cells: Cells, half: str) -> Cells:
    """Unspoilt series of the scenes of a half, or of both."""
    scenes = {"kept": kept(PHANTOMS), "used": set(PHANTOMS) - kept(PHANTOMS), "both": set(PHANTOMS)}[half]
    return {key: cell for key, cell in cells.items() if key.startswith("good/") and key[5:].split(",")[0] in scenes}


def counted(cells: Cells, half: str, name: str) -> str:
    """The counts of a half, as a row of a table."""
    found, good = costly(cells, half), unspoilt(cells, half)
    number = sum(found.values())
    alarms = sum(map(false_alarm, good.values()))
    seen = number - found["missed"]
    if not number:
        return f"| {name} | 0 | | | {alarms} of {len(good)} |"
    shares = f"{seen} ({seen / number:.0%}) | {found['right reason']} ({found['right reason'] / number:.0%})"
    return f"| {name} | {number} | {shares} | {alarms} of {len(good)} ({alarms / len(good):.0%}) |"


def drawn(content: dict[str, Any]) -> str:
    """Counts, false alarms, table and origin of kept results."""
    cells = content["cells"]
    head = "| half | faults that cost more than 1 dB | not good | right reason first | false alarms |\n|---|---|---|---|---|"
    alarms = [
        f"- {key.partition('/')[2]}: {', '.join(cell['names'])}"
        for key, cell in cells.items()
        if key.startswith(("good/", "fresh/", "other/")) and false_alarm(cell)
    ]
    header, rows = table(cells)
    lines = "\n".join(f"| {' | '.join(line)} |" for line in (header, ("---",) * len(header), *rows))
    counts = "\n".join([head, *(counted(cells, half, half) for half in ("kept", "used")), *others(cells), *methods()])
    return "\n\n".join([counts, "False alarms:", "\n".join(alarms) or "none", lines, measured_on([content])])


def others(cells: Cells) -> list[str]:
    """Rows for unspoilt series that were drawn last, and for those of other scenes, projectors and noise, and real ones."""
    rows = []
    for kind, name in (("fresh", "drawn after the limits were set"), ("other", "other scenes, real series")):
        found = [false_alarm(cell) for key, cell in cells.items() if key.startswith(f"{kind}/")]
        rows += [f"| {name} | | | | {sum(found)} of {len(found)} ({sum(found) / len(found):.0%}) |"] if found else []
    return rows


def methods() -> list[str]:
    """A row for a sample of both halves by each other method."""
    rows = []
    for path in sorted(RESULTS.parent.glob("sabotage-*.json")):
        if path != RESULTS:
            cells = stored_grades(path)["cells"]
            size, method = path.name.split("-")[1:3]
            rows.append(counted(cells, "both", f"both, a sample by `{method}`, {size}³"))
    return rows


def stored_grades(path: Path) -> dict[str, Any]:
    """Stored results, graded by the present limits."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content | {"cells": {key: graded_anew(cell) for key, cell in content["cells"].items()}}


def limits(cells: Cells) -> list[str]:
    """The largest significant effect of each check in used unspoilt series, and how many ways it alone catches."""
    good, rows = unspoilt(cells, "used").values(), []
    fired = [
        cell["names"] for key, cell in cells.items() if key.startswith("spoilt/") and len(cell.get("names", ())) == 1
    ]
    for name, check in CHECKS.items():
        effects = [cell["evidence"][name] for cell in good if name in cell["evidence"]]
        sizes = [abs(value - check.null) / tolerance for value, error, tolerance, _ in effects
                 if tolerance and abs(value - check.null) >= min(check.score, SIGNIFICANT) * (error or 0)]  # fmt: skip
        rows.append(
            f"{name:32s} {max(sizes, default=0):6.2f} tolerances; alone {sum(name in names for names in fired)}"
        )
    return rows


def draw(cells: Cells) -> None:
    """One bar for each half, divided by outcome."""
    figure, axes = new_figure(1, width=9, height=1.9)
    axis, hatches = axes[0, 0], ("", "..", "xx")
    for row, half in enumerate(("kept", "used")):
        numbers, start = costly(cells, half), 0.0
        for (kind, number), hatch in zip(numbers.items(), hatches, strict=True):
            share = 100 * number / sum(numbers.values())
            axis.barh(
                row,
                share,
                left=start,
                color=OUTCOMES[kind],
                hatch=hatch,
                edgecolor="white",
                label=None if row else kind,
            )
            axis.text(start + share / 2, row, str(number), ha="center", va="center", fontsize=9)
            start += share
    axis.set(yticks=(0, 1), yticklabels=("kept ways", "used ways"), xlim=(0, 100))
    axis.set_xlabel("share of faults that cost more than 1 dB (%)")
    axis.invert_yaxis()
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncol=3, frameon=False, fontsize=9)
    with atomic_path(PAGE.with_suffix(".png")) as partial:
        figure.savefig(partial, format="png", dpi=110, facecolor="white")


def main(arguments: list[str]) -> None:
    """Write the page and its picture, or print what limits would be."""
    content = stored_grades(RESULTS)
    if arguments == ["limits"]:
        print("\n".join(limits(content["cells"])))
        return
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(
        page.split(START)[0] + "\n\n".join([START, drawn(content), END]) + page.split(END)[1], encoding="utf-8"
    )
    draw(content["cells"])


if __name__ == "__main__":
    main(sys.argv[1:])
