"""The installed distribution: its name, its version, and the command that adds an extra."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

# On the Python package index, `noiseflow` is another project: a distribution of its own name installs ours.
DISTRIBUTION = "noiseflow-microscopy"
_CHECKOUT = Path(__file__).parents[1]


def library_version() -> str:
    """The version of the installed library."""
    return version(DISTRIBUTION)


def checkout() -> Path | None:
    """The source tree that the library is loaded from; None for an installed package."""
    return _CHECKOUT if (_CHECKOUT / "pyproject.toml").is_file() else None


def install_command(extra: str) -> str:
    """The command that installs an extra, from the checkout where the library is loaded from one.

    Args:
        extra: name of the extra, such as ``"formats"``.

    Example:
        >>> from noiseflow.installation import install_command
        >>> "[formats]" in install_command("formats")
        True
    """
    root = checkout()
    return f"pip install '{DISTRIBUTION}[{extra}]'" if root is None else f"pip install '.[{extra}]' (in {root})"
