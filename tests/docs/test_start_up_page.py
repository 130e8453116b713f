"""The page of start-up times says what its JSON says, and both goals are met."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


def test_page_is_written_from_its_json() -> None:
    result = json.loads((BENCHMARKS / "results" / "start_up.json").read_text(encoding="utf-8"))
    page_of = vars(import_module("benchmarks.pages.start_up"))["page_of"]
    assert (BENCHMARKS / "start_up.md").read_text(encoding="utf-8") == page_of(result)
    assert result["over import torch"]["all of noiseflow"] < 1.3
    assert result["seconds"]["noiseflow -h"] < 0.5
