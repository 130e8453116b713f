"""
Run time against error
======================

Run time against error of every method on one simulated scene, from the results of ``noiseflow benchmark rivals``.

.. image:: /images/gallery/run_time.png
   :alt: PSNR against seconds for six methods

The results are those of ``docs/benchmarks/results`` (an earlier commit, two CPU cores), so the program and its notebook
run only in ``docs/gallery`` of a clone of the repository. ASTRA runs on the CPU, slice by slice. SIRT and least squares
use settings tuned against the ground truth; the joint fit chooses its own.
"""

# sphinx_gallery_thumbnail_path = "images/gallery/run_time.png"

import json

from drawing import BLUE, GREEN, GREY, ORANGE, PINK, RESULTS, SKY, main, new_figure

SCENE = RESULTS / "rivals-64-clipped-shells-0-full.json"
METHODS = {
    "WBP hann": (GREY, "s"),
    "SIRT": (ORANGE, "o"),
    "ASTRA SIRT": (PINK, "o"),
    "L2 + TV": (SKY, "^"),
    "joint": (BLUE, "D"),
    "oracle": (GREEN, "v"),
}

# %%
# Each method has one line, with one point for each number of steps. The points are the first run of each method.


def draw():
    cells = json.loads(SCENE.read_text(encoding="utf-8"))["cells"]
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
