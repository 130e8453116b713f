"""
Pixels that differ
==================

A camera whose pixels differ: raw frames, the maps of gain and offset, and the residuals with and without these maps.

.. image:: /images/gallery/pixel_maps.png
   :alt: A raw frame, maps of gain and offset, and histograms of the residuals with and without them
"""

# sphinx_gallery_thumbnail_path = "images/gallery/pixel_maps.png"

import torch
from drawing import BLUE, ORANGE, main, new_figure, show

import noiseflow

# %%
# The simulated camera has its own gain and offset in each pixel. Two models of it predict one raw frame: with the
# maps, and with one offset for all pixels.


def draw():
    generator = torch.Generator().manual_seed(0)
    columns = 1 + 0.08 * torch.randn(64, generator=generator)
    gain = (columns + 0.04 * torch.randn(64, 64, generator=generator)).clamp(min=0.5)
    offset = 100 + 3 * torch.randn(64, 64, generator=generator)
    ideal = noiseflow.PoissonGaussian(gain=2.0, offset=0.0, read_noise=1.2)
    camera = noiseflow.WithMaps(ideal, gain=gain, offset=offset)
    clean = torch.full((64, 64), 120.0)
    raw = camera(clean).sample(generator=generator)
    figure, axes = new_figure(4, width=15, height=3.3)
    bar = (16, "16 pixels")
    show(axes[0, 0], raw, "raw frame of a uniform scene", bar=bar, unit="counts")
    show(axes[0, 1], gain, "relative gain", bar=bar, unit="", cmap="cividis")
    show(axes[0, 2], offset, "offset", bar=bar, unit="counts", cmap="cividis")
    with torch.no_grad():
        for name, found, colour in (("with maps", camera(clean), BLUE), ("one offset for all", ideal(clean), ORANGE)):
            residual = raw - (found.mean if name == "with maps" else found.mean + 100)
            label = f"{name}: {float((residual / found.variance.sqrt()).std()):.2f} σ"
            axes[0, 3].hist((residual / found.variance.sqrt()).ravel(), 40, histtype="step", color=colour, label=label)
    axes[0, 3].set(xlabel="residual / predicted deviation", ylabel="pixels")
    axes[0, 3].legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(draw)
