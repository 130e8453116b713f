"""Pages of results say what the JSON beside them says: each is written from it, and not by hand."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"
PAGES = {
    "joint.md": ("joint.json", "joint_page.py", "page"),
    "scale.md": ("scale.json", "scale_page.py", "page"),
    "scale_estimates.md": ("scale.json", "scale_page.py", "estimates"),
    "calibration.md": ("calibration.json", "calibration_page.py", "page"),
    "noise_models.md": ("noise_models.json", "noise_page.py", "page"),
    "priors.md": ("priors.json", "priors.py", "page"),
    "selection.md": ("selection.json", "selection.py", "page"),
    "uncertainty.md": ("uncertainty.json", "uncertainty.py", "page"),
}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_says_what_its_json_says(page: str) -> None:
    results, script, function = PAGES[page]
    content = json.loads((BENCHMARKS / "results" / results).read_text(encoding="utf-8"))
    write = runpy.run_path(str(BENCHMARKS / script))[function]
    assert (BENCHMARKS / page).read_text(encoding="utf-8") == write(content)
