"""The verdict on a reconstruction: a grade, its reasons in sentences, and the evidence in numbers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import nn

from recon.series.tilt_series import Volume

Grade = Literal["good", "doubtful", "bad"]
Kind = Literal["seen", "inferred", "general"]
_KINDS = ("seen", "inferred", "general")
BAD = 3.0  # a finding this many times beyond what is tolerable: no part of the volume is safe from it
_TOLD = 4  # reasons: whoever mends the first ones judges again


class Result(Protocol):
    """What of a reconstruction is judged: every method's result has it."""

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
    """One thing that is wrong.

    Attributes:
        subject: one word for programs, such as ``axis`` or ``alignment``.
        strength: how far beyond what is tolerable, 1 where it begins; findings of `BAD` and more are bad.
        sentence: what was found, with its numbers.
        advice: what to try.
        kind: ``seen`` in the files themselves, ``inferred`` from contradictions, or ``general``, which names no cause.
    """

    subject: str
    strength: float
    sentence: str
    advice: str
    kind: Kind = "inferred"

    @property
    def bad(self) -> bool:
        """Whether it spoils the whole volume."""
        return self.strength >= BAD


@dataclass(frozen=True)
class Verdict:
    """How far to trust a volume.

    Attributes:
        grade: ``good``, ``doubtful`` or ``bad``.
        reasons: sentences, what is seen first, then what is inferred, the strongest first; of a good volume, what was checked.
        evidence: the numbers, by name.
        findings: what the reasons stand for.
    """

    grade: Grade
    reasons: tuple[str, ...]
    evidence: dict[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    @property
    def subjects(self) -> tuple[str, ...]:
        """Subjects of the findings, the strongest first."""
        return tuple(finding.subject for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """For programs: grade, reasons and evidence."""
        return {"grade": self.grade, "reasons": list(self.reasons), "evidence": self.evidence}

    def lines(self) -> list[str]:
        """For a terminal."""
        return [f"verdict: {self.grade}", *(f"  - {reason}" for reason in self.reasons)]


def verdict_of(findings: Iterable[Finding], evidence: dict[str, Any], *, good: str) -> Verdict:
    """The verdict that findings add up to; `good` is the sentence where there are none."""
    real = (each for each in findings if each.strength >= 1)
    found = sorted(real, key=lambda each: (_KINDS.index(each.kind), -each.strength))
    if not found:
        return Verdict("good", (good,), evidence)
    first = _unrepeated(found)[:_TOLD]
    reasons = [f"{each.sentence}; {each.advice}" for each in first]
    worst = next((each for each in first if each.bad), None)
    if worst is not None:  # what to try stands before everything else
        number = first.index(worst)
        reasons[number] = worst.sentence
        reasons[0] = f"{_capital(worst.advice)}: {_small(reasons[0])}"
    return Verdict("doubtful" if worst is None else "bad", tuple(reasons), evidence, tuple(first))


def _unrepeated(findings: list[Finding]) -> list[Finding]:
    """The strongest of each subject."""
    first: dict[str, Finding] = {}
    for finding in findings:
        first.setdefault(finding.subject, finding)
    return list(first.values())


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _small(text: str) -> str:
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]
