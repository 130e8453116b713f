"""
Fourier shell correlation
=========================

The Fourier shell correlation with the truth lies inside the band that the error bars predict. Where the correlation is low,
the band is too low, because samples of the posterior are rougher than the truth.

.. image:: /images/gallery/fsc.png
   :alt: Shell correlation with the truth inside the expected band

The picture also shows the correlation of even with odd tilts. A high value means that the volume is reproducible, not that
it is right: both halves miss the same wedge.
"""

# sphinx_gallery_thumbnail_path = "images/gallery/fsc.png"

from dataclasses import replace

import numpy as np
from drawing import BLUE, GREEN, GREY, ORANGE, main, new_figure

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS

# %%
# A noisy series is reconstructed as a whole, and as two halves: the even and the odd tilts.


def draw():
    acquisition = ACQUISITIONS["skewed"]
    truth = make_phantom("shells", 48, generator=np.random.default_rng(3))
    clean, _ = recon.clean_tilt_series(truth, np.arange(-60, 60, 2.0), acquisition=acquisition)
    noisy = recon.add_noise(clean, acquisition.noise(), seed=1)
    halves = [replace(noisy, images=noisy.images[k::2], tilt_angles=noisy.tilt_angles[k::2]) for k in (0, 1)]

    def volume(series, method, **settings):
        return recon.reconstruct(series, recon.VolumeGrid.of(series, 48), method=method, **settings).volume.attenuation

    joint = recon.reconstruct(noisy, recon.VolumeGrid.of(noisy, 48), method="joint", uncertainty=16)
    curves = {
        "joint fit with the truth": (joint.volume.attenuation, truth, BLUE),
        "SIRT with the truth": (volume(noisy, "sirt", num_steps=40), truth, ORANGE),
        "least squares, even with odd tilts": (
            *(volume(h, "l2", weight=joint.weight, num_steps=80) for h in halves),
            GREEN,
        ),
    }
    figure, axes = new_figure(width=6.5, height=4)
    band = joint.uncertainty.shells
    label = "joint fit, expected from its error bars"
    axes[0, 0].fill_between(band.frequency, band.low, band.high, color=BLUE, alpha=0.2, lw=0, label=label)
    for name, (first, second, colour) in curves.items():
        axes[0, 0].plot(*recon.fourier_shell_correlation(first, second), color=colour, label=name)
    for level in (0.5, 0.143):
        axes[0, 0].axhline(level, color=GREY, lw=0.8, ls=":")
        axes[0, 0].text(0.005, level + 0.01, f"{level}", fontsize=8, color=GREY)
    axes[0, 0].set(xlabel="spatial frequency (cycles per voxel)", ylabel="correlation", ylim=(-0.05, 1.05))
    axes[0, 0].legend(fontsize=8, loc="lower left")
    return figure


if __name__ == "__main__":
    main(draw)
