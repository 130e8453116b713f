"""The names of all regularisers, without importing any: modules of this folder without an underscore, but the contract."""

from __future__ import annotations

from pathlib import Path
from pkgutil import iter_modules

from noiseflow.plugins import plugins

GROUP = "noiseflow.regularisers"
DEFAULT = "directional"
"""In 25 scenes of 96³ it gains over total variation in every one (`docs/benchmarks/priors.md`)."""


def regulariser_names() -> list[str]:
    """All regularisers: those of this package, then those of others (entry points ``noiseflow.regularisers``)."""
    own = [module.name for module in iter_modules([str(Path(__file__).parent)])]
    names = sorted(name.replace("_", "-") for name in own if not name.startswith("_") and name != "base")
    return [DEFAULT, *(name for name in names if name != DEFAULT), *sorted(plugins(GROUP))]
