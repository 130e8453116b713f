"""Several channels of one tilt series in `noiseflow reconstruct`: names, files, and one report."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from noiseflow import io
from noiseflow.commands.console import Output
from noiseflow.report import Report

_ALL = "all"


def channels_of(tilts: Sequence[Path], channel: str | None) -> tuple[dict[str, Path], str | None]:
    """The channels by name, and the channel to read of each file; one unnamed channel for a single series. Raises ValueError if
    two channels have the same name, or `--channel all` comes with several files.
    """
    if len(tilts) == 1 and channel != _ALL:
        return {"": tilts[0]}, channel
    if len(tilts) == 1:
        try:
            io.read(tilts[0], mapped=True)
        except io.SeveralImages as several:
            return {name: Path(f"{tilts[0]}::{name}") for name in several.names}, None
        return {"": tilts[0]}, None
    if channel == _ALL:
        raise ValueError("--channel all is for one file; name channels as FILE::NAME")
    names = [str(path).partition("::")[2] or Path(path).stem for path in tilts]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two channels are named {twice}; rename a file, so that each has its own volume")
    return dict(zip(names, tilts, strict=True)), channel


def file_name(channel: str) -> str:
    """The name of a channel as a part of a file name."""
    return re.sub(r"[^\w.+-]+", "-", channel)


def named(path: Path, channel: str) -> Path:
    """The output of one channel."""
    return path.with_name(f"{path.stem}_{file_name(channel)}{path.suffix}") if channel else path


def joined_results(results: Mapping[str, dict[str, Any]], report: Path | None, output: Output) -> dict[str, Any]:
    """The results of all channels for programs; their reports become parts of one page."""
    pages = {name: result.get("report") for name, result in results.items()}
    page = None
    if report is not None and all(pages.values()):
        whole = Report("Channels of one tilt series", f"{len(results)} channels with one alignment, one volume each")
        rows = [
            (
                name,
                result["verdict"]["grade"],
                result["verdict"]["reasons"][0],
                str(result["choices"].get("noise model", "")),
            )
            for name, result in results.items()
        ]
        whole.table(("channel", "verdict", "first reason", "noise model"), rows, prose=True)
        for path in pages.values():
            whole.include(str(path))
        page = whole.save(report / "index.html")
        output.line(f"report: {page}")
    return {"channels": dict(results), "report": page}
