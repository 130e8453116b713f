"""
Scan noise
==========

Scan noise is one random offset for each row of an image. The picture shows it in the image and in the row means, and the
fitted offsets.

.. image:: /images/gallery/scan_noise.png
   :alt: An image with and one without row offsets, and the row means of both
"""

# sphinx_gallery_thumbnail_path = "images/gallery/scan_noise.png"

import torch
from drawing import BLUE, ORANGE, main, new_figure, show

import noiseflow

# %%
# The simulated detector adds a random offset to each row. A second model is then fitted to the noisy image.


def draw():
    generator = torch.Generator().manual_seed(0)
    clean = torch.linspace(0.2, 0.8, 96).expand(96, 96).contiguous()
    truth = noiseflow.ScanNoise(noiseflow.Gaussian(0.05), scale=0.04)
    noisy = truth(clean).sample(generator=generator)
    images = {"with row offsets": noisy, "without": noiseflow.Gaussian(0.064)(clean).sample(generator=generator)}
    fitted = noiseflow.ScanNoise(noiseflow.Gaussian(0.1), scale=0.1)
    noiseflow.fit(fitted, clean, noisy, digitise=False, num_steps=200, generator=torch.Generator().manual_seed(1))
    scale = float(fitted.log_scale.exp())
    figure, axes = new_figure(3, width=12, height=3.4)
    for axis, (name, image) in zip(axes[0], images.items(), strict=False):
        show(axis, image, name, bar=(24, "24 pixels"), unit="pixel value")
    for (name, image), colour in zip(images.items(), (ORANGE, BLUE), strict=True):
        axes[0, 2].plot((image - clean).mean(dim=1), color=colour, label=name)
    axes[0, 2].set(xlabel="row", ylabel="mean of residuals", title=f"offsets: 0.040 made, {scale:.3f} fitted")
    axes[0, 2].legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(draw)
