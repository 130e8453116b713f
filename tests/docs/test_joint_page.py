"""The joint reconstruction's results page says what its JSON says; the search for a weight finds it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"


@pytest.fixture(autouse=True)
def _scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_page_agrees_with_its_json() -> None:
    import joint_page

    content = json.loads((BENCHMARKS / "results" / "joint.json").read_text(encoding="utf-8"))
    assert joint_page.PAGE.read_text(encoding="utf-8") == joint_page.page(content)


def test_golden_section_finds_the_minimum() -> None:
    from joint_accuracy import golden_section

    places: list[float] = []

    def loss(place: float) -> float:
        places.append(place)
        return (place - 0.3) ** 2

    assert golden_section(loss, -3.0, 1.0, 12) == pytest.approx(0.3, abs=0.03)
    assert len(places) == len(set(places)) == 12
