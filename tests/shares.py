"""Shares of the slow tests, for continuous integration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def shares(tests: Sequence[str], seconds: Mapping[str, float], count: int) -> list[list[str]]:
    """Shares of about equal time: the longest test first, each into the share that is the shortest so far.

    Args:
        tests: names of tests.
        seconds: that each takes; what is not in it counts as long as the mean of the others.
        count: of shares.
    """
    usual = sum(seconds.values()) / len(seconds)
    takes = {test: seconds.get(test, usual) for test in tests}
    found: list[list[str]] = [[] for _ in range(count)]
    for test in sorted(tests, key=lambda test: (-takes[test], test)):
        min(found, key=lambda share: sum(takes[each] for each in share)).append(test)
    return found
