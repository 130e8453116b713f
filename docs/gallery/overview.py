"""Draws the README's picture: a noisy tilt series, two reconstructions of it, and the noise that was learnt on the way.

python docs/gallery/overview.py docs/images/overview.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from noiseflow.io import atomic_path
from noiseflow.report import new_figure, show_image
from recon import JointReconstructor, VolumeGrid, add_noise, clean_tilt_series
from recon.methods._registry import reconstruct
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, tilt_range


def draw(path: Path, *, size: int = 64) -> None:
    """Simulate, reconstruct and draw."""
    acquisition = ACQUISITIONS["clipped"]
    truth = make_phantom("shells", size, generator=np.random.default_rng(3))
    clean, unit = clean_tilt_series(truth, tilt_range("-59.5:57.5:1.5"), acquisition=acquisition)
    noisy = add_noise(clean, acquisition.noise(), seed=1)
    grid = VolumeGrid.of(noisy, size)
    joint = JointReconstructor()(noisy, grid)
    classical = reconstruct(noisy, grid, method="sirt").volume

    figure, axes = new_figure(5, width=16, height=3.3)
    middle, slices = len(clean.images) // 2, size // 2
    limits = (0.0, float(truth.max() * unit))
    show_image(axes[0, 0], noisy.images[middle], "one noisy tilt")
    show_image(axes[0, 1], classical.attenuation[:, slices], "SIRT, slice", limits=limits)
    show_image(axes[0, 2], joint.volume.attenuation[:, slices], "joint fit, slice", limits=limits)
    show_image(axes[0, 3], truth[:, slices] * unit, "truth, slice", limits=limits)
    _draw_noise(axes[0, 4], clean.images, noisy.images, joint.noise_model)
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=80, facecolor="white")


def _draw_noise(axis: object, clean: np.ndarray, noisy: np.ndarray, noise_model: torch.nn.Module) -> None:
    bins = np.linspace(0, 1, 41)
    for level, colour in ((0.6, "tab:orange"), (0.95, "tab:blue")):
        near = np.abs(clean - level) < 0.02
        axis.hist(noisy[near], bins, density=True, alpha=0.4, color=colour, label=f"data, signal {level}")
        signal = torch.full((bins.size - 1,), level)
        edges = torch.from_numpy(bins).float()
        low, high = edges[:-1].clone(), edges[1:].clone()
        low[0], high[-1] = -torch.inf, torch.inf
        with torch.no_grad():
            mass = noise_model(signal).log_interval_prob(low, high).exp().numpy()
        axis.stairs(mass / np.diff(bins), bins, color=colour, label="learnt")
    axis.set_title("noise, learnt without truth", fontsize=10)
    axis.set_yscale("log")
    axis.set_ylim(0.02, 100)
    axis.legend(fontsize=7, loc="upper left")


if __name__ == "__main__":
    draw(Path(sys.argv[1] if len(sys.argv) > 1 else "overview.png"))
