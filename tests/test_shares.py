"""Continuous integration runs one share of the slow tests: in all of them together, every test runs once."""

from __future__ import annotations

import json

from tests.seconds import TABLE, too_long
from tests.shares import shares

SECONDS = {"a.py::slowest": 100.0, **{f"a.py::cases[{number}]": 20.0 for number in range(9)}, "b.py::quick": 1.0}
TESTS = [*SECONDS, "b.py::new"]


def test_every_slow_test_is_in_one_share() -> None:
    assert sorted(test for share in shares(TESTS, SECONDS, 3) for test in share) == sorted(TESTS)


def test_shares_do_not_depend_on_the_order_of_collection() -> None:
    assert shares(TESTS[::-1], SECONDS, 3) == shares(TESTS, SECONDS, 3)


def test_shares_take_about_as_long_and_the_longest_test_runs_alone() -> None:
    found = shares(TESTS, SECONDS, 4)
    took = [sum(SECONDS.get(test, 281 / 11) for test in share) for share in found]
    assert ["a.py::slowest"] in found
    assert max(took) <= 100
    assert min(took) >= 60


def test_no_share_of_32_takes_much_longer_than_the_others() -> None:
    """That is the number in ``.ci/run``, whose time is limited."""
    seconds = json.loads(TABLE.read_text(encoding="utf-8"))
    took = [sum(seconds[test] for test in share) for share in shares(list(seconds), seconds, 32)]
    assert max(took) <= max(1.2 * sum(took) / 32, *seconds.values())


def test_the_quickest_case_of_a_long_test_stays_in_the_fast_suite() -> None:
    took = {"a.py::cases[0]": 2.4, "a.py::cases[1]": 2.6, "a.py::cases[2]": 1.0, "b.py::one": 2.4, "b.py::long": 9.0}
    assert too_long(took) == {"a.py::cases[0]": 2.4, "a.py::cases[1]": 2.6, "b.py::long": 9.0}
