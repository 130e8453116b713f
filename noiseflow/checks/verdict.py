"""The verdict on a result: a grade, its reasons, and the numerical evidence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from noiseflow.checks.engine import Finding, Grade, Guard, grade, ranked


@dataclass(frozen=True)
class Verdict:
    """The assessment of a result.

    Attributes:
        grade: ``good``; ``doubtful``: corrected or uncertain, as the reasons explain; ``bad``: do not use.
        reasons: sentences, in the order of the findings; a good reconstruction has one that says what was tested.
        evidence: effect, error, unit, tolerance and cost of every check by name.
        findings: the findings behind the reasons, those that matter most first.
        not_tested: reasons of the checks that failed or could not be applied, by name.
    """

    grade: Grade
    reasons: tuple[str, ...]
    evidence: dict[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    not_tested: dict[str, str] = field(default_factory=dict)

    @property
    def subjects(self) -> tuple[str, ...]:
        """The short name of each reason, in their order."""
        return tuple(finding.reason for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Grade, reasons and evidence, JSON-serialisable."""
        return {
            "grade": self.grade,
            "reasons": list(self.reasons),
            "evidence": self.evidence,
            "not_tested": self.not_tested,
        }

    def lines(self) -> list[str]:
        """Lines of text for a terminal."""
        left_out = Guard(self.not_tested).in_words()
        return [
            f"verdict: {self.grade}",
            *(f"  - {reason}" for reason in self.reasons),
            *([left_out] if left_out else []),
        ]


def verdict_of(findings: Iterable[Finding], evidence: dict[str, Any], *, good: str, guard: Guard) -> Verdict:
    """The verdict from findings; `good` is the sentence if none fires, and `guard` knows what was not tested."""
    first = ranked(findings)
    reasons = [f"{each.sentence}; {each.advice}" for each in first] or [good]
    return Verdict(grade(first), tuple(reasons), evidence, tuple(first), guard.not_tested)
