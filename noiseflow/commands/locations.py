"""Locations of packages, and detection of packages shadowed by a folder or file of the same name."""

from __future__ import annotations

import importlib.util
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path

OWN = ("noiseflow", "calibration", "recon")


def folder_of(module: str) -> Path | None:
    """The folder that a top-level module would be imported from; None if it is not found."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations))).parent
    return None if spec.origin is None else Path(spec.origin).parent


def modules_of(package: str) -> list[str]:
    """The public top-level modules of an installed package."""
    found = packages_distributions().items()
    return sorted(module for module, names in found if package in names and not module.startswith("_"))


def shadows(packages: list[str]) -> list[str]:
    """One message for each module that is not loaded from its installed package.

    Args:
        packages: names of installed packages to check in addition to noiseflow, whose packages must be in one folder.
    """
    home = Path(__file__).parents[2]
    wrong = [(module, home) for module in OWN if _elsewhere(module, home)]
    for package in packages:
        try:
            root = Path(str(distribution(package).locate_file("")))
        except PackageNotFoundError:
            continue
        wrong += [(module, root) for module in modules_of(package) if _elsewhere(module, root)]
    return [
        f"{module} is loaded from {folder_of(module)}, not from {root}; rename that file or folder, or work in another folder"
        for module, root in wrong
    ]


def _elsewhere(module: str, root: Path) -> bool:
    folder = folder_of(module)
    return folder is not None and not folder.resolve().is_relative_to(root.resolve())
