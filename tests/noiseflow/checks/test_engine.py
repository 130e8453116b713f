"""A row fires if its effect is significant and larger than its tolerance; facts stand first, then what costs most."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from noiseflow.checks import Check, Effect, Guard, NotTested, grade, ranked, run, verdict_of
from noiseflow.report.page import Report, add_verdict, effect_size

ROW = Check("shift", "alignment", "distortion", lambda case: case, "pixels", 0.5, "shifted by {value:.1f}", "align")


def found(*rows: Check[Effect], effect: Effect) -> list[str]:
    return [each.name for each in ranked(run(rows, effect, Guard()).values())]


@pytest.mark.parametrize(
    ("effect", "fires"),
    [
        (Effect(0.6, 0.1), True),
        (Effect(-0.6, 0.1), True),
        (Effect(0.4, 0.01), False),  # significant, but harmless
        (Effect(6.0, 2.0), False),  # large, but not significant
        (Effect(0.6), True),  # a fact has no error
        (Effect(float("nan"), 0.1), False),
    ],
)
def test_an_effect_must_be_significant_and_large(effect: Effect, fires: bool) -> None:
    assert bool(found(ROW, effect=effect)) == fires


def test_a_null_and_a_tolerance_of_the_case_are_respected() -> None:
    row = replace(ROW, null=1.0, tolerance=lambda case: 2 * case.error)
    assert not found(row, effect=Effect(1.1, 0.1))
    assert found(row, effect=Effect(1.5, 0.1))


def test_an_effect_is_drawn_at_its_distance_from_the_null() -> None:
    finding = replace(ROW, null=1.0).of(Effect(1.75, 0.01), 0.5)
    assert effect_size(finding.as_dict()) == finding.cost == 1.5


def test_facts_come_first_and_then_what_costs_most() -> None:
    fact = replace(ROW, name="fact", reason="range", engine="fact", tolerance=1.9, local=True)
    large = replace(ROW, name="large", reason="axis", tolerance=0.2)
    twice = replace(ROW, name="twice", tolerance=0.4)
    assert found(ROW, large, fact, twice, effect=Effect(2.0)) == ["fact", "large", "twice"]


def test_what_explains_little_of_the_same_data_comes_last() -> None:
    def row(name: str, effect: Effect, **changes: str) -> Check[Effect]:
        return replace(ROW, name=name, reason=name, measure=lambda _: effect, **changes)

    rows = row("most", Effect(0.8)), row("half", Effect(1.4, share=0.4)), row("little", Effect(9.0, share=0.15))
    statistic = row("statistic", Effect(0.9), engine="predictive")
    hardly_any = row("hardly any", Effect(9.0, share=0.01))
    assert found(*rows, statistic, hardly_any, effect=Effect(0.0)) == ["most", "half", "statistic", "little"]


def test_an_effect_as_large_as_its_tolerance_is_harmless() -> None:
    assert not found(replace(ROW, tolerance=2.0), effect=Effect(2.0))
    assert found(replace(ROW, tolerance=2.0), effect=Effect(2.1))


def test_what_is_local_is_never_bad() -> None:
    findings = [ranked(run([row], Effect(9.0), Guard()).values()) for row in (ROW, replace(ROW, local=True))]
    assert [grade(each) for each in findings] == ["bad", "doubtful"]
    assert grade([]) == "good"


def test_a_row_that_does_not_apply_is_not_tested() -> None:
    def measure(case: Effect) -> Effect:
        raise NotTested("no second image")

    guard = Guard()
    assert list(run([replace(ROW, name="other", measure=measure), ROW], Effect(1.0), guard)) == ["shift"]
    assert guard.not_tested == {"other": "no second image"}


@pytest.mark.parametrize(("size", "graded"), [(0.0, "good"), (0.6, "doubtful"), (9.0, "bad")])
def test_the_next_step_of_a_report_is_the_remedy_of_a_fault(size: float, graded: str, tmp_path: Path) -> None:
    findings = run([ROW], Effect(size), Guard())
    evidence = {name: each.as_dict() for name, each in findings.items()}
    verdict, report = verdict_of(findings.values(), evidence, good="fine", guard=Guard()), Report("Title", "")
    add_verdict(report, verdict, next_step="measure it.")
    page = re.sub("<[^>]*>", "", report.save(tmp_path / "index.html").read_text(encoding="utf-8"))
    assert verdict.grade == graded
    assert ("Next: measure it." in page, "Next: align." in page) == (graded == "good", graded != "good")
