"""The engine of verdicts: a table of checks, a guard that keeps a failing check from losing a result, and a ranking."""

from noiseflow.checks.engine import SIGNIFICANT, Check, Effect, Finding, grade, ranked, run
from noiseflow.checks.guard import Guard, NotTested

__all__ = ["SIGNIFICANT", "Check", "Effect", "Finding", "Guard", "NotTested", "grade", "ranked", "run"]
