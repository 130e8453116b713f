"""Building blocks of the self-contained HTML report: text, tables, figures. Works offline, light and dark."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from noiseflow.io import atomic_path, check_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
:root{color-scheme:light dark}
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#1d2433;background:#fff}
h1{font-size:1.7rem}h2{margin-top:2.2rem;font-size:1.25rem}
figure{margin:1rem 0}img{max-width:100%;height:auto;background:#fff;border-radius:4px}
figcaption,.note{color:#5b6475;font-size:.9rem}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{padding:.3rem .8rem;text-align:right;border-bottom:1px solid #d5dae3;white-space:nowrap}
th:first-child,td:first-child{text-align:left}
@media (prefers-color-scheme:dark){body{color:#dfe4ee;background:#14181f}figcaption,.note{color:#98a2b5}
th,td{border-color:#333b49}}
@media print{body{max-width:none}}
"""


class Report:
    """An HTML page that grows part by part.

    Args:
        title: page title; this and all other text is escaped.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._parts: list[str] = []

    def heading(self, text: str) -> None:
        """Start a section."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str = "") -> None:
        """Add a table; the first column is left-aligned."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
        body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        note = f'<p class="note">{html.escape(caption)}</p>' if caption else ""
        self._parts.append(f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>{note}')

    def figure(self, figure: Figure, *, caption: str) -> None:
        """Add a matplotlib figure, embedded as PNG."""
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=110, facecolor="white", bbox_inches="tight")
        data = base64.b64encode(stream.getvalue()).decode()
        text = html.escape(caption)
        self._parts.append(
            f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
        )

    def include(self, path: str | Path) -> None:
        """Add the content of a page that another report saved."""
        page = Path(path).read_text(encoding="utf-8")
        title = page.partition("<title>")[2].partition("</title>")[0]
        content = page.partition("<main>")[2].rpartition("</main>")[0]
        if not content:
            raise ValueError(f"{path} is not a noiseflow report; it has no content to include")
        self._parts.append(f"<h1>{title}</h1>{content}")

    def save(self, path: str | Path) -> Path:
        """Write the page; returns its path."""
        path = check_output(path, suffixes=frozenset({".html"}))
        page = (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(self.title)}</title>'
            f'<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}</style></head>'
            f"<body><h1>{html.escape(self.title)}</h1><main>{''.join(self._parts)}</main></body></html>\n"
        )
        with atomic_path(path) as partial:
            partial.write_text(page, encoding="utf-8")
        return path


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
