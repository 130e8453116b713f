"""Plug-ins of other packages, by entry point. A broken plug-in does not affect others."""

from __future__ import annotations

import warnings
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from noiseflow.installation import DISTRIBUTION

GROUPS = (
    "noiseflow.commands",
    "noiseflow.fields",
    "noiseflow.methods",
    "noiseflow.noise_models",
    "noiseflow.regularisers",
    "noiseflow.self_tests",
)


def plugins(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by name, not loaded; those of noiseflow itself come first."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        if point.name not in found or package_of(point) == DISTRIBUTION:
            found[point.name] = point
    return found


def package_of(point: EntryPoint) -> str:
    """The name of the installed package that an entry point belongs to."""
    return point.dist.name if point.dist is not None else "an unknown package"


def load_plugin(point: EntryPoint) -> Any:
    """Load the object that an entry point names.

    Raises:
        ImportError: it cannot be loaded; the message states the package and the reason.
    """
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ImportError(
            f"'{point.name}' of the package {package_of(point)} cannot be loaded ({reason[:300]}); "
            "fix, update or uninstall that package"
        ) from error


def load_plugins(group: str) -> dict[str, Any]:
    """Load all plug-ins of a group, by name; warn about each that cannot be loaded."""
    loaded = {}
    for name, point in plugins(group).items():
        try:
            loaded[name] = load_plugin(point)
        except ImportError as error:
            warnings.warn(str(error), stacklevel=2)
    return loaded


def names_of(folder: Path, group: str, *, first: str) -> list[str]:
    """Names that the modules of a folder and the entry points of a group provide, without importing them; `first` comes first.
    Modules with an underscore, or named ``base``, provide nothing."""
    own = [module.name for module in iter_modules([str(folder)])]
    names = sorted(name.replace("_", "-") for name in own if not name.startswith("_") and name != "base")
    return [first, *(name for name in names if name != first), *sorted(plugins(group))]


def provided(name: str, package: str, group: str, attribute: str) -> Any:
    """The object of that name: an attribute of a module of the package, or what an entry point of the group loads."""
    other = plugins(group).get(name)
    if other is not None:
        return load_plugin(other)
    return getattr(import_module(f"{package}.{name.replace('-', '_')}"), attribute)
