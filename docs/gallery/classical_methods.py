"""A real HAADF tilt series of a needle with half of its tilts left out: weighted back-projection with two windows, and SIRT.

python docs/gallery/classical_methods.py docs/images/classical_methods.png
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import noiseflow
from noiseflow.io import atomic_path
from noiseflow.report import new_figure, show_image
from recon import VolumeGrid, read_tilt_series
from recon.methods._registry import reconstruct

NEEDLE = Path(noiseflow.__file__).parent / "data" / "tilt_needle" / "needle_aligned.mrc"


def draw(path: Path) -> None:
    """Reconstruct and draw."""
    whole = read_tilt_series(NEEDLE, mode="linear")
    few = replace(whole, images=whole.images[::2], tilt_angles=whole.tilt_angles[::2])
    grid = VolumeGrid.of(few)
    methods = {
        "back-projection, ramp": {"method": "wbp", "window": "ramp"},
        "back-projection, hann": {"method": "wbp", "window": "hann"},
        "SIRT, 50 iterations": {"method": "sirt", "num_steps": 50},
    }
    figure, axes = new_figure(len(methods), width=12, height=3.6)
    for axis, (name, settings) in zip(axes[0], methods.items(), strict=True):
        volume = reconstruct(few, grid, **settings).volume.attenuation
        show_image(axis, volume[:, grid.height // 2], f"{name}: slice (z, x)")
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=80, facecolor="white")


if __name__ == "__main__":
    draw(Path(sys.argv[1] if len(sys.argv) > 1 else "classical_methods.png"))
