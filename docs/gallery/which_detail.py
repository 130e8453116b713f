"""
Which detail is real?
=====================

The third picture keeps only the voxels whose 90 % interval does not contain zero. Several true particles keep only their
core, and faint streaks disappear. Detail that the missing wedge hides also has intervals, but these depend on the
regulariser alone. The benchmark *Error bars: do they contain the truth?* counts how often they do.

.. image:: /images/gallery/which_detail.png
   :alt: A slice, its error bars, the voxels beyond their interval, and the truth
"""

# sphinx_gallery_thumbnail_path = "images/gallery/which_detail.png"

import numpy as np
from drawing import main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS

# %%
# The volume is reconstructed with 16 samples of the posterior. The third picture sets all other voxels to zero.


def draw():
    noise = ACQUISITIONS["clipped"]
    density = make_phantom("particles", 48, generator=np.random.default_rng(2))
    clean, unit = recon.clean_tilt_series(density, np.arange(-59.0, 60, 2), acquisition=noise)
    found = recon.reconstruct(recon.add_noise(clean, noise.noise(), seed=1), uncertainty=16)
    volume, half = found.volume.attenuation, found.uncertainty.half_width(0.9)
    real = np.where(volume > half, volume, 0)
    parts = {"volume": volume, "half of the 90 % interval": half, "beyond its interval": real, "truth": density * unit}
    figure, axes = new_figure(4, width=14, height=3.2)
    for axis, (title, part) in zip(axes[0], parts.items(), strict=True):
        show(axis, part[24], title, bar=(10, "10 voxels"), unit="attenuation", vmin=0, vmax=density.max() * unit)
    return figure


if __name__ == "__main__":
    main(draw)
