"""
What the joint fit does
=======================

The picture of the README: a noisy tilt series, two reconstructions, the truth, error bars, and the learnt noise.

.. image:: /images/overview.png
   :alt: One noisy tilt, a slice by SIRT, by the joint fit, the truth, the error bar of each voxel, and the learnt noise
"""

# sphinx_gallery_thumbnail_path = "images/overview.png"

import numpy as np
import torch
from drawing import BLUE, ORANGE, main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, tilt_range

# %%
# A bright-field series is simulated with clipped noise. SIRT and the joint fit reconstruct it; the joint fit also
# returns error bars and the noise model that it learnt.


def draw(size=192, num_samples=8):
    acquisition = ACQUISITIONS["clipped"]
    truth = make_phantom("shells", size, generator=np.random.default_rng(3))
    clean, unit = recon.clean_tilt_series(truth, tilt_range("-59.5:57.5:1.5"), acquisition=acquisition)
    noisy = recon.add_noise(clean, acquisition.noise(), seed=1)
    grid = recon.VolumeGrid.of(noisy, size)
    joint = recon.reconstruct(noisy, grid, method="joint", uncertainty=num_samples)
    classical = recon.reconstruct(noisy, grid, method="sirt")

    figure, axes = new_figure(3, 2, width=12, height=3.7)
    slices, bar = size // 2, (size // 4, f"{size // 4} voxels")
    limits = {"unit": "attenuation per voxel", "bar": bar, "vmin": 0.0, "vmax": float(truth.max() * unit)}
    tilt = noisy.images[len(noisy.images) // 2]
    show(axes[0, 0], tilt, "one of 79 noisy tilts (y, u)", bar=bar, unit="intensity")
    show(axes[0, 1], classical.volume.attenuation[:, slices], "SIRT, slice (z, x)", **limits)
    show(axes[0, 2], joint.volume.attenuation[:, slices], "joint fit, the same slice", **limits)
    show(axes[1, 0], truth[:, slices] * unit, "truth, the same slice", **limits)
    error = joint.uncertainty.half_width(0.9)[:, slices]
    show(axes[1, 1], error, "error bar of each voxel (90 %)", bar=bar, unit="± attenuation", cmap="cividis", vmin=0)
    draw_noise(axes[1, 2], clean.images, noisy.images, joint.noise_model)
    return figure


def draw_noise(axis, clean, noisy, noise_model):
    """Histograms of pixels whose clean values are alike, and the mass that the learnt model gives each bin."""
    bins = torch.linspace(0, 1, 41)
    low, high = bins[:-1].clone(), bins[1:].clone()
    low[0], high[-1] = -torch.inf, torch.inf  # the outer bins hold what is clipped
    for level, colour in ((0.6, ORANGE), (0.95, BLUE)):
        near = np.abs(clean - level) < 0.02
        axis.hist(noisy[near], bins, density=True, alpha=0.35, color=colour, label=f"data, signal {level}")
        with torch.no_grad():
            mass = noise_model(torch.full_like(low, level)).log_interval_prob(low, high).exp()
        axis.stairs(mass / bins.diff(), bins, color=colour, lw=1.5, label="learnt without truth")
    axis.set(xlabel="pixel value", ylabel="density", yscale="log", ylim=(0.02, 100))
    axis.set_title("noise at two signals", fontsize=10)
    axis.legend(fontsize=7, loc="upper left")


if __name__ == "__main__":
    main(draw, "overview.png")
