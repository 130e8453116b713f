"""Where a result comes from: command, seed, versions and checksums of the inputs."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from noiseflow.console import invocation

_PACKAGES = ("noiseflow", "torch", "numpy", "scipy")


def provenance(
    inputs: Sequence[str | Path] = (), *, seed: int | None = None, more: Mapping[str, str] | None = None
) -> list[tuple[str, str]]:
    """Rows (what, value) that let a reader repeat a result.

    Args:
        inputs: files that were read; each is listed with its size and SHA-256.
        seed: of the random choices.
        more: other rows to add, such as the device.
    """
    called = invocation()
    rows = [("command", called.command_line if called is not None else "called from Python")]
    rows += [(f"input: {Path(path).name}", _checksum(Path(path))) for path in inputs if Path(path).is_file()]
    rows += [("seed", str(seed))] if seed is not None else []
    rows += list((more or {}).items())
    rows.append(("versions", ", ".join([f"Python {platform.python_version()}", *map(_version, _PACKAGES)])))
    rows.append(("machine", f"{platform.system()} {platform.machine()}"))
    rows.append(("written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")))
    return rows


def _checksum(path: Path) -> str:
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return f"{path.stat().st_size:,} bytes, SHA-256 {digest}"


def _version(package: str) -> str:
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"{package} (not installed)"
