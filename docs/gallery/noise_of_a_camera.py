"""
Shot noise, read noise, rounding
================================

Shot noise, read noise and rounding: samples and distribution functions of three detectors.

.. image:: /images/gallery/noise_of_a_camera.png
   :alt: Three detectors on one clean ramp, and their distribution functions
"""

# sphinx_gallery_thumbnail_path = "images/gallery/noise_of_a_camera.png"

import torch
from drawing import BLUE, ORANGE, main, new_figure, show

from noiseflow import Digitised, Gaussian, PoissonGaussian

# %%
# All three detectors see the same clean ramp. The lower row shows their distribution functions at 1 and 4 electrons.


def draw():
    camera = PoissonGaussian(gain=1.0, offset=0.0, read_noise=0.5)
    detectors = {
        "Gaussian": Gaussian(1.0),
        "single electrons": PoissonGaussian(gain=1.0, offset=0.0, read_noise=0.2),
        "rounded, clipped at 8": Digitised(camera, step=1.0, low=0.0, high=8.0),
    }
    ramp, values = torch.linspace(0.5, 8.0, 128).expand(96, 128), torch.linspace(-2, 12, 561)
    figure, axes = new_figure(3, 2, width=12, height=3.2)
    for column, (name, detector) in enumerate(detectors.items()):
        with torch.no_grad():
            sample = detector(ramp).sample(generator=torch.Generator().manual_seed(0))
            show(axes[0, column], sample, name, bar=(32, "32 pixels"), unit="pixel value (e⁻)", vmin=-1, vmax=9)
            for signal, colour in ((1.0, BLUE), (4.0, ORANGE)):
                cdf = detector(torch.full_like(values, signal)).cdf(values)
                axes[1, column].plot(values, cdf, color=colour, label=f"signal {signal:g} e⁻")
        axes[1, column].set(xlabel="pixel value (e⁻)", ylabel="distribution function")
        axes[1, column].legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(draw)
