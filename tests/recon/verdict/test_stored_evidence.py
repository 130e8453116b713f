"""The present limits, on the evidence of several hundred spoilt and unspoilt series that was stored: no fit, all checks."""

from __future__ import annotations

import pytest

from benchmarks.pages.sabotage import RESULTS, costly, stored_grades, unspoilt


@pytest.fixture(scope="module")
def cells() -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = stored_grades(RESULTS)["cells"]
    return found


@pytest.mark.parametrize(("half", "not_good", "right"), [("kept", 0.9, 0.7), ("used", 0.8, 0.6)])
def test_faults_that_cost_a_decibel_are_seen_and_most_are_named_first(cells, half, not_good, right) -> None:
    found = costly(cells, half)
    number = sum(found.values())
    assert number > 30
    assert 1 - found["missed"] / number >= not_good, found
    assert found["right reason"] / number >= right, found


def test_unspoilt_series_are_good_but_for_one_in_fifty(cells) -> None:
    alarms = [
        key for half in ("kept", "used") for key, cell in unspoilt(cells, half).items() if cell["grade"] != "good"
    ]
    others = [key for key in cells if key.startswith(("other/", "fresh/"))]
    alarms += [key for key in others if cells[key]["grade"] != "good"]
    number = sum(key.startswith("good/") for key in cells) + len(others)
    assert number > 150
    assert len(alarms) <= number / 50, alarms
