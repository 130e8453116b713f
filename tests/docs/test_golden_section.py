"""The search for a weight by golden section finds it, and looks nowhere twice."""

from __future__ import annotations

import pytest


def test_golden_section_finds_the_minimum() -> None:
    from benchmarks.pages.joint_accuracy import golden_section

    places: list[float] = []

    def loss(place: float) -> float:
        places.append(place)
        return (place - 0.3) ** 2

    assert golden_section(loss, -3.0, 1.0, 12) == pytest.approx(0.3, abs=0.03)
    assert len(places) == len(set(places)) == 12
