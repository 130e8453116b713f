"""The verdict on a reconstruction: a grade, its reasons, and the numerical evidence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import nn

from noiseflow.checks import Guard
from recon.series.tilt_series import Volume

Grade = Literal["good", "doubtful", "bad"]
Kind = Literal["seen", "inferred", "general"]
_KINDS = ("seen", "inferred", "general")
BAD = 3.0  # strength of a finding that may affect every part of the volume
_TOLD = 4  # largest number of reasons; after fixing the first ones, the volume is assessed again


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
class Finding:
    """One problem of a reconstruction.

    Attributes:
        subject: one word for programs, such as ``axis`` or ``alignment``.
        strength: size relative to the tolerable limit (1 at the limit); findings of at least `BAD` are bad.
        sentence: description with numbers.
        advice: what to try.
        kind: ``seen`` in the files, ``inferred`` from inconsistencies, or ``general`` without a specific cause.
    """

    subject: str
    strength: float
    sentence: str
    advice: str
    kind: Kind = "inferred"

    @property
    def bad(self) -> bool:
        """Whether it affects the whole volume."""
        return self.strength >= BAD


@dataclass(frozen=True)
class Verdict:
    """The assessment of a volume.

    Attributes:
        grade: ``good``, ``doubtful`` or ``bad``.
        reasons: sentences, seen findings first, then inferred ones, strongest first; for a good volume, the checks.
        evidence: numbers by name.
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
        """Subjects of the findings, strongest first."""
        return tuple(finding.subject for finding in self.findings)

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


def verdict_of(
    findings: Iterable[Finding], evidence: dict[str, Any], *, good: str, guard: Guard | None = None
) -> Verdict:
    """The verdict from findings; `good` is the sentence if there are none, and `guard` knows what was not tested."""
    left_out = {} if guard is None else guard.not_tested
    real = (each for each in findings if each.strength >= 1)
    found = sorted(real, key=lambda each: (_KINDS.index(each.kind), -each.strength))
    if not found:
        return Verdict("good", (good,), evidence, not_tested=left_out)
    first = _unrepeated(found)[:_TOLD]
    reasons = [f"{each.sentence}; {each.advice}" for each in first]
    worst = next((each for each in first if each.bad), None)
    if worst is not None:  # the advice comes first
        number = first.index(worst)
        reasons[number] = worst.sentence
        reasons[0] = f"{_capital(worst.advice)}: {_small(reasons[0])}"
    return Verdict("doubtful" if worst is None else "bad", tuple(reasons), evidence, tuple(first), left_out)


def _unrepeated(findings: list[Finding]) -> list[Finding]:
    """The strongest finding of each subject."""
    first: dict[str, Finding] = {}
    for finding in findings:
        first.setdefault(finding.subject, finding)
    return list(first.values())


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _small(text: str) -> str:
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]
