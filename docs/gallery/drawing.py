"""What the programs of the gallery share: images with scale bars, colours that everybody can tell apart, and paths."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import noiseflow
from noiseflow.io import atomic_path
from noiseflow.report import new_figure as new_figure

DATA = Path(noiseflow.__file__).parent / "data"
RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
BLUE, ORANGE, GREEN, PINK, SKY, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#777777"  # Okabe and Ito


def show(axis: Any, image: Any, title: str, *, bar: tuple[float, str], unit: str, **options: Any) -> None:
    """Draw an image with a colour bar in `unit` and a scale bar: its length in pixels and what to write on it."""
    length, words = bar
    drawn = axis.imshow(image, **{"cmap": "gray", "interpolation": "nearest"} | options)
    axis.figure.colorbar(drawn, ax=axis, shrink=0.75, label=unit)
    left, low = 0.05 * image.shape[1], 0.93 * image.shape[0]
    axis.plot((left, left + length), (low, low), color="black", lw=5, solid_capstyle="butt")
    axis.plot((left, left + length), (low, low), color="white", lw=3, solid_capstyle="butt")
    label = {
        "color": "white",
        "fontsize": 8,
        "va": "bottom",
        "bbox": {"facecolor": "black", "alpha": 0.5, "pad": 1, "lw": 0},
    }
    axis.text(left, low - 0.03 * image.shape[0], words, **label)
    axis.set_title(title, fontsize=10)
    axis.set(xticks=[], yticks=[], xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))


def save(figure: Any, path: Path) -> None:
    """Write the picture, white behind."""
    with atomic_path(path) as partial:
        figure.savefig(partial, format=path.suffix[1:], dpi=80, facecolor="white")


def main(draw: Callable[[], Any], picture: str = "") -> None:
    """Draw, and write to the path on the command line or to `picture` in docs/images; show it in a notebook."""
    if "ipykernel" in sys.modules:  # its command line is that of the kernel
        from IPython.display import Image, display

        save(draw(), Path("picture.png"))
        display(Image("picture.png"))
        return
    default = Path(__file__).parents[1] / "images" / (picture or f"gallery/{Path(sys.argv[0]).stem}.png")
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    save(draw(), path)
    print(f"wrote {path}")
