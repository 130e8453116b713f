"""Provenance of a result: command, seed, versions and checksums of the inputs."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from noiseflow.commands.console import invocation
from noiseflow.installation import DISTRIBUTION
from noiseflow.io import files_of

_PACKAGES = (DISTRIBUTION, "torch", "numpy", "scipy")


def provenance(
    inputs: Sequence[str | Path] = (), *, seed: int | None = None, more: Mapping[str, str] | None = None
) -> list[tuple[str, str]]:
    """Rows (name, value) with the information needed to reproduce a result.

    Args:
        inputs: input files and image folders; each is listed with its size and SHA-256.
        seed: seed of the random choices.
        more: further rows, such as the device.
    """
    called = invocation()
    rows = [("command", called.command_line if called is not None else "called from Python")]
    rows += [(f"input: {Path(path).name}", text) for path in inputs if (text := _checksum(path)) is not None]
    rows += [("seed", str(seed))] if seed is not None else []
    rows += list((more or {}).items())
    rows.append(("versions", ", ".join([f"Python {platform.python_version()}", *map(_version, _PACKAGES)])))
    rows.append(("machine", f"{platform.system()} {platform.machine()}"))
    rows.append(("written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")))
    return rows


def _checksum(path: str | Path) -> str | None:
    """Size and digest of a file, or of the concatenated images of a folder; None if it does not exist."""
    files = [file for file in files_of(path) if file.is_file()]
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            hashlib.file_digest(stream, lambda: digest)
    count = f"{len(files)} files, " if len(files) > 1 else ""
    size = sum(file.stat().st_size for file in files)
    return f"{count}{size:,} bytes, SHA-256 {digest.hexdigest()}" if files else None


def _version(package: str) -> str:
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"{package} (not installed)"
