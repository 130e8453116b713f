"""Names of all fields, without importing them: every module of `recon.fields.kinds` is one."""

from __future__ import annotations

from pathlib import Path

from noiseflow.plugins import names_of

GROUP = "noiseflow.fields"
DEFAULT, AUTO = "grids", "auto"
"""The usual field, and the name of a choice by the likelihood of held-out pixels."""


def field_names() -> list[str]:
    """All fields of this package, then those of other packages (entry points ``noiseflow.fields``), then ``auto``."""
    return [*names_of(Path(__file__).parent / "kinds", GROUP, first=DEFAULT), AUTO]
