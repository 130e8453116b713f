"""Names of all regularisers, without importing them: modules of this folder without underscore, except the base class."""

from __future__ import annotations

from pathlib import Path

from noiseflow.plugins import names_of

GROUP = "noiseflow.regularisers"
DEFAULT = "directional"
"""The default; better than total variation in all of 25 scenes of 96³ (`docs/benchmarks/priors.md`)."""


def regulariser_names() -> list[str]:
    """All regularisers of this package, then those of other packages (entry points ``noiseflow.regularisers``)."""
    return names_of(Path(__file__).parent, GROUP, first=DEFAULT)
