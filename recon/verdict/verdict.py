"""The verdict on a reconstruction: a grade, its reasons, and the numerical evidence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import nn

from noiseflow.checks import Finding, Guard, grade, ranked
from noiseflow.checks.engine import Grade
from recon.series.tilt_series import Volume


class Result(Protocol):
    """The parts of a reconstruction that are assessed; every method provides them."""

    @property
    def volume(self) -> Volume: ...
    @property
    def projections(self) -> NDArray[np.float32]: ...
    @property
    def fit_result(self) -> Any: ...
    @property
    def noise_model(self) -> nn.Module | None: ...


@dataclass(frozen=True)
class Verdict:
    """The assessment of a volume.

    Attributes:
        grade: ``good``, ``doubtful`` or ``bad``.
        reasons: sentences, facts first, then by what they cost; for a good volume, what was tested.
        evidence: effect, error, unit, tolerance and cost of every check by name.
        findings: the findings behind the reasons.
        not_tested: reasons of the checks that failed or could not be applied, by name.
    """

    grade: Grade
    reasons: tuple[str, ...]
    evidence: dict[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    not_tested: dict[str, str] = field(default_factory=dict)

    @property
    def subjects(self) -> tuple[str, ...]:
        """One word for each reason, in their order."""
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
