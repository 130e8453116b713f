"""A table and a chart of the gain against a setting of the camera, to which each calibration adds its row."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from calibration.report.exports import Figure
from noiseflow.io import atomic_path
from noiseflow.report import Chart
from noiseflow.runs.ownership import is_own, signature

HEADER = ("setting", "figure", "unit", "value", "5 %", "95 %", "verdict")


def add_to_series(path: Path, setting: float, figures: list[Figure], verdict: str) -> list[Path]:
    """Add the figures of one setting to a CSV table, in place of its former ones, and draw the gains beside it as SVG.

    Args:
        path: the table; created if it does not exist.
        setting: ISO number, amplifier gain or multiplication that the exposures were recorded with.
        figures: from `figures_of_camera` or `figures_of_exposures`.
        verdict: grade of the calibration.

    Returns:
        Paths of table and chart.
    """
    rows = [row for row in read_series(path) if float(row["setting"]) != setting]
    for one in figures:
        values = (f"{setting:g}", one.name, one.unit, one.value, one.low, one.high, verdict)
        rows.append({name: "" if value is None else str(value) for name, value in zip(HEADER, values, strict=True)})
    rows.sort(key=lambda row: float(row["setting"]))
    chart = path.with_suffix(".svg")
    with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        stream.write(f"# {signature()}\n")
        table = csv.DictWriter(stream, HEADER)
        table.writeheader()
        table.writerows(rows)
    with atomic_path(chart) as partial:
        chart_of(rows).save(partial)
    return [path, chart]


def read_series(path: Path) -> list[dict[str, str]]:
    """Read the rows of a table; none if it does not exist.

    Raises:
        ValueError: the file is no such table.
    """
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()[1:] if is_own(path) else []
    table = csv.DictReader(lines)
    if lines and tuple(table.fieldnames or ()) == HEADER:
        return list(table)
    raise ValueError(f"{path} is no table of a gain series; name a new file with --series")


def chart_of(rows: list[dict[str, str]]) -> Chart:
    """Draw the gain of each setting with its 90 % interval, and the line of gains proportional to the setting."""
    gains = [row for row in rows if row["figure"] == "system gain" and row["value"]]
    setting, value, low, high = (
        np.array([float(row[name] or row["value"]) for row in gains]) for name in ("setting", "value", "5 %", "95 %")
    )
    chart = Chart("Gain against setting", x="setting", y="gain, counts/e⁻", log="xy" if np.all(setting > 0) else "")
    chart.plot(setting, value, width=0.0, dots=2.5, label="gain and 90 % interval")
    for at, *ends in zip(setting, low, high, strict=True):
        chart.plot([at, at], ends, width=1.0)
    if len(setting) > 1 and np.all(setting > 0):
        line = setting * np.exp(np.mean(np.log(value / setting)))
        chart.plot(setting, line, dashes="4 3", label="proportional to the setting")
    return chart
