"""
One slice by five methods
=========================

One slice of a real needle by five methods, with every second tilt left out: back-projection (two windows), SIRT, least
squares, and the joint fit.

.. image:: /images/gallery/classical_methods.png
   :alt: Five slices of a real needle, each by another method, and one of its tilts
"""

# sphinx_gallery_thumbnail_path = "images/gallery/classical_methods.png"

from dataclasses import replace

from drawing import DATA, main, new_figure, show

import recon

# %%
# Eight slices of the needle are reconstructed from every second tilt. The last panel shows the tilt at 0°.


def draw():
    whole = recon.read_tilt_series(DATA / "tilt_needle" / "needle_aligned.mrc", mode="linear")
    few = replace(whole, images=whole.images[::2, 24:32], tilt_angles=whole.tilt_angles[::2])
    methods = {
        "back-projection, ramp": {"method": "wbp", "window": "ramp"},
        "back-projection, hann": {"method": "wbp", "window": "hann"},
        "SIRT, 50 iterations": {"method": "sirt", "num_steps": 50},
        "least squares + total variation": {"method": "l2", "num_steps": 60},
        "joint fit": {"method": "joint", "num_steps": 60},
    }
    figure, axes = new_figure(3, 2, width=12, height=3.5)
    for axis, (name, settings) in zip(axes.flat, methods.items(), strict=False):
        volume = recon.reconstruct(few, recon.VolumeGrid.of(few), **settings).volume.attenuation
        show(
            axis,
            volume[:, 4],
            f"{name}: slice (z, x)",
            bar=(11.1, "200 nm"),
            unit="counts per voxel",
            vmin=0,
            vmax=2500,
        )
    image = whole.images[45]
    show(axes[1, 2], image, "the tilt at 0° (y, x)", bar=(11.1, "200 nm"), unit="counts")
    return figure


if __name__ == "__main__":
    main(draw)
