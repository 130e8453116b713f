"""Figures for the report: pictures on white, and small charts whose colours follow the reader's light or dark page."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {
    "ink": "#010101",
    "soft": "#020202",
    "line": "#030303",
    "accent": "#040404",
    "warm": "#050505",
    "data": "#060606",
}
"""Stand-ins for the page's colours; `themed_svg` puts the page's own in their place."""


def new_figure(columns: int = 1, rows: int = 1, *, width: float = 10.0, height: float = 3.4) -> tuple[Figure, Any]:
    """A figure and its axes, array of (rows, columns), without the global state of pyplot.

    Args:
        width: inches in all.
        height: inches per row.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def show_image(axis: Any, image: Any, title: str, *, limits: tuple[float, float] | None = None) -> None:
    """Draw a grey image with a colour bar, its contrast from the 0.5 to 99.5 percentiles unless `limits` say otherwise."""
    import numpy as np

    low, high = limits or np.percentile(image, (0.5, 99.5))
    drawn = axis.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    axis.figure.colorbar(drawn, ax=axis, shrink=0.8)
    axis.set_title(title, fontsize=10)
    axis.set_xticks([])
    axis.set_yticks([])


def new_chart(title: str, *, x: str = "", y: str = "", width: float = 4.1, height: float = 2.8) -> tuple[Figure, Any]:
    """A small figure with one plain axis, for `Report.charts`; draw on it in `COLOURS`.

    Args:
        title, x, y: text above and along the axes.
        width, height: inches.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axis = figure.subplots()
    axis.set_title(title, fontsize=10.5, color=COLOURS["ink"], loc="left")
    axis.set_xlabel(x, fontsize=9.5, color=COLOURS["soft"])
    axis.set_ylabel(y, fontsize=9.5, color=COLOURS["soft"])
    axis.tick_params(which="both", colors=COLOURS["soft"], labelsize=8.5, length=0)
    axis.grid(color=COLOURS["line"], linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
    axis.spines["bottom"].set_color(COLOURS["line"])
    return figure, axis


def add_legend(axis: Any) -> None:
    """A frameless legend in the page's text colour, below the axis where it hides nothing."""
    handles, labels = axis.get_legend_handles_labels()
    style = {"frameon": False, "fontsize": 8.5, "labelcolor": COLOURS["soft"], "ncols": len(labels)}
    axis.figure.legend(handles, labels, loc="outside lower center", **style)


def themed_svg(figure: Figure) -> str:
    """The figure as an ``<svg>`` element whose text is text and whose `COLOURS` are the page's."""
    import matplotlib

    stream = io.StringIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "noiseflow"}):
        figure.savefig(stream, format="svg", transparent=True, metadata=metadata)
    svg = "<svg" + stream.getvalue().partition("<svg")[2]
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*" height="[^"]*"', r"\1", svg.replace("\n", " "), count=1)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg)
    svg = re.sub(r"'DejaVu Sans'[^;\"]*", "system-ui, sans-serif", svg)
    svg = re.sub(r' id="(?:figure|axes|patch|text|matplotlib|xtick|ytick|line2d|legend|[A-Z])[^"]*"', "", svg)
    for name, colour in COLOURS.items():
        svg = svg.replace(colour, f"var(--{name})")
    return re.sub(r" {2,}", " ", svg)
