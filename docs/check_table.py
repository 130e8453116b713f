"""Writes the table of all checks of a reconstruction, docs/api/generated/checks.md; Sphinx calls it on each build."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from noiseflow.checks import Check
from recon.verdict.table import CHECKS

PAGE = Path(__file__).parent / "api" / "generated" / "checks.md"
ENGINES = {
    "fact": "Facts of the files",
    "distortion": "Distortions",
    "predictive": "Other statistics",
}


def write(*_: Any) -> None:
    """Write the page."""
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")


def page() -> str:
    """How a verdict is made, and every check with its tolerance, as Markdown."""
    parts = [
        "# How a verdict is made",
        "A verdict is a table. Each row states one assumption of the reconstruction, measures how far the data deviate from "
        "it, and compares the deviation with its standard error and with a tolerance. A row gives a reason if the deviation is "
        "significant *and* larger than its tolerance. Facts of the files come first, because they explain the rest; then "
        "distortions of the images relative to the volume or to the other tilts; then statistics without a parameter. Within "
        "each group, the reason that exceeds its tolerance most comes first. The grade is *bad* if one of the reasons exceeds "
        "its tolerance three times and affects the whole volume, *doubtful* for any other reason, and *good* otherwise. A check "
        "that fails or does not apply is listed as *not tested*. `--json` gives effect, error, tolerance and unit of every row.",
    ]
    for engine, title in ENGINES.items():
        rows = [_row(check) for check in CHECKS.values() if check.engine == engine]
        parts += [f"## {title}", "| check | reason | tolerance | advice |\n|---|---|---|---|\n" + "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def _row(check: Check[Any]) -> str:
    tolerance = "depends on the series" if callable(check.tolerance) else f"{check.tolerance:g} {check.unit}".strip()
    return f"| {check.name} | {check.reason} | {tolerance} | {check.advice} |"
