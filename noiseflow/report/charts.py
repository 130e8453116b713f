"""Figures for the report: images on white, and small charts whose colours follow the light or dark theme."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from noiseflow.described import printable
from noiseflow.statistics import bulk

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import nn

LIGHT = {
    "ink": "#1b2330",
    "soft": "#5d6675",
    "line": "#dcdfe4",
    "accent": "#0b6e8a",
    "warm": "#c4561a",
    "data": "#9fb4c4",
}
"""Colours of charts outside pages: those of the light theme."""

COLOURS = {name: f"var(--{name})" for name in LIGHT}
"""Colours of the page theme."""

STYLES = ((COLOURS["accent"], ""), (COLOURS["warm"], ""), (COLOURS["soft"], "5 2"))
"""Colours and dashes of curves that are compared."""


def new_figure(columns: int = 1, rows: int = 1, *, width: float = 10.0, height: float = 3.4) -> tuple[Figure, Any]:
    """Create a figure and its axes, an array (rows, columns), without the global state of pyplot.

    Args:
        width: total width, inches.
        height: height per row, inches.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def grey_range(image: NDArray[Any]) -> tuple[float, float]:
    """Values to draw black and white: the 0.5 and 99.8 percentiles, so that a few pixels do not determine the scale."""
    low, high = np.percentile(image, (0.5, 99.8))
    return float(low), float(high)


def show_image(axis: Any, image: Any, title: str, *, limits: tuple[float, float] | None = None) -> None:
    """Draw a grey image with a colour bar; its grey range is `limits`, or `grey_range` by default."""
    low, high = limits or grey_range(image)
    drawn = axis.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    axis.figure.colorbar(drawn, ax=axis, shrink=0.8)
    axis.set_title(title, fontsize=10)
    axis.set_xticks([])
    axis.set_yticks([])


