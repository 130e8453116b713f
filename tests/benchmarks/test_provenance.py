"""What results say of the code that they were measured on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import provenance


def told(checkout: Path) -> str:
    here = str(checkout / "benchmarks")
    words = [sys.executable, "-c", "import provenance; print(provenance.origin()['commit'])"]
    return subprocess.run(words, cwd=here, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("place", ["benchmarks", "calibration", "."])
def test_a_changed_file_anywhere_in_the_checkout_marks_the_commit(tmp_path: Path, place: str) -> None:
    changed = tmp_path / place / "changed.py"
    copy = tmp_path / "benchmarks" / "provenance.py"
    for path, text in ((changed, "a = 1\n"), (copy, Path(provenance.__file__).read_text(encoding="utf-8"))):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for words in ("init -q", "add .", "-c user.name=a -c user.email=a@b.c commit -qm all"):
        subprocess.run(["git", *words.split()], cwd=tmp_path, check=True)
    clean = told(tmp_path)
    assert len(clean) == 7
    changed.write_text("a = 2\n", encoding="utf-8")
    assert told(tmp_path) == clean + "+"


def test_a_machine_that_was_not_recorded_is_said_to_be_so() -> None:
    cells = {"first": {"commit": "0ecef51", "date": "2026-11-23"}}
    assert provenance.measured_on([{"cells": cells, "machines": [None]}]).splitlines()[2:] == [
        "- commit 0ecef51, 2026-11-23 (1 row)",
        "- machine not recorded",
    ]
    mixed = provenance.measured_on([{"cells": cells, "machines": [None, provenance.machine()]}])
    assert "- machine of some rows not recorded\n- " in mixed
