"""The mutation run leaves out what it says, and every reason speaks of a line that is there."""

from __future__ import annotations

import ast

import pytest

from tests.mutation import ROOT, TARGETS, left_out, mutant, number_of_mutants
from tests.mutation_left_out import LEFT_OUT


@pytest.mark.parametrize("file", sorted(LEFT_OUT))
def test_every_change_left_out_is_one_of_the_file(file: str) -> None:
    used = set(left_out(file).values())
    assert [entry for entry in LEFT_OUT[file] if entry not in used] == []
    assert len(left_out(file)) < 0.4 * number_of_mutants(file)


@pytest.mark.parametrize("file", sorted(TARGETS))
def test_a_mutant_differs_from_its_file_and_the_tests_nearest_to_it_exist(file: str) -> None:
    source = ast.unparse(ast.parse((ROOT / file).read_text(encoding="utf-8")))
    number = number_of_mutants(file)
    for index in range(0, number, max(1, number // 12)):
        changed = mutant(file, index)
        assert changed.source != source
        assert changed.before != changed.after
    assert all((ROOT / "tests" / test).is_file() for test in TARGETS[file])
