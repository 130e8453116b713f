"""The engine of verdicts: a table of checks, a guard that keeps a failing check from losing a result, and a ranking.

How a composition works: a `Check` is a row: how an effect is measured on a case, and what is harmless. `run` measures all rows
under a `Guard`; `ranked` drops findings that others explain, and `verdict_of` turns the rest into grade and reasons. The tables
are in `calibration.verdict` and `recon.verdict.table`.
"""

from noiseflow.checks.engine import (
    LIKELY,
    SIGNIFICANT,
    Check,
    Effect,
    Engine,
    Finding,
    Grade,
    Guard,
    NotTested,
    Verdict,
    grade,
    ranked,
    run,
    verdict_of,
)

__all__ = ["LIKELY", "SIGNIFICANT", "Check", "Effect", "Engine", "Finding", "Grade", "Guard", "NotTested", "Verdict"]
__all__ += ["grade", "ranked", "run", "verdict_of"]
