"""Dot charts of the results pages: one row a method, one panel a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from noiseflow.io import atomic_path
from noiseflow.report import new_figure

COLOURS = "#0072B2", "#D55E00", "#009E73"  # Okabe and Ito: told apart by everybody
MARKS = "o", "s", "^"  # and in grey
Panel = tuple[str, str, dict[str, dict[str, float]]]


def save(
    path: Path,
    panels: Sequence[Panel],
    *,
    columns: int,
    width: float = 5.5,
    straight: float | None = None,
    logarithmic: bool = False,
    line: float | None = None,
    one_legend: bool = False,
) -> None:
    """Write a picture.

    Args:
        panels: title, label of the x axis with its unit, and {series: {method: value}}, methods best first.
        columns: panels side by side.
        width: of a panel with its labels, inches.
        straight: values beyond ± this one stand on a logarithmic axis; None: none do.
        logarithmic: the axis of values, all of them above 0.
        line: value at which to draw a line across the rows.
        one_legend: in the first panel only; all have the same series.
    """
    methods = max(len(_names(series)) for _, _, series in panels)
    rows = -(-len(panels) // columns)
    figure, axes = new_figure(columns, rows, width=width * columns, height=0.8 + 0.26 * methods)
    for number, (axis, panel) in enumerate(zip(axes.flat, panels, strict=True)):
        _draw(axis, *panel, with_legend=number == 0 or not one_legend)
        if straight is not None:
            axis.set_xscale("symlog", linthresh=straight)
            axis.autoscale(axis="x")  # margins of this scale, or the last dot is cut
            low, high = axis.get_xlim()
            powers = [sign * 10.0**power for power in range(-9, 10) for sign in (-1, 1) if 10.0**power >= straight]
            axis.set_xticks([0, *(power for power in powers if low < power < high)])
            axis.xaxis.set_major_formatter("{x:g}")
        if logarithmic:
            axis.set_xscale("log")
        if line is not None:
            axis.axvline(line, color="0.4", lw=1, ls="--", zorder=0)
    with atomic_path(path) as partial:
        figure.savefig(partial, format="png", dpi=90, facecolor="white")


def _draw(axis: Any, title: str, label: str, series: dict[str, dict[str, float]], *, with_legend: bool) -> None:
    names = _names(series)
    for (legend, values), colour, mark in zip(series.items(), COLOURS, MARKS, strict=False):
        places = [names.index(name) for name in values]
        axis.plot(list(values.values()), places, mark, color=colour, label=legend)
    axis.set(title=title, xlabel=label, yticks=range(len(names)), yticklabels=names)
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.grid(axis="y", alpha=0.4)
    if len(series) > 1 and with_legend:
        axis.legend(fontsize=8, loc="best")


def _names(series: dict[str, dict[str, float]]) -> list[str]:
    return list(dict.fromkeys(name for values in series.values() for name in values))
