"""The calibration's JSON of results says what the kept trials say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.pages import calibration, calibration_page

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


def content() -> dict[str, Any]:
    found: dict[str, Any] = json.loads((BENCHMARKS / "results" / "calibration.json").read_text(encoding="utf-8"))
    return found


def test_a_part_that_is_not_measured_is_said_to_be_so() -> None:
    assert calibration_page.page({}).count("Not measured") == 5


def test_json_agrees_with_the_trials_kept() -> None:
    module, stored = calibration, content()["parameters"]
    found = module.parameters(range(300), 1, 0.0, module.ROWS)
    for name in ("gain", "read_noise", "offset"):
        assert found[name]["coverage_90"] == pytest.approx(stored[name]["coverage_90"])
    assert found["trials"] == stored["trials"]


def test_trials_go_on_where_they_stopped(tmp_path: Path) -> None:
    module, rows = calibration, tmp_path / "rows.jsonl"
    rows.write_text('{"seed": 0, "kept": true}\n{"seed": 7, "kept": true}\n', encoding="utf-8")
    found = module.run(_trial, range(3), 1, 1.0, rows)
    assert found == [{"seed": 0, "kept": True}, {"seed": 1}, {"seed": 2}, {"seed": 7, "kept": True}]
    assert len(rows.read_text(encoding="utf-8").splitlines()) == 4


def _trial(seed: int) -> dict[str, Any]:
    return {"seed": seed}
