"""Programs that measure and write the pages of results, `python -m benchmarks.pages.NAME`; the pages are in `docs/benchmarks`."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"
"""Folder of the pages, with their figures and results."""
