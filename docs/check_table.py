"""Writes the tables of all checks, docs/api/generated/checks.md; Sphinx calls it on each build."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import noiseflow
import recon
from calibration.verdict import CHECKS as OF_EXPOSURES
from calibration.verdict import COMMON, FLATS
from noiseflow.checks import Check
from noiseflow.report import effects_chart
from recon.verdict.compared import WIDTH
from recon.verdict.judge import judge
from recon.verdict.table import CHECKS

PAGE = Path(__file__).parent / "api" / "generated" / "checks.md"
ENGINES = {
    "fact": "Facts of the files and of the fit",
    "distortion": "Distortions",
    "predictive": "Statistics without a parameter",
}


def write(*_: Any) -> None:
    """Write the page."""
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")
    draw(PAGE.with_suffix(".svg"))


def draw(path: Path) -> None:
    """The effects of one series: the needle after too few iterations."""
    data = Path(noiseflow.__file__).parent / "data" / "tilt_needle" / "needle_aligned.mrc"
    series = recon.read_tilt_series(data, mode="linear")
    verdict = judge(series, recon.reconstruct(series, method="sirt", num_steps=10))
    effects_chart(verdict).save(path)


def page() -> str:
    """How a verdict is made, and every check with its tolerance, as Markdown."""
    parts = [
        "# How a verdict is made",
        "A verdict is a table. Each row states one assumption of the reconstruction or calibration, measures how far the data "
        "deviate from it, and compares the deviation with its standard error and with a tolerance. A row gives a reason "
        "if the deviation is "
        "significant *and* larger than its tolerance. Facts of the files come first, because they explain the rest; then "
        "distortions of the images relative to the other tilts; then statistics without a parameter. Within "
        "each group, what spoils the whole volume comes first, and then the reason that exceeds its tolerance most; distortions "
        "that compete for the same data count by the share that each explains, and one that explains less than a tenth of what "
        "the best one explains is no reason. The grade is *bad* if one of the reasons exceeds "
        "its tolerance three times and affects the whole volume, *doubtful* for any other reason, and *good* otherwise. "
        "A check that fails or does not apply is listed as *not tested*. `--json` gives effect, error, tolerance and unit of "
        "every row.",
        "![Effects of one series with error bars, in tolerances](checks.svg)",
        "*The shipped needle after 10 iterations of SIRT: each effect with two standard errors. One exceeds its tolerance: the "
        "volume has not converged. Every report contains this picture for its own series.*",
        "**The tilt axis**, its turn, its position and the scale of the angles come from moments: each moment of a row of line "
        "integrals is a trigonometric polynomial of the tilt if the object lies within the field (Helgason–Ludwig conditions). "
        "Volumes of blurred arcs predict left-out tilts well even if the axis is wrong by some degrees; they violate moments. "
        "A response that is not linear violates them too, and what none of these faults explains is the row *moments of the "
        "rows*. The scale of the angles counts by what it exceeds that of replicates, because a missing wedge biases it, and "
        "only if held-out tilts agree.",
        "**Displaced lines** are measured twice, from different pixels; the mean of the products of both is the "
        "variance of the displacements without the noise.",
        f"**Distortions** are measured on a coarse series, at most {WIDTH} pixels wide. What the volume has not explained of an "
        "image is predicted by a linear fit to the other tilts; the rest is regressed on the effects of a shift, a rotation, a "
        "magnification, another angle, brightness, and a background with slopes and curvatures. Standard errors allow for "
        f"correlated noise. Tolerances in coarse pixels are multiplied by the binning, which is 1 for images of {WIDTH} pixels.",
        "**Replicates** are series that the given geometry explains: the linear fit, with its own residuals in random signs. "
        "Statistics without a parameter, and other geometries, count by what they exceed those of the replicates, by "
        "Student's t, because replicates are few.",
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
