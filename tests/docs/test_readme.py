"""The README's table and the questions hold the figures of the results files, losses with the wins."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
METHODS = ("least squares", "joint", "oracle")


def cells(name: str) -> dict[str, Any]:
    path = ROOT / "docs" / "benchmarks" / "results" / f"{name}.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return found


def rows() -> dict[str, list[float]]:
    """Scene to the figures beside it."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = [
        [cell.strip(" *") for cell in line.strip("| ").split("|")] for line in text.splitlines() if line[:2] == "| "
    ]
    numbers = {row[0]: [cell for cell in row[1:] if re.fullmatch(r"\d+\.\d\d", cell)] for row in table}
    return {scene: [float(number) for number in found] for scene, found in numbers.items() if found}


def test_table_holds_the_measured_figures() -> None:
    accuracy = {
        f"{cell['phantom']}, {cell['noise']} noise": [cell[method]["volume"] for method in METHODS]
        for key, cell in cells("joint").items()
        if key.startswith("accuracy/")
    }
    needle = cells("needle-0-full")
    accuracy["real needle, quiet, tilts left out"] = [
        needle[f"as measured/every fifth/{method}"]["psnr"] for method in ("L2 + TV, voxels", "joint")
    ]
    assert len(rows()) >= 6
    for scene, shown in rows().items():
        assert shown == pytest.approx(accuracy[scene], abs=0.00501), scene


def test_table_shows_a_loss() -> None:
    assert any(found[1] < found[0] for found in rows().values())
    assert any(found[1] > found[0] for found in rows().values())


def test_questions_name_the_gains_and_losses_of_nearly_gaussian_noise() -> None:
    accuracy = [
        cell for key, cell in cells("joint").items() if key.startswith("accuracy/") and cell["noise"] == "8-bit"
    ]
    gains = [cell["joint"]["volume"] - cell["least squares"]["volume"] for cell in accuracy]
    needle = {key: cell["psnr"] for key, cell in cells("needle-0-full").items() if key.startswith("as measured/")}
    losses = [needle[key.replace("/joint", "/L2 + TV")] - needle[key] for key in needle if key.endswith("/joint")]
    text = " ".join((ROOT / "docs" / "guide" / "faq.md").read_text(encoding="utf-8").split())
    assert f"{min(gains):.2f} to {max(gains):.1f} dB better than tuned least squares with 8-bit noise" in text
    assert f"{min(losses):.1f} to {max(losses):.1f} dB worse on a quiet real needle" in text
