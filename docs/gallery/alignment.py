"""
Alignment
=========

The images of this series were shifted on purpose: the shifts that ``prepare`` finds, and a slice before and after alignment.

.. image:: /images/gallery/alignment.png
   :alt: A slice before and after alignment, and the shifts made and found
"""

# sphinx_gallery_thumbnail_path = "images/gallery/alignment.png"

import numpy as np
from drawing import BLUE, ORANGE, main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom

# %%
# Each image of the series is shifted by a random number of pixels along u. ``prepare`` measures the shifts.


def draw():
    random = np.random.default_rng(3)
    truth = make_phantom("particles", 48, generator=random)
    clean, _ = recon.clean_tilt_series(truth, np.arange(-60, 62, 3.0))
    shifts = np.rint(random.normal(0, 2.5, len(clean.images))).astype(int)
    images = np.stack([np.roll(image, shift, axis=1) for image, shift in zip(clean.images, shifts, strict=True)])
    raw = recon.TiltSeries(images, clean.tilt_angles)
    prepared = recon.prepare(raw, tilt_axis=0.0, refine_alignment=True)
    found = prepared.alignment.shifts[:, 1]
    figure, axes = new_figure(3, width=12, height=3.6)
    for axis, series, words in ((axes[0, 0], raw, "as recorded"), (axes[0, 1], prepared.tilt_series, "aligned")):
        volume = recon.reconstruct(series, recon.VolumeGrid.of(series, 48), method="sirt", num_steps=40).volume
        show(axis, volume.attenuation[:, 24], f"{words}: SIRT, slice (z, x)", bar=(12, "12 voxels"), unit="attenuation")
    axes[0, 2].plot(raw.tilt_angles, shifts, "o", color=ORANGE, label="made")
    axes[0, 2].plot(raw.tilt_angles, found, "-", color=BLUE, label="found")
    axes[0, 2].set(xlabel="tilt angle (°)", ylabel="shift along u (pixels)")
    axes[0, 2].legend()
    return figure


if __name__ == "__main__":
    main(draw)
