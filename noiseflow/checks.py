"""Checks as rows of a table: an effect fires if it is significant, explains something, and is larger than its tolerance.

A check that fails or does not apply is reported as not tested, and never stops a run.

How a composition works: a `Check` is a row: how an effect is measured on a case, and what is harmless. `run` measures all rows
under a `Guard`; `ranked` drops findings that others explain, and `verdict_of` turns the rest into grade and reasons. The tables
are in `calibration.verdict` and `recon.verdict.table`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, Literal, NamedTuple, TypeVar

Found = TypeVar("Found")


class NotTested(ValueError):
    """A check cannot be applied to this data; the message says why."""


@dataclass
class Guard:
    """Runs checks, and remembers those that failed.

    Attributes:
        not_tested: reasons by name of the check.
    """

    not_tested: dict[str, str] = field(default_factory=dict)

    def __call__(self, name: str, check: Callable[[], Found], *, otherwise: Found) -> Found:
        """What the check finds; if it raises, `otherwise`, and its name and reason are remembered."""
        try:
            return check()
        except NotTested as reason:
            self.not_tested[name] = str(reason)
        except Exception as error:  # any fault of an optional check, so that no result is lost
            self.not_tested[name] = f"{type(error).__name__}: {error}"
        return otherwise

    def in_words(self) -> str | None:
        """One line for a terminal or a report; None if everything was tested."""
        listed = "; ".join(f"{name} ({reason})" for name, reason in self.not_tested.items())
        return f"not tested: {listed}" if listed else None


Engine = Literal["fact", "distortion", "predictive"]
Grade = Literal["good", "doubtful", "bad"]
Case = TypeVar("Case")
# a fact of the file explains what is inferred from it, and a parameter explains a statistic without one
_ENGINES = ("fact", "distortion", "predictive")
# tolerances: an effect this large spoils everything
_BAD = 3.0
# tolerances: beyond it, larger effects are no better explanations
MOST = 6.0
# of the effect that explains most of the same data: one that explains less costs little, whatever its size
_EXPLAINED = 0.1
# standard errors, for normal errors exceeded by chance in one of 16 000 tests: a verdict makes about fifty
SIGNIFICANT = 4.0
# the same, exceeded by chance in one of 80: for effects that are zero unless they are improvements
LIKELY = 2.5


class Effect(NamedTuple):
    """What a check measured.

    Attributes:
        value: in the unit of the check.
        error: standard error of the value; 0 for facts.
        what: words for its sentence, such as the name of the worst tilt.
        share: what it explains alone, relative to the effect that explains most of the same data.
    """

    value: float
    error: float = 0.0
    what: str = ""
    share: float = 1.0


@dataclass(frozen=True)
class Check(Generic[Case]):
    """One assumption: what is measured, what is expected, and when a deviation matters.

    Attributes:
        name: what is tested, unique in its table.
        reason: one word for programs; checks with the same reason explain each other.
        engine: ``fact`` (seen in the files), ``distortion`` (a parameter), or ``predictive`` (a statistic without parameter).
        measure: from the case to the effect; raises `NotTested` where it does not apply.
        unit: unit of effect and tolerance.
        tolerance: largest harmless deviation from `null`, or a function of the case.
        sentence: description, with the fields of `Effect` in braces.
        advice: what to try.
        null: value without a fault.
        score: standard errors from which the deviation is significant.
        local: whether it affects only a part of the result, which is then never bad.
    """

    name: str
    reason: str
    engine: Engine
    measure: Callable[[Case], Effect]
    unit: str
    tolerance: float | Callable[[Case], float]
    sentence: str
    advice: str
    null: float = 0.0
    score: float = SIGNIFICANT
    local: bool = False

    def finding(self, case: Case) -> Finding:
        """Measure a case."""
        return self.of(self.measure(case), self.tolerance(case) if callable(self.tolerance) else self.tolerance)

    def of(self, effect: Effect, tolerance: float) -> Finding:
        """The finding from what was measured."""
        size = abs(effect.value - self.null)
        cost = min(MOST, size / tolerance if tolerance > 0 else MOST * (size > 0))
        cost = cost if size >= self.score * effect.error and effect.share >= _EXPLAINED else 0.0
        return Finding(self, effect, tolerance, cost, self.sentence.format(**effect._asdict()))


@dataclass(frozen=True)
class Finding:
    """The outcome of a check.

    Attributes:
        tolerance: in the unit of the effect.
        cost: size in tolerances, 0 if it is not significant or explains little; beyond 1, the check fires.
        sentence: description with numbers.
    """

    check: Check[Any]
    effect: Effect
    tolerance: float
    cost: float
    sentence: str

    @property
    def name(self) -> str:
        """The name of the check."""
        return self.check.name

    @property
    def reason(self) -> str:
        """The reason of the check."""
        return self.check.reason

    @property
    def bad(self) -> bool:
        """Whether it spoils the whole result."""
        return self.cost >= _BAD and not self.check.local

    def as_dict(self) -> dict[str, Any]:
        """For programs, and for limits that are fitted later."""
        return {
            "reason": self.reason,
            "value": self.effect.value,
            "null": self.check.null,
            "error": self.effect.error,
            "share": self.effect.share,
            "what": self.effect.what,
            "unit": self.check.unit,
            "tolerance": self.tolerance,
            "cost": self.cost,
        }


def run(checks: Iterable[Check[Case]], case: Case, guard: Guard) -> dict[str, Finding]:
    """The findings of all checks by name; those that fail or do not apply are remembered by the guard."""
    tried = {check.name: guard(check.name, partial(check.finding, case), otherwise=None) for check in checks}
    return {name: finding for name, finding in tried.items() if finding is not None}


def ranked(findings: Iterable[Finding], most: int = 4) -> list[Finding]:
    """The findings that fire, one for each reason, at most `most`: facts first, then what spoils all, then by cost.

    Of effects that compete for the same data, the cost counts by the share that each explains alone; those that explain little
    come last.
    """

    def place(finding: Finding) -> tuple[int, bool, float]:
        explained = finding.cost * finding.effect.share
        return _ENGINES.index(finding.check.engine) if explained >= 1 else len(_ENGINES), not finding.bad, -explained

    fired = (each for each in findings if each.cost > 1)
    first: dict[str, Finding] = {}
    for finding in sorted(fired, key=place):
        first.setdefault(finding.reason, finding)
    return list(first.values())[:most]


def grade(findings: list[Finding]) -> Grade:
    """The grade of ranked findings."""
    return "good" if not findings else "bad" if any(each.bad for each in findings) else "doubtful"


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
        """Grade, reasons, their `subjects`, evidence and what was not tested, JSON-serialisable."""
        told = {"grade": self.grade, "reasons": list(self.reasons), "subjects": list(self.subjects)}
        return told | {"evidence": self.evidence, "not_tested": self.not_tested}

    def lines(self) -> list[str]:
        """Lines of text for a terminal."""
        lines = [f"verdict: {self.grade}", *(f"  - {reason}" for reason in self.reasons)]
        left_out = Guard(self.not_tested).in_words()
        return [*lines, left_out] if left_out else lines


def verdict_of(findings: Iterable[Finding], evidence: dict[str, Any], *, good: str, guard: Guard) -> Verdict:
    """The verdict from findings; `good` is the sentence if none fires, and `guard` knows what was not tested."""
    first = ranked(findings)
    reasons = [f"{each.sentence}; {each.check.advice}" for each in first] or [good]
    return Verdict(grade(first), tuple(reasons), evidence, tuple(first), guard.not_tested)
