"""
Geometry
========

The geometry of a tilt series: volume, tilt axis, beam, detector, and the sign of the tilt.

.. image:: /images/geometry.svg
   :alt: A slice across the tilt axis with its rays and detector, and a tilt image
"""

# sphinx_gallery_thumbnail_path = "images/geometry.svg"

from __future__ import annotations

import math
from typing import Any

from drawing import BLUE, ORANGE, main, new_figure

TILT = 30.0

# %%
# The left panel shows one slice across the tilt axis, the right panel one tilt image.


def draw() -> Any:
    figure, panels = new_figure(2, width=9, height=4.2)
    _slice(panels[0, 0])
    _image(panels[0, 1])
    return figure


def _arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], words: str, **options: Any) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "lw": 1.4, **options})
    axes.annotate(words, end, textcoords="offset points", xytext=(6, 4), fontsize=9)


def _slice(axes: Any) -> None:
    theta = math.radians(TILT)
    along, across = (math.cos(theta), math.sin(theta)), (-math.sin(theta), math.cos(theta))
    axes.add_patch(_rectangle())
    _arrow(axes, (0, 0), (1.5, 0), "x")
    _arrow(axes, (0, 0), (0, 1.5), "z")
    axes.plot(0, 0, "o", mfc="white", mec="black", ms=9)
    axes.plot(0, 0, ".", color="black", ms=4)
    axes.annotate("tilt axis y, towards you", (0, 0), textcoords="offset points", xytext=(-112, -16), fontsize=8)
    for shift in (-0.8, -0.4, 0.0, 0.4, 0.8):
        start = (shift * along[0] - 1.7 * across[0], shift * along[1] - 1.7 * across[1])
        end = (shift * along[0] + 1.7 * across[0], shift * along[1] + 1.7 * across[1])
        axes.annotate("", start, end, arrowprops={"arrowstyle": "->", "lw": 0.8, "color": BLUE})
    low = [-1.2 * a - 1.75 * b for a, b in zip(along, across, strict=True)]
    high = [1.2 * a - 1.75 * b for a, b in zip(along, across, strict=True)]
    axes.plot(*zip(low, high, strict=True), color=ORANGE, lw=3)
    axes.annotate("detector, u", high, textcoords="offset points", xytext=(4, 2), fontsize=9, color=ORANGE)
    axes.annotate("rays at tilt θ", (-2.0, 1.6), fontsize=9, color=BLUE)
    axes.set_title("one slice: u = x cos θ + z sin θ", fontsize=10)
    axes.set(xlim=(-2.2, 2.4), ylim=(-2.4, 2.0), aspect="equal")
    axes.axis("off")


def _rectangle() -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((-1, -0.7), 2, 1.4, facecolor="0.88", edgecolor="0.4")


def _image(axes: Any) -> None:
    axes.add_patch(_rectangle())
    axes.plot((0, 0), (-0.9, 0.9), "--", color="black", lw=1)
    axes.annotate("tilt axis", (0.05, 0.92), ha="left", va="bottom", fontsize=9)
    _arrow(axes, (-1.15, -0.85), (0.4, -0.85), "")
    axes.annotate("u (columns; x at tilt 0)", (-1.1, -0.9), va="top", fontsize=9)
    _arrow(axes, (-1.15, -0.85), (-1.15, 0.5), "")
    axes.annotate("y (rows; up, as in MRC)", (-1.2, -0.15), rotation=90, ha="right", va="center", fontsize=9)
    turned = math.radians(25)
    axes.plot((0.62 * math.tan(turned), -0.62 * math.tan(turned)), (-0.55, 0.62), ":", color=ORANGE, lw=1.4)
    axes.annotate("an axis at --tilt-axis 25", (0.75, -0.62), ha="right", fontsize=8, color=ORANGE)
    axes.set_title("one tilt image, shape (y, u)", fontsize=10)
    axes.set(xlim=(-1.7, 1.7), ylim=(-1.3, 1.4), aspect="equal")
    axes.axis("off")


if __name__ == "__main__":
    main(draw, "geometry.svg")
