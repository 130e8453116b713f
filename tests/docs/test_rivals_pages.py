"""The results pages of the methods say what their JSON says, and tell what is missing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"
NAMES = ("run_time.md", "paper_table.md", "ablations.md", "needle.md")


@pytest.mark.parametrize("name", NAMES)
def test_page_agrees_with_its_json(name: str) -> None:
    from benchmarks.pages import rivals

    assert (BENCHMARKS / name).read_text(encoding="utf-8") == rivals.PAGES[name](rivals.RESULTS)


def test_run_time_page_leads_with_what_users_get_and_ranks_no_unfinished_curve() -> None:
    from benchmarks.pages import rivals

    page = rivals.run_time(rivals.RESULTS)
    assert page.index("With default settings") < page.index("| method | at its best with")
    assert "79 tilts | joint |" in page
    assert "| kniesel2022" not in page
    assert "kniesel2022-as-published: 55 of 400000 steps" in page


def test_pages_without_results_tell_what_is_missing(tmp_path: Path) -> None:
    from benchmarks.pages import rivals

    assert "64³, 96³, 128³ on a CPU: not measured" in rivals.run_time(tmp_path)
    assert set(rivals.PAGES) == set(NAMES)
    for name in NAMES[1:]:
        assert "Not measured yet: `noiseflow benchmark" in rivals.PAGES[name](tmp_path)


def test_a_page_shows_a_changed_figure_and_the_rows_that_are_missing(tmp_path: Path) -> None:
    from benchmarks.pages import rivals

    figures = {
        f"{kind}{figure} {scaling}": 0.25
        for kind in ("", "2d ")
        for figure in ("psnr", "mse", "dssim")
        for scaling in ("raw", "affine", "min-max")
    }
    machine = {"processor": "P", "cores": 2, "threads": 1, "python": "3", "versions": {"noiseflow": "1"}}
    cell = figures | {"setting": "hann", "psnr min-max": 12.3456}
    content = {"machines": [machine], "cells": {"WBP": cell}}
    (tmp_path / "paper-table-16-clipped-cell-0-full.json").write_text(json.dumps(content), encoding="utf-8")
    page = rivals.paper_table(tmp_path)
    assert "| WBP | 0.25 | 25.000 | 2.500 | 12.35 |" in page
    assert "Not measured yet: SIRT, L2, noisy images" in page
    assert "cell, clipped noise, 16³, seed 0" in page


def test_rows_of_earlier_days_name_the_commit_that_recorded_them() -> None:
    from benchmarks.pages import record_commits

    new, old = {"psnr": 2.0}, {"psnr": 1.0, "load": 1.4}
    versions = [("ccc", "day 3", {"a": new, "b": old}), ("bbb", "day 2", {"a": new}), ("aaa", "day 1", {"a": old})]
    assert record_commits.first_with("a", new | {"recorded": "later"}, versions) == ("bbb", "day 2")
    assert record_commits.first_with("b", old, versions) == ("ccc", "day 3")
    with pytest.raises(ValueError, match="commit the results first"):
        record_commits.first_with("a", {"psnr": 3.0}, versions)


def test_pictures_show_every_row_and_stand_on_their_page() -> None:
    from benchmarks.pages import rivals

    ((_, content),) = rivals._named_files(rivals.RESULTS, "needle-")
    panels = rivals._needle_panels(content["cells"])
    assert sum(len(values) for _, _, series in panels for values in series.values()) == len(content["cells"])
    for name in ("needle.md", "paper_table.md"):
        text = (BENCHMARKS / name).read_text(encoding="utf-8")
        assert all((BENCHMARKS / picture).is_file() for picture in re.findall(r"\]\((\w+\.png)\)", text))
        assert ".png)" in text
