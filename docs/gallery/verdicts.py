"""
Verdicts
========

The verdicts on a good series and on two series that were spoilt on purpose.

.. image:: /images/gallery/verdicts.png
   :alt: Slices of a good series and of two spoilt ones, each with its verdict and the reasons
"""

# sphinx_gallery_thumbnail_path = "images/gallery/verdicts.png"

import textwrap
from dataclasses import replace

import numpy as np
from drawing import GREEN, ORANGE, PINK, main, new_figure, show

import recon
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS
from recon.verdict.judge import judge

COLOURS = {"good": GREEN, "doubtful": ORANGE, "bad": PINK}

# %%
# The series is reconstructed by least squares three times: as simulated, with images shifted at random, and with
# halved tilt angles.


def draw():
    acquisition = ACQUISITIONS["gaussian"]
    truth = make_phantom("shells", 48, generator=np.random.default_rng(3))
    clean, _ = recon.clean_tilt_series(truth, np.arange(-60, 61, 3.0), acquisition=acquisition)
    sound = recon.add_noise(clean, acquisition.noise(), seed=1)
    shifts = np.rint(np.random.default_rng(0).normal(0, 3, len(sound.images))).astype(int)
    shifted = np.stack([np.roll(image, s, axis=1) for image, s in zip(sound.images, shifts, strict=True)])
    cases = {
        "sound": sound,
        "images shifted at random": replace(sound, images=shifted),
        "tilt angles halved": replace(sound, tilt_angles=sound.tilt_angles * 0.5),
    }
    figure, axes = new_figure(3, width=12, height=4.6)
    for axis, (name, series) in zip(axes[0], cases.items(), strict=True):
        result = recon.reconstruct(series, recon.VolumeGrid.of(series, 48), method="l2", num_steps=80)
        verdict = judge(series, result)
        show(
            axis,
            result.volume.attenuation[:, 24],
            f"{name}: {verdict.grade}",
            bar=(12, "12 voxels"),
            unit="attenuation",
        )
        reasons = textwrap.shorten(". ".join(verdict.reasons), 215)
        axis.set_xlabel(textwrap.fill(reasons, 46), fontsize=8, color=COLOURS[verdict.grade])
    return figure


if __name__ == "__main__":
    main(draw)
