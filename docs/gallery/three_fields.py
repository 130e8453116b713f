"""
The same object, three fields
=============================

One noisy series of hollow shells, reconstructed as a sum of voxel grids (``--field grids``, the default), of anisotropic
Gaussians, and as a network of the coordinates. Each field is sampled with voxels of half the pixel size. Values between the
voxels of a grid are interpolated; those of the network and of Gaussians are part of the fit. The
benchmark *Fields* compares more objects.

.. image:: /images/gallery/three_fields.png
   :alt: The truth and three reconstructions of shells, sampled with voxels of half the pixel size
"""

# sphinx_gallery_thumbnail_path = "images/gallery/three_fields.png"

import numpy as np
from drawing import main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS

# %%
# ``result.field`` is the fitted field; its file, written by ``--save-field``, is sampled by ``noiseflow export --voxel-size``.


def draw():
    noise = ACQUISITIONS["clipped"]
    density = make_phantom("shells", 40, generator=np.random.default_rng(0))
    clean, unit = recon.clean_tilt_series(density, np.arange(-59.0, 60, 2), acquisition=noise)
    series = recon.add_noise(clean, noise.noise(), seed=1)
    parts = {"truth": density * unit}
    for name in ("grids", "gaussians", "network"):
        found = recon.reconstruct(series, field=name)
        psnr = recon.compare(found.volume.attenuation, density * unit).psnr
        count = sum(parameter.numel() for parameter in found.field.parameters())
        parts[f"{name}: {psnr:.1f} dB, {count} parameters"] = 2 * found.field.sampled(0.5).numpy()
    figure, axes = new_figure(4, width=14, height=3.4)
    for axis, (title, part) in zip(axes[0], parts.items(), strict=True):
        per_voxel = len(part) // len(density)
        bar = (10 * per_voxel, "10 pixels")
        show(axis, part[len(part) // 2], title, bar=bar, unit="attenuation", vmin=0, vmax=density.max() * unit)
    return figure


if __name__ == "__main__":
    main(draw)