class Chart:
    """A small chart with one pair of axes, drawn as SVG in the colours of the page theme; for `Report.charts`.

    Values that are not finite leave gaps. A legend below the axes names everything drawn with a `label`.

    Args:
        title, x, y: title and axis labels.
        log: axes with logarithmic scales: ``""``, ``"x"``, ``"y"`` or ``"xy"``.
        width, height: inches at a font size of 10 points.

    Attributes:
        limits: smallest and largest value of each axis, ``{"x": (low, high)}``; by default those of the data and a margin.
        ticks: places and their labels, ``{"x": [(place, label), ...]}``; by default multiples of 1, 2 or 5.
    """

    def __init__(
        self, title: str, *, x: str = "", y: str = "", log: str = "", width: float = 4.1, height: float = 2.8
    ) -> None:
        self.title, self.names, self.log = title, {"x": x, "y": y}, log
        self.width, self.height = (72 * each for each in (width, height))
        self.limits: dict[str, tuple[float | None, float | None]] = {}
        self.ticks: dict[str, Sequence[tuple[float, str]]] = {}
        self._seen: dict[str, list[NDArray[np.float64]]] = {"x": [], "y": []}
        self._marks: list[tuple[str, Any, str]] = []  # kind, coordinates, attributes
        self._legend: list[tuple[str, str, bool]] = []  # label, colour, whether it is filled

    def plot(
        self, x: ArrayLike, y: ArrayLike, *, colour: str = COLOURS["accent"], label: str = "", width: float = 1.4,
        dashes: str = "", dots: float = 0.0, error: ArrayLike | None = None, across: bool = False
    ) -> None:  # fmt: skip
        """Draw a line unless its width is 0, dots of a radius, and error bars along y, or along x if `across`."""
        x, y = (np.asarray(values, float).ravel() for values in (x, y))
        if width:
            dash = f' stroke-dasharray="{dashes}"' if dashes else ""
            self._add("path", (x, y), f'fill="none" stroke="{colour}" stroke-width="{width}"{dash}', label, colour)
        if dots:
            self._add("dots", (x, y), f'r="{dots}" fill="{colour}"', "" if width else label, colour)
        if error is not None:
            away = np.broadcast_to(np.asarray(error, float), x.shape)
            for place, by in zip(np.column_stack([x, y]), away, strict=True):
                step = np.array([by, 0.0] if across else [0.0, by])
                ends = np.stack([place - step, place + step])
                self._add("path", tuple(ends.T), f'stroke="{colour}" stroke-width="1"')

    def stairs(
        self, values: ArrayLike, edges: ArrayLike, *, fill: bool = False, colour: str = COLOURS["accent"], label: str = ""
    ) -> None:  # fmt: skip
        """Draw a histogram of (K,) values between (K+1,) edges, filled down to 0 or to the lower limit."""
        values, edges = np.asarray(values, float), np.asarray(edges, float)
        x, y = np.repeat(edges, 2)[1:-1], np.repeat(values, 2)
        if fill:
            self.fill(x, np.zeros_like(y), y, colour=colour, label=label)
        else:
            self.plot(x, y, colour=colour, label=label)

    def fill(
        self, x: ArrayLike, low: ArrayLike, high: ArrayLike, *, colour: str = COLOURS["accent"], opacity: float = 1.0,
        label: str = ""
    ) -> None:  # fmt: skip
        """Fill the area between two curves."""
        x, low, high = (np.asarray(values, float).ravel() for values in (x, low, high))
        ends = np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])
        self._add("area", ends, f'fill="{colour}" fill-opacity="{opacity}"', label, colour, filled=True)

    def line(self, *, x: float | None = None, y: float | None = None, colour: str = COLOURS["warm"]) -> None:
        """Draw a dashed line across the chart at one x or y."""
        self._add("across", (x, y), f'stroke="{colour}" stroke-dasharray="4 3"')

    def image(self, pixels: NDArray[np.uint8], *, box: tuple[float, float, float, float]) -> None:
        """Draw an (h, w) or (h, w, 3) image of 8 bits with its edges at ``box``: left, right, bottom, top."""
        from PIL import Image

        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "PNG", compress_level=1)  # of noise, slower levels save nothing
        left, right, bottom, top = box
        href = "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()
        style = f'preserveAspectRatio="none" style="image-rendering:pixelated" href="{href}"'
        self._add("image", (np.array([left, right]), np.array([bottom, top])), style)

    def svg(self) -> str:
        """The chart as an ``<svg>`` element with selectable text."""
        spans = {axis: self._span(axis) for axis in "xy"}
        ticks = {axis: self.ticks.get(axis) or _ticks(*sorted(spans[axis]), log=axis in self.log) for axis in "xy"}
        left = 22 + 5.2 * max([len(name) for _, name in ticks["y"]], default=0)
        rows = self._legend_rows(self.width - left - 8)
        box = (left, self.width - 10, self.height - 34, 24.0)  # left, right, bottom, top
        place = {"x": _scale(spans["x"], box[:2], "x" in self.log), "y": _scale(spans["y"], box[2:], "y" in self.log)}
        places = {axis: [(float(place[axis](np.array(at))), name) for at, name in ticks[axis]] for axis in "xy"}
        marks = [_mark(*mark, place, box) for mark in self._marks]
        clip = f"clip{abs(hash((self.title, self.names['x'], self.names['y'], len(marks)))):x}"
        values = {"chart": self, "box": box, "ticks": places, "marks": marks, "clip": clip, "legend": rows}
        return str(templates().get_template("chart.svg").render(values))

    def save(self, path: str | Path) -> None:
        """Write the chart as a file on white."""
        svg = self.svg().replace(
            'font-size="8.5">', 'font-size="8.5" style="background:white" font-family="sans-serif">', 1
        )
        for name, colour in LIGHT.items():
            svg = svg.replace(COLOURS[name], colour)
        Path(path).write_text(svg, encoding="utf-8")

    def _add(
        self, kind: str, place: Any, style: str, label: str = "", colour: str = "", *, filled: bool = False
    ) -> None:
        self._marks.append((kind, place, style))
        for axis, values in zip("xy", place, strict=True):
            if values is not None:
                self._seen[axis].append(np.atleast_1d(values))
        if label:
            self._legend.append((label, colour, filled))

    def _span(self, axis: str) -> tuple[float, float]:
        """The smallest and largest value shown along an axis."""
        seen = np.concatenate([*self._seen[axis], np.empty(0)])
        seen = seen[np.isfinite(seen) & (seen > 0 if axis in self.log else True)]
        low, high = (float(seen.min()), float(seen.max())) if seen.size else (1.0, 2.0)
        given = self.limits.get(axis, (None, None))
        if axis in self.log:
            margin = (high / low) ** 0.04 if high > low else 2.0
            low, high = low / margin, high * margin
        else:
            margin = 0.04 * (high - low) or max(abs(high), 1.0)
            low, high = low - margin, high + margin
        return (low if given[0] is None else given[0], high if given[1] is None else given[1])

    def _legend_rows(self, width: float) -> list[list[tuple[float, tuple[str, str, bool]]]]:
        rows: list[list[tuple[float, tuple[str, str, bool]]]] = []
        across = math.inf
        for entry in self._legend:
            length = 32 + 4.6 * len(entry[0])
            if across + length > width:
                rows.append([])
                across = 0.0
            rows[-1].append((across, entry))
            across += length
        return rows


