"""Writes the tables of all checks, docs/api/generated/checks.md; Sphinx calls it on each build."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibration.verdict import CHECKS as OF_EXPOSURES
from calibration.verdict import COMMON, FLATS
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
        "A verdict is a table. Each row states one assumption of the reconstruction or calibration, measures how far the data "
        "deviate from it, and compares the deviation with its standard error and with a tolerance. A row gives a reason "
        "if the deviation is "
        "significant *and* larger than its tolerance. Facts of the files come first, because they explain the rest; then "
        "distortions of the images relative to the volume or to the other tilts; then statistics without a parameter. Within "
        "each group, the reason that exceeds its tolerance most comes first. The grade is *bad* if one of the reasons exceeds "
        "its tolerance three times and affects the whole volume, *doubtful* for any other reason, and *good* otherwise. A check "
        "that fails or does not apply is listed as *not tested*. `--json` gives effect, error, tolerance and unit of every row.",
    ]
    tables = {title: [row for row in CHECKS.values() if row.engine == engine] for engine, title in ENGINES.items()}
    tables["Calibration from exposures of a scene"] = [row for row in OF_EXPOSURES if row not in COMMON]
    tables["Calibration from flats and darks"] = list(FLATS)
    tables["Calibration from either"] = list(COMMON)
    for title, checks in tables.items():
        rows = [_row(check) for check in checks]
        parts += [f"## {title}", "| check | reason | tolerance | advice |\n|---|---|---|---|\n" + "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def _row(check: Check[Any]) -> str:
    tolerance = "depends on the series" if callable(check.tolerance) else f"{check.tolerance:g} {check.unit}".strip()
    return f"| {check.name} | {check.reason} | {tolerance} | {check.advice} |"
