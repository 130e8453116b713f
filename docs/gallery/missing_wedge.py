"""
The missing wedge
=================

The effect of tilts that were not recorded: a slice and its Fourier transform for three tilt ranges.

.. image:: /images/gallery/missing_wedge.png
   :alt: Slices and their Fourier transforms for three tilt ranges
"""

# sphinx_gallery_thumbnail_path = "images/gallery/missing_wedge.png"

import numpy as np
from drawing import main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom

# %%
# Clean projections of one phantom over ±90°, ±60° and ±40° are back-projected with a Hann window.


def draw():
    truth = make_phantom("shells", 64, generator=np.random.default_rng(3))
    figure, axes = new_figure(3, 2, width=11, height=3.5)
    for column, limit in enumerate((90, 60, 40)):
        series, _ = recon.clean_tilt_series(truth, np.arange(-limit, limit, 2.0))
        grid = recon.VolumeGrid.of(series, 64)
        piece = recon.reconstruct(series, grid, method="wbp", window="hann").volume.attenuation[:, 32]
        power = np.log10(np.abs(np.fft.fftshift(np.fft.fft2(piece))) + 1e-3)
        show(axes[0, column], piece, f"tilts ±{limit}°, slice (z, x)", bar=(16, "16 voxels"), unit="attenuation")
        bar = (16, "0.25 / voxel")
        show(axes[1, column], power, "its Fourier transform", bar=bar, unit="log₁₀ amplitude", cmap="viridis", vmin=-2)
    return figure


if __name__ == "__main__":
    main(draw)
