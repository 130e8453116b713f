"""Names of all regularisers, without importing them: modules of this folder without underscore, except the base class."""

from __future__ import annotations

from pathlib import Path
from pkgutil import iter_modules

from noiseflow.plugins import plugins

GROUP = "noiseflow.regularisers"
DEFAULT = "directional"
"""The default; better than total variation in all of 25 scenes of 96³ (`docs/benchmarks/priors.md`)."""


def regulariser_names() -> list[str]:
    """All regularisers of this package, then those of other packages (entry points ``noiseflow.regularisers``)."""
    own = [module.name for module in iter_modules([str(Path(__file__).parent)])]
    names = sorted(name.replace("_", "-") for name in own if not name.startswith("_") and name != "base")
    return [DEFAULT, *(name for name in names if name != DEFAULT), *sorted(plugins(GROUP))]
