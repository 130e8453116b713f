"""
Choice of the weight
====================

The choice of the weight of the regulariser: the likelihood of held-out pixels, which you can compute, and the error against
the truth, which you cannot.

.. image:: /images/gallery/weight_choice.png
   :alt: Held-out likelihood and error against the truth for several weights
"""

# sphinx_gallery_thumbnail_path = "images/gallery/weight_choice.png"

import numpy as np
from drawing import BLUE, ORANGE, main, new_figure

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS

# %%
# The joint fit chooses the weight from the held-out likelihood. The volume is then reconstructed at five fixed
# weights around it, and each result is compared with the truth.


def draw():
    acquisition = ACQUISITIONS["skewed"]
    truth = make_phantom("shells", 40, generator=np.random.default_rng(3))
    clean, unit = recon.clean_tilt_series(truth, np.arange(-60, 60, 3.0), acquisition=acquisition)
    noisy = recon.add_noise(clean, acquisition.noise(), seed=1)
    grid = recon.VolumeGrid.of(noisy, 40)
    joint = recon.reconstruct(noisy, grid, method="joint")
    tried = dict(sorted(joint.weights_tried.items()))
    errors = {}
    for weight in joint.weight * 2.0 ** np.arange(-2, 3):
        fitted = recon.reconstruct(
            noisy, grid, method="joint-supervised", noise_model=joint.noise_model, weight=float(weight), num_steps=100
        )
        errors[float(weight)] = recon.compare(fitted.volume.attenuation, truth * unit).psnr
    figure, axes = new_figure(2, width=10, height=3.6)
    axes[0, 0].plot(tried.keys(), tried.values(), "o-", color=BLUE)
    axes[0, 0].set(ylabel="held-out NLL (nats per pixel)", title="what the choice sees")
    axes[0, 1].plot(errors.keys(), errors.values(), "o-", color=ORANGE)
    axes[0, 1].set(ylabel="PSNR of the volume (dB)", title="what only the truth shows")
    for axis, weights in zip(axes[0], (tried, errors), strict=True):
        axis.axvline(joint.weight, color="black", lw=1, ls="--", label=f"chosen: {joint.weight:.2g}")
        axis.set(xscale="log", xlabel="weight of total variation (nats)")
        axis.set_xticks(list(weights), [f"{weight:.2g}" for weight in weights])
        axis.minorticks_off()
        axis.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(draw)
