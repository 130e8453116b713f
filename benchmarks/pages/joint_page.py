"""The results page of the joint reconstruction, joint.md, from results/joint.json alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.pages import FOLDER, dots
from benchmarks.pages.joint_accuracy import FIELDS, NOISES, PHANTOMS
from benchmarks.provenance import measured_on
from noiseflow.io import atomic_path

PAGE = FOLDER / "joint.md"
_METHODS = ("joint", "oracle", "least squares")
_VOLUME_GOAL, _PROJECTION_GOAL, _LEAST_SQUARES_GOAL = 0.15, 0.5, 0.05
_COUNT = len(PHANTOMS) * len(NOISES)
Row = dict[str, Any]


def write(content: Row) -> None:
    """Write the page and its picture."""
    if rows := _rows(content["cells"], "accuracy/"):
        dots.save(PAGE.with_suffix(".png"), [_panel(rows)], columns=1)
    with atomic_path(PAGE) as partial:
        partial.write_text(page(content), encoding="utf-8")


def accuracy_line(row: Row) -> str:
    """One row in words."""
    scores = ", ".join(f"{name} {_pair(row[name])}" for name in _METHODS)
    return f"{row['phantom']}, {row['noise']}: {scores} dB; {row['joint']['seconds']:.0f} s"


def page(content: Row) -> str:
    """The page as Markdown."""
    cells = content["cells"]
    accuracy = _rows(cells, "accuracy/")
    fields = _rows(cells, "fields/")
    offset = _rows(cells, "offset/")
    speed = {key.removeprefix("speed/"): row for key, row in cells.items() if key.startswith("speed/")}
    parts = [_head(accuracy), _accuracy(accuracy), _fields(fields), _offset(offset), _speed(speed), _origin(content)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _rows(cells: Row, start: str) -> list[Row]:
    found = [row for key, row in cells.items() if key.startswith(start)]
    return sorted(found, key=lambda row: (PHANTOMS.index(row["phantom"]), _place(row)))


def _place(row: Row) -> int:
    return NOISES.index(row["noise"]) if "noise" in row else 0


def _head(accuracy: list[Row]) -> str:
    parts = ["# Joint reconstruction: accuracy and speed"]
    if accuracy:
        parts.append(
            "![Volume PSNR of the joint fit above least squares and above the oracle, for every scene](joint.png)"
        )
        parts.append(_summary(accuracy))
    return "\n\n".join(parts)


def _origin(content: Row) -> str:
    text = "Written by `python -m benchmarks.pages.joint page` from `results/joint.json`; each row is one command."
    return "\n\n".join(["## Where the figures come from", text, measured_on([content])])


def _accuracy(rows: list[Row]) -> str:
    if not rows:
        return ""
    text = (
        "PSNR of the volume / of the clean projections, in dB, over the range of the truth, without rescaling. *Images* is the "
        "PSNR of the noisy images. Each pixel is the mean of four in an image of 192³ voxels, and each true voxel the mean of "
        "eight of these: no method has the operator that made the images.\n\n"
        "- **Joint**: `noiseflow reconstruct` without options.\n"
        "- **Oracle**: the same field and regulariser with the true noise, at the best weight.\n"
        "- **Least squares**: the same field and regulariser at the best weight, with the incident intensity or offset learnt "
        "or fixed, whichever is better.\n\n"
        "The best weights are found from the truth, on the 24 slices of most contrast: by golden section about the best of "
        "five widely spaced weights. Rows measured again keep them. To measure one row, run:\n\n"
        "```sh\npython -m benchmarks.pages.joint accuracy --phantom shells --noise clipped\n```"
    )
    body = [
        [row["phantom"], row["noise"], f"{row['images']:.1f}", *(_pair(row[name]) for name in _METHODS), *_gaps(row)]
        for row in rows
    ]
    header = ["phantom", "noise", "images", *_METHODS, "oracle − joint", "joint − least squares", "noise model"]
    return "\n\n".join(["## Accuracy", text, table(header, body)])


def _panel(rows: list[Row]) -> dots.Panel:
    """How far the joint fit is above least squares and below the oracle, scene by scene."""
    ranked = sorted(rows, key=lambda row: row["least squares"]["volume"] - row["joint"]["volume"])
    gains = {
        f"joint − {rival}": {_scene(row): row["joint"]["volume"] - row[rival]["volume"] for row in ranked}
        for rival in ("least squares", "oracle")
    }
    return "volume, every scene", "difference of PSNR (dB)", gains


def _scene(row: Row) -> str:
    return f"{row['phantom']}, {row['noise']}"


def _pair(score: Row) -> str:
    return f"{score['volume']:.2f} / {score['projections']:.2f}"


def _gaps(row: Row) -> list[str]:
    volume, projections = (row["oracle"][key] - row["joint"][key] for key in ("volume", "projections"))
    ahead = row["joint"]["volume"] - row["least squares"]["volume"]
    return [f"{volume:.2f} / {projections:.2f}", f"{ahead:+.2f}", row["joint"]["noise model"]]


def _summary(rows: list[Row]) -> str:
    volume = [row["oracle"]["volume"] - row["joint"]["volume"] for row in rows]
    projections = [row["oracle"]["projections"] - row["joint"]["projections"] for row in rows]
    ahead = [row["joint"]["volume"] - row["least squares"]["volume"] for row in rows]
    lines = [
        _met("Volume within {} dB of the oracle", volume, _VOLUME_GOAL),
        _met("Projections within {} dB of the oracle", projections, _PROJECTION_GOAL),
        _met("Volume at most {} dB below least squares", [-gain for gain in ahead], _LEAST_SQUARES_GOAL),
        f"- Volume, joint fit minus least squares: {min(ahead):+.2f} to {max(ahead):+.2f} dB.",
    ]
    if len(rows) < _COUNT:
        lines.append(f"- {_COUNT - len(rows)} of {_COUNT} rows are not measured yet: `accuracy` runs them.")
    return "\n".join(lines)


def _met(what: str, values: list[float], goal: float) -> str:
    met = sum(value <= goal for value in values)
    return f"- {what.format(goal)}: {met} of {len(values)} rows; largest gap {max(values):.2f} dB."


def _fields(rows: list[Row]) -> str:
    if not rows:
        return ""
    text = (
        "Each field at its own best weight, with the true noise (clipped): PSNR of volume / clean "
        "projections, in dB, and seconds of one fit. Command: `python -m benchmarks.pages.joint fields`."
    )
    body = [
        [row["phantom"], *(f"{_pair(row[name])} ({row[name]['seconds']:.0f} s)" for name in FIELDS)] for row in rows
    ]
    return "\n\n".join(["## Fields", text, table(["phantom", *FIELDS], body)])


def _offset(rows: list[Row]) -> str:
    if not rows:
        return ""
    text = (
        "A known offset is added to all pixel values of a linear series of peak 1.5 with skewed noise, and the fit has to find "
        "it. Command: "
        "`python -m benchmarks.pages.joint offset`."
    )
    body = [[row["phantom"], f"{row['size']}³", f"{row['injected']:g}", f"{row['found']:.4f}"] for row in rows]
    return "\n\n".join(["## Offset", text, table(["phantom", "size", "injected", "found"], body)])


def _speed(rows: dict[str, Row]) -> str:
    if not rows:
        return ""
    lines = [
        "## Speed",
        "The two sides of each ratio are timed in turn within one run; times are in seconds. Command: "
        "`python -m benchmarks.pages.joint speed [--row NAME]`.",
    ]
    for name, row in rows.items():
        figures = [[key, _figure(value)] for key, value in row.items() if key not in ("load", "machine")]
        lines += [f"### {name}", f"Load average at the start: {row['load']}.", table(["what", "figure"], figures)]
    return "\n\n".join(lines)


def _figure(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_figure(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def table(header: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in body])
