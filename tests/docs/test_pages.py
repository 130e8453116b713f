"""Pages of results say what the JSON beside them says: each is written from it, and not by hand."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"
PAGES = {
    "joint.md": ("joint.json", "joint_page", "page"),
    "scale.md": ("scale.json", "scale_page", "page"),
    "scale_estimates.md": ("scale.json", "scale_page", "estimates"),
    "calibration.md": ("calibration.json", "calibration_page", "page"),
    "noise_models.md": ("noise_models.json", "noise_page", "page"),
    "fields.md": ("fields.json", "fields", "page"),
    "few_tilts.md": ("few_tilts.json", "few_tilts", "page"),
    "priors.md": ("priors.json", "priors", "page"),
    "optimisers.md": ("optimisers.json", "optimisers", "page"),
    "independent.md": ("independent.json", "independent", "page"),
    "selection.md": ("selection.json", "selection", "page"),
    "conditions.md": ("conditions.json", "conditions", "page"),
    "uncertainty.md": ("uncertainty.json", "uncertainty", "page"),
}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_says_what_its_json_says(page: str) -> None:
    results, script, function = PAGES[page]
    content = json.loads((BENCHMARKS / "results" / results).read_text(encoding="utf-8"))
    write = vars(import_module(f"benchmarks.pages.{script}"))[function]
    assert (BENCHMARKS / page).read_text(encoding="utf-8") == write(content)
