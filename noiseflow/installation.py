"""The installed distribution: its name, version and extras; and plug-ins of other packages, by entry point."""

import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

# On the Python package index, `noiseflow` is another project: a distribution of its own name installs ours.
DISTRIBUTION = "noiseflow-microscopy"
_CHECKOUT = Path(__file__).parent.parent
# of all groups, for which the files of all packages are read: once for a search path
_points = cache(lambda *search_path: entry_points())


def library_version() -> str:
    """The version of the installed library."""
    return version(DISTRIBUTION)


def version_of(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def checkout() -> Path | None:
    """The source tree that the library is loaded from; None for an installed package."""
    return _CHECKOUT if (_CHECKOUT / "pyproject.toml").is_file() else None


def install_command(extra: str) -> str:
    """The command that installs an extra, from the checkout where the library is loaded from one."""
    root = checkout()
    return f"pip install '{DISTRIBUTION}[{extra}]'" if root is None else f"pip install '.[{extra}]' (in {root})"


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
    for point in _points(*sys.path).select(group=group):
        if point.name not in found or package_of(point) == DISTRIBUTION:
            found[point.name] = point
    return found


def package_of(point: EntryPoint) -> str:
    """The name of the installed package that an entry point belongs to."""
    return point.dist.name if point.dist is not None else "an unknown package"


def load_plugin(point: EntryPoint) -> Any:
    """Load the object that an entry point names. Raises ImportError with the package and the reason if it cannot be loaded."""
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ImportError(
            f"'{point.name}' of the package {package_of(point)} cannot be loaded ({reason[:300]}); fix, update or uninstall it"
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


@dataclass(frozen=True)
class Registry:
    """Things of one kind by name: the modules of a package, then entry points of other packages.

    Modules with an underscore, or named ``base``, provide nothing. A module may hold variants of its thing, by name in a mapping
    whose name is the plural of the kind in capitals.

    Attributes:
        kind: one word; the things are module attributes of this name in capitals, and chosen by the option of this name.
        first: the usual one, which is listed first.
        last: further names, which `find` does not know.
        variants: the module of each variant.
    """

    kind: str
    package: str
    group: str
    first: str
    last: tuple[str, ...] = ()
    variants: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> list[str]:
        """All names; nothing is imported."""
        folders = import_module(self.package).__path__
        own = [*(module.name for module in iter_modules(folders) if not module.name.startswith("_")), *self.variants]
        names = sorted(name.replace("_", "-") for name in own if name not in ("base", self.first))
        return [self.first, *names, *sorted(plugins(self.group)), *self.last]

    def find(self, name: str) -> Any:
        """The thing of that name, from a module or an entry point. Raises ValueError if the name is unknown."""
        if name not in self.names() or name in self.last:
            raise ValueError(f"--{self.kind} {name}: choose one of {', '.join(self.names())}")
        if (other := plugins(self.group).get(name)) is not None:
            return load_plugin(other)
        module = import_module(f"{self.package}.{self.variants.get(name, name).replace('-', '_')}")
        if name in self.variants:
            return getattr(module, f"{self.kind.upper()}S")[name]
        return getattr(module, self.kind.upper())
