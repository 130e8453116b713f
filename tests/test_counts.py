"""The packages do not grow unnoticed: counts are right, and stay below what was reached."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

from tests.counts import PACKAGES, ROOT, Counts, count, count_files

# The aim is 30 000 lines, 240 files and 400 constants. Lower these when something is deleted.
MOST = Counts(lines=44235, files=240, small=42, named=390, defaults=319, inline=1170, twice=0)


def test_counts_of_a_small_file_are_right(tmp_path: Path) -> None:
    one = "def f(a, b=7):\n    c = a + b\n    c = c * 5\n    return c\n"
    source = f'"""Text."""\n\n_A, _B = 3, 4.5\nC = 1e-3 * 7\nNAME = "x"\n\n\nclass K:\n    size = 9\n\n\n{one}\n\n{one}'
    path = tmp_path / "module.py"
    path.write_text(source.replace("def f", "def g", 1), encoding="utf-8")
    found = count_files([path])
    assert found == Counts(source.count("\n"), 1, 1, 4, 2, 2, 1)


def test_packages_stay_below_what_was_reached() -> None:
    found = sum(count().values(), Counts())
    for name, most in vars(MOST).items():
        assert getattr(found, name) <= most, f"{name}: {getattr(found, name)} (python -m tests.counts)"


def test_every_class_has_a_name_of_its_own() -> None:
    trees = [ast.parse(file.read_text(encoding="utf-8")) for each in PACKAGES for file in (ROOT / each).rglob("*.py")]
    names = Counter(node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    assert [name for name, number in names.items() if number > 1] == []
