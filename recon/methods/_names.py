"""Names of all methods, without importing them: every module of this folder without an underscore is a method."""

from __future__ import annotations

from pathlib import Path

from noiseflow.plugins import names_of

GROUP = "noiseflow.methods"


def method_names() -> list[str]:
    """All methods, not imported: those of this package, then those of other packages (entry points ``noiseflow.methods``)."""
    return names_of(Path(__file__).parent, GROUP, first="auto")
