"""
Error bars
==========

Error bars of a volume: a slice, the half-width of its 90 % intervals, and a profile with its interval and the truth.

.. image:: /images/gallery/error_bars.png
   :alt: A slice, the half-width of its intervals, and a profile with the truth

The error bars cover noise, regulariser and, as an estimate, the missing wedge. Inside the object, fewer intervals contain
the truth than in the vacuum, because the regulariser lowers the contrast of thin walls.
"""

# sphinx_gallery_thumbnail_path = "images/gallery/error_bars.png"

import numpy as np
from drawing import BLUE, ORANGE, main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS

# %%
# A noisy series is simulated and reconstructed with 16 samples of the posterior. The profile is one line of voxels
# through the centre.


def draw():
    acquisition = ACQUISITIONS["skewed"]
    truth = make_phantom("shells", 32, generator=np.random.default_rng(3))
    clean, unit = recon.clean_tilt_series(truth, np.arange(-60, 60, 2.0), acquisition=acquisition)
    noisy = recon.add_noise(clean, acquisition.noise(), seed=1)
    result = recon.reconstruct(noisy, recon.VolumeGrid.of(noisy, 32), method="joint", uncertainty=16)
    volume, width = result.volume.attenuation, result.uncertainty.half_width(0.9)
    held = np.abs(volume - truth * unit) <= width
    inside = held[truth > 0.05 * truth.max()]

    figure, axes = new_figure(3, width=13, height=3.6)
    bar = (8, "8 voxels")
    show(axes[0, 0], volume[:, 16], "joint fit, slice (z, x)", bar=bar, unit="attenuation")
    show(axes[0, 1], width[:, 16], "half-width of the 90 % interval", bar=bar, unit="attenuation", cmap="cividis")
    x, line = np.arange(32), (16, 16)
    axes[0, 2].fill_between(
        x, (volume - width)[line], (volume + width)[line], color=BLUE, alpha=0.25, label="90 % interval"
    )
    axes[0, 2].plot(x, volume[line], color=BLUE, label="volume")
    axes[0, 2].plot(x, truth[line] * unit, color=ORANGE, label="truth")
    axes[0, 2].set(xlabel="x (voxels)", ylabel="attenuation per voxel")
    axes[0, 2].set_title(f"hold the truth: {held.mean():.0%} of all, {inside.mean():.0%} of the object", fontsize=10)
    axes[0, 2].legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(draw)
