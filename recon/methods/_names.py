"""Names of all methods, without importing them: every module of this folder without an underscore is a method."""

from __future__ import annotations

from pathlib import Path
from pkgutil import iter_modules

from noiseflow.plugins import plugins

GROUP = "noiseflow.methods"


def method_names() -> list[str]:
    """All methods, not imported: those of this package, then those of other packages (entry points ``noiseflow.methods``)."""
    own = [module.name for module in iter_modules([str(Path(__file__).parent)]) if not module.name.startswith("_")]
    names = sorted(name.replace("_", "-") for name in own)
    return ["auto", *(name for name in names if name != "auto"), *sorted(plugins(GROUP))]
