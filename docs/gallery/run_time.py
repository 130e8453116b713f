"""Run time against error of every method on one simulated scene, from the results of `noiseflow benchmark rivals`."""

import json
from pathlib import Path

from drawing import BLUE, GREEN, GREY, ORANGE, PINK, SKY, main, new_figure

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results" / "rivals-64-clipped-shells-0-full.json"
METHODS = {
    "WBP hann": (GREY, "s"),
    "SIRT": (ORANGE, "o"),
    "ASTRA SIRT": (PINK, "o"),
    "L2 + TV": (SKY, "^"),
    "joint": (BLUE, "D"),
    "oracle": (GREEN, "v"),
}


def draw():
    """One line per method, one point per number of steps; the first run of each."""
    cells = json.loads(RESULTS.read_text(encoding="utf-8"))["cells"]
    figure, axes = new_figure(width=7, height=4.4)
    for name, (colour, marker) in METHODS.items():
        points = cells[f"64/curve 0/{name}"]["points"]
        seconds, psnr = [p["seconds"] for p in points], [p["psnr raw"] for p in points]
        axes[0, 0].plot(seconds, psnr, marker=marker, ms=5, color=colour, label=name)
    axes[0, 0].set(xscale="log", xlabel="seconds, two CPU cores", ylabel="PSNR of the volume (dB), not rescaled")
    axes[0, 0].set_title("shells of 64³ voxels, 79 tilts, clipped noise", fontsize=10)
    axes[0, 0].legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(draw)
