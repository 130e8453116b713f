"""Figures for the report: images on white, and small charts whose colours follow the light or dark theme."""

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
"""Placeholder colours, which `themed_svg` replaces by those of the page theme."""


def new_figure(columns: int = 1, rows: int = 1, *, width: float = 10.0, height: float = 3.4) -> tuple[Figure, Any]:
    """Create a figure and its axes, an array (rows, columns), without the global state of pyplot.

    Args:
        width: total width, inches.
        height: height per row, inches.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def show_image(axis: Any, image: Any, title: str, *, limits: tuple[float, float] | None = None) -> None:
    """Draw a grey image with a colour bar; its grey range is `limits`, or the 0.5 and 99.5 percentiles by default."""
    import numpy as np

    low, high = limits or np.percentile(image, (0.5, 99.5))
    drawn = axis.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    axis.figure.colorbar(drawn, ax=axis, shrink=0.8)
    axis.set_title(title, fontsize=10)
    axis.set_xticks([])
    axis.set_yticks([])


def new_chart(title: str, *, x: str = "", y: str = "", width: float = 4.1, height: float = 2.8) -> tuple[Figure, Any]:
    """Create a small figure with one axis for `Report.charts`; use the colours in `COLOURS`.

    Args:
        title, x, y: title and axis labels.
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
    """Add a frameless legend in the text colour of the page, below the axis."""
    handles, labels = axis.get_legend_handles_labels()
    style = {"frameon": False, "fontsize": 8.5, "labelcolor": COLOURS["soft"], "ncols": len(labels)}
    axis.figure.legend(handles, labels, loc="outside lower center", **style)


def themed_svg(figure: Figure) -> str:
    """The figure as an ``<svg>`` element with selectable text and the colours of the page theme."""
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
