"""Processor time of each test: ``python -m pytest -n 2 -p tests.seconds`` moves long tests from the fast suite to the slow one.

A test of more than `MOST` seconds is listed in ``slow_seconds.json``, which counts as the mark `slow`. The quickest case of each
test function stays in the fast suite up to `MOST_OF_THE_QUICKEST` seconds, so that most guards are tried by every run.
"""

from __future__ import annotations

import json
import resource
from collections import defaultdict
from collections.abc import Generator, Mapping
from pathlib import Path

import pytest

TABLE = Path(__file__).parent / "slow_seconds.json"
"""Of each slow test; other work was done beside them, so only their proportions count."""

# Seconds of an idle core. Of 5300 tests 340 took longer, 80 % of the time of all; most are fits, or starts of whole programs.
MOST, MOST_OF_THE_QUICKEST = 1.2, 3.0


def too_long(seconds: Mapping[str, float]) -> dict[str, float]:
    """The tests that do not belong in the fast suite, with their seconds."""
    cases: dict[str, list[str]] = defaultdict(list)
    for name in seconds:
        cases[name.partition("[")[0]].append(name)
    quickest = {min(names, key=seconds.__getitem__) for names in cases.values()}
    return {
        name: round(took, 1)
        for name, took in seconds.items()
        if took > (MOST_OF_THE_QUICKEST if name in quickest else MOST)
    }


_measured: dict[str, float] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Note when the test starts."""
    item.stash[_STARTED] = _spent()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, object, object]:
    """Tell the time of the test, with its fixtures and programs, to the process that collects the reports."""
    try:
        return (yield)
    finally:
        item.user_properties.append(("seconds", _spent() - item.stash[_STARTED]))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect the times."""
    if report.when == "teardown":
        _measured[report.nodeid] = float(dict(report.user_properties)["seconds"])  # type: ignore[arg-type]


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Add the long tests to the table."""
    if not hasattr(session.config, "workerinput"):
        known = json.loads(TABLE.read_text(encoding="utf-8"))
        known.update(too_long(_measured))
        TABLE.write_text(json.dumps(dict(sorted(known.items())), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


_STARTED = pytest.StashKey[float]()


def _spent() -> float:
    """Processor seconds of this process and of those that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
