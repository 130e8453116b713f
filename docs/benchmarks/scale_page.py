"""The results page of the scale benchmark, scale.md, from results/scale.json alone."""

from __future__ import annotations

from typing import Any

Cell = dict[str, Any]


def in_words(name: str, row: Cell) -> str:
    """One row as a line."""
    seam = "" if row["seam"] is None else f", seam {row['seam']:.2f} (truth {row['seam of the truth']:.2f})"
    return (
        f"{name}: {row['seconds']:.0f} s, {row['processor seconds']:.0f} s of processor time, {row['peak GiB']:.2f} GiB, "
        f"{row['psnr']:.2f} dB, {row['blocks']} blocks{seam}"
    )