def residual_histogram(
    signal: NDArray[Any], observation: NDArray[Any], models: Mapping[str, nn.Module], *, unit: str, legend: bool
) -> Chart:
    """Draw the histogram of (N,) observations minus signals, with the exact densities of noise models, by their names."""
    import torch

    from noiseflow.metrics.evaluation import residual_masses
    from noiseflow.models.wrapper import as_noise_model

    residual = observation - signal
    low, high = bulk(residual)
    edges = np.linspace(low, max(high, low + 1e-6 * (1 + abs(low))), 49)
    chart = Chart(f"Signal {signal.min():.4g} … {signal.max():.4g} {unit}", x=f"residual, {unit}", y="density", log="y")
    width, counts = edges[1] - edges[0], np.histogram(residual, edges)[0]
    share = counts / (residual.size * width)
    chart.stairs(share, edges, fill=True, colour=COLOURS["data"], label="data" if legend else "")
    for (name, model), (colour, dashes) in zip(models.items(), STYLES, strict=False):
        signals = torch.as_tensor(signal, device=as_noise_model(model).device)
        masses = residual_masses(model, signals, torch.tensor([-np.inf, *edges, np.inf], dtype=torch.float64))[1:-1]
        middle = (edges[1:] + edges[:-1]) / 2
        chart.plot(middle, masses / width, colour=colour, dashes=dashes, label=name if legend else "")
    chart.limits["y"] = max(0.2 / (residual.size * width), 1e-4 * share.max()), None
    return chart


def _scale(span: tuple[float, float], ends: tuple[float, ...], log: bool) -> Any:
    """The function from values to places between two ends of an axis, points."""
    low, high = np.log(span) if log else span

    def place(values: NDArray[np.float64]) -> NDArray[np.float64]:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log(values) if log else values
            # zero of a logarithmic axis, and values far away, lie just outside
            share = np.clip((values - low) / (high - low), -1.0, 2.0)
        return np.asarray(ends[0] + share * (ends[1] - ends[0]))

    return place


def _ticks(low: float, high: float, *, log: bool, most: int = 6) -> list[tuple[float, str]]:
    if log:
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        every = max(1, round((last - first) / most))
        factors = (1, 2, 5) if last - first <= 2 else (1,)
        places = [factor * 10.0**power for power in range(first, last + 1, every) for factor in factors]
    else:
        rough = (high - low) / most
        unit = 10.0 ** math.floor(math.log10(rough))
        step = unit * next(factor for factor in (1, 2, 5, 10) if factor * unit >= rough)
        places = [step * number for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [(place, f"{place:.6g}") for place in places if low <= place <= high]


def _mark(kind: str, at: Any, style: str, place: dict[str, Any], box: tuple[float, ...]) -> tuple[str, Any, str]:
    """Kind, places on the drawing and attributes of a mark: the ends of a line across, a path, or points."""
    if kind == "across":
        x, y = (
            None if value is None else float(place[axis](np.array(value))) for axis, value in zip("xy", at, strict=True)
        )
        return kind, (x, box[3], x, box[2]) if y is None else (box[0], y, box[1], y), style
    x, y = (place[axis](values) for axis, values in zip("xy", at, strict=True))
    if kind == "image":
        return kind, (x.min(), y.min(), np.ptp(x), np.ptp(y)), style
    known = np.isfinite(x) & np.isfinite(y)
    if kind == "dots":
        return kind, list(zip(x[known], y[known], strict=True)), style
    ends = zip(x, y, known, known & ~np.concatenate([[False], known[:-1]]), strict=True)
    steps = "".join(f"{'M' if start else 'L'}{a:.1f} {b:.1f}" for a, b, use, start in ends if use)
    return kind, f"{steps}{'Z' if kind == 'area' else ''}", style


@cache
def templates() -> Any:
    """The templates of pages and charts: text is escaped, and characters that cannot be printed are replaced."""
    from jinja2 import Environment, PackageLoader

    return Environment(
        loader=PackageLoader("noiseflow.report", "assets"),
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
    )
