"""The present limits, on the evidence of several hundred spoilt and unspoilt series that was stored: no fit, all checks."""

from __future__ import annotations

import pytest

from benchmarks.pages.sabotage import RESULTS, costly, stored_grades
from benchmarks.sabotage import false_alarm


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
    unspoilt = {key: cell for key, cell in cells.items() if key.startswith(("good/", "fresh/", "other/"))}
    alarms = [key for key, cell in unspoilt.items() if false_alarm(cell)]
    assert len(unspoilt) > 150
    assert len(alarms) <= len(unspoilt) / 50, alarms
