"""
Every noise model on one camera
===============================

Nine noise models fitted to one real camera. Each panel shows the density that a model learns at one signal, and the
pixels that it has to describe.

.. image:: /images/gallery/noise_models.png
   :alt: Densities of nine noise models at one signal, over the histogram of a real camera

Titles give the negative log-likelihood of held-out pixels; lower is better. Differences below 0.001 nats per pixel are not
significant here.
"""

# sphinx_gallery_thumbnail_path = "images/gallery/noise_models.png"

import numpy as np
import torch
from drawing import BLUE, DATA, ORANGE, main, new_figure

import calibration
import noiseflow

MIRO = DATA / "exposures_miro"
MODELS = {
    "Gaussian": noiseflow.Gaussian,
    "Poisson": noiseflow.Poisson,
    "SignalDependentGaussian": noiseflow.SignalDependentGaussian,
    "PoissonGaussian": noiseflow.PoissonGaussian,
    "ExcessNoise": noiseflow.ExcessNoise,
    "Mixture": noiseflow.Mixture,
    "RadialFlow": noiseflow.RadialFlow,
    "SplineFlow": noiseflow.SplineFlow,
    "PhysicsFlow": noiseflow.PhysicsFlow,
}

# %%
# The camera's short and long exposure are aligned. Each model is then fitted to the pairs of pixels, and its density
# is drawn at the median signal.


def draw():
    (pair,) = calibration.read_pairs([MIRO / "channel1_050ms.tif"], [MIRO / "channel1_long.tif"])
    aligned = calibration.align_pair(pair)
    signal, observation = (torch.from_numpy(each[aligned.mask]).float() for each in (aligned.signal, aligned.short))
    level = float(signal.median())
    near = observation[(signal - level).abs() < 0.02 * level].numpy()
    bins = np.arange(np.quantile(near, 0.001), np.quantile(near, 0.999), 4.0)
    values = torch.linspace(float(bins[0]), float(bins[-1]), 300)
    figure, axes = new_figure(3, 3, width=11, height=2.6)
    for axis, (name, make) in zip(axes.flat, MODELS.items(), strict=True):
        result = noiseflow.fit(
            make(), signal, observation, digitise=False, num_steps=200, generator=torch.Generator().manual_seed(0)
        )
        with torch.no_grad():
            density = result.noise_model(torch.full_like(values, level)).log_prob(values).exp()
        axis.hist(near, bins, density=True, color=BLUE, alpha=0.35, label="pixels")
        axis.plot(values, density, color=ORANGE, label="model")
        axis.set_title(f"{name}: {result.held_out_nll:.4f} nats per pixel", fontsize=9)
        axis.set(xlabel=f"pixel value (counts) at signal {level:.0f}", ylabel="density (1/count)")
    axes[0, 0].legend(fontsize=7)
    return figure


if __name__ == "__main__":
    main(draw)
