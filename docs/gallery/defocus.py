"""
Defocus
=======

A converging beam blurs the parts that are out of focus: a slice with and without this blur in the model.

.. image:: /images/gallery/defocus.png
   :alt: The truth, a slice with the blur ignored, and a slice with the blur modelled
"""

# sphinx_gallery_thumbnail_path = "images/gallery/defocus.png"

import numpy as np
import torch
from drawing import main, new_figure, show

import noiseflow
import recon
from recon.projection.defocused_projector import DefocusedProjector
from recon.simulate.phantoms import make_phantom

BLUR = 0.06  # pixels per voxel out of the plane of focus

# %%
# The series is simulated with blur that grows with the distance from the plane of focus, and reconstructed by least
# squares twice.


def draw():
    truth = make_phantom("particles", 48, generator=np.random.default_rng(5)).astype(np.float32)
    angles = np.arange(-70, 70, 2.0)
    focused = recon.SliceProjector(tilt_angles=angles, depth=48, width=48)
    projector = DefocusedProjector(focused, BLUR)
    images = projector(torch.from_numpy(truth)).numpy()
    noise = noiseflow.Gaussian(0.02 * float(images.max()))
    series = recon.add_noise(recon.TiltSeries(images, angles, mode="linear"), noise, seed=1)
    figure, axes = new_figure(3, width=12, height=3.6)
    options = {"bar": (12, "12 voxels"), "unit": "attenuation", "vmin": 0, "vmax": float(truth.max())}
    show(axes[0, 0], truth[:, 24], "truth, slice (z, x)", **options)
    for axis, defocus, words in ((axes[0, 1], 0.0, "blur ignored"), (axes[0, 2], BLUR, "blur modelled")):
        grid = recon.VolumeGrid.of(series, 48)
        volume = recon.reconstruct(series, grid, method="l2", num_steps=100, defocus=defocus).volume.attenuation
        psnr = recon.compare(volume, truth).psnr
        show(axis, volume[:, 24], f"{words}: {psnr:.1f} dB", **options)
    return figure


if __name__ == "__main__":
    main(draw)
