"""
Probability integral transform
==============================

The probability integral transform is flat if a noise model is right. Otherwise its shape shows the error.

.. image:: /images/gallery/pit.png
   :alt: Probability integral transforms of the true model, one that is too narrow, and one of constant width
"""

# sphinx_gallery_thumbnail_path = "images/gallery/pit.png"

import torch
from drawing import BLUE, main, new_figure

import noiseflow
from noiseflow import PoissonGaussian

# %%
# A Poisson-Gaussian detector is simulated, and three models of it are evaluated on the same pixels.


def draw():
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(40_000, generator=generator) * 40 + 5
    observation = PoissonGaussian(gain=2.0, offset=0.0, read_noise=1.5)(signal).sample(generator=generator)
    models = {
        "the true model: flat": PoissonGaussian(gain=2.0, offset=0.0, read_noise=1.5),
        "too narrow: high at both ends": PoissonGaussian(gain=1.4, offset=0.0, read_noise=1.5),
        "one width for all signals: a bump": noiseflow.Gaussian(float((observation - signal).std())),
    }
    figure, axes = new_figure(3, width=11, height=3.2)
    for axis, (name, model) in zip(axes[0], models.items(), strict=True):
        found = noiseflow.metrics.evaluate(model, signal, observation)
        axis.stairs(found.pit, torch.linspace(0, 1, 21), fill=True, color=BLUE, alpha=0.5)
        axis.axhline(1, color="black", lw=1, ls="--")
        axis.set(xlabel="F(observation | signal)", ylabel="density", ylim=(0, 2.2))
        axis.set_title(f"{name}\nKS {found.ks:.3f}, floor {found.ks_floor:.3f}", fontsize=9)
    return figure


if __name__ == "__main__":
    main(draw)
