"""Provenance of benchmark results: commit, date and machine."""

from __future__ import annotations

import os
import platform
import subprocess
from collections import Counter
from collections.abc import Iterable
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any

import torch

from noiseflow.installation import DISTRIBUTION


@cache
def origin() -> dict[str, str]:
    """Current commit (with ``+`` if files differ from it; empty outside a checkout) and date."""
    return {"commit": _commit(), "date": date.today().isoformat()}


def _commit() -> str:
    def git(*words: str) -> str:
        here = Path(__file__).parent
        found = subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=True, timeout=10)
        return found.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ":/*.py")  # of the whole repository
        return git("rev-parse", "--short=7", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def measured_on(contents: Iterable[dict[str, Any]]) -> str:
    """Markdown list of the commits, dates and machines of some results; a machine that is None was not recorded."""
    contents = list(contents)
    cells = [cell for content in contents for cell in content["cells"].values()]
    origins = Counter((_origin(cell), cell.get("date", "")) for cell in cells)
    lines = [
        f"- {origin}" + (f", {day}" if day else "") + f" ({count} row{'s' if count > 1 else ''})"
        for (origin, day), count in sorted(origins.items(), key=lambda item: item[0][::-1])
    ]
    machines = [machine_ for content in contents for machine_ in content["machines"]]
    alone = not any(machines)
    for machine_ in machines:
        if machine_ is None:
            lines.append("- machine not recorded" if alone else "- machine of some rows not recorded")
            continue
        versions = ", ".join(f"{name} {version}" for name, version in machine_["versions"].items())
        cores = f"{machine_['cores']} cores, {machine_['threads']} torch threads"
        cores += f", {machine_['gpu']}" if machine_.get("gpu") else ""
        lines.append(f"- {machine_['processor']}, {cores}; Python {machine_['python']}, {versions}")
    return "Measured on:\n\n" + "\n".join(dict.fromkeys(lines))


def _origin(cell: dict[str, Any]) -> str:
    """The commit that a row was measured on; for older rows the commit that recorded them, the same or the next one."""
    if "recorded" in cell:
        return f"recorded by commit {cell['recorded']}, measured on the code shortly before it"
    return f"commit {cell['commit']}" if cell.get("commit") else "an earlier commit, not recorded"


def machine() -> dict[str, Any]:
    """Processor, memory and versions of this machine."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for package in (DISTRIBUTION, "torch", "numpy", "scipy", "scikit-image", "astra-toolbox", "quantem", "bm3d"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "system": platform.system(),
        "python": platform.python_version(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "versions": versions,
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
