"""The engine of verdicts: a table of checks, a guard that keeps a failing check from losing a result, and a ranking."""

from noiseflow.checks.engine import SIGNIFICANT, Check, Effect, Finding, Grade, grade, ranked, run
from noiseflow.checks.guard import Guard, NotTested
from noiseflow.checks.verdict import Verdict, verdict_of

__all__ = [
    "SIGNIFICANT",
    "Check",
    "Effect",
    "Finding",
    "Grade",
    "Guard",
    "NotTested",
    "Verdict",
    "grade",
    "ranked",
    "run",
    "verdict_of",
]
