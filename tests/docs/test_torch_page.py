"""The page of speed and memory says what its JSON says, and the goals of bounded memory are met."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"
MOST = 0.2
"""GB per 10⁶ pixels, so that 10⁷ pixels stay within 2 GB."""


def test_page_is_written_from_its_json() -> None:
    result = json.loads((BENCHMARKS / "results" / "torch_cost.json").read_text(encoding="utf-8"))
    page_of = vars(import_module("benchmarks.pages.torch_cost"))["page_of"]
    assert (BENCHMARKS / "torch.md").read_text(encoding="utf-8") == page_of(result)
    cameras = {row: cell for row, cell in result["cells"].items() if row.startswith("16-bit camera")}
    assert len(cameras) >= 4
    assert all(cell["gradient"]["gigabytes"] < MOST for cell in cameras.values())
