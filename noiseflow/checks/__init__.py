"""The engine of verdicts: checks that can be left out, but never stop a run."""

from noiseflow.checks.guard import Guard, NotTested

__all__ = ["Guard", "NotTested"]
