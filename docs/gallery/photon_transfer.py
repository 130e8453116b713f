"""
Photon transfer
===============

The photon-transfer curve of a real sCMOS camera: variance against signal. Its slope is the gain.

.. image:: /images/gallery/photon_transfer.png
   :alt: Variance against signal of a real camera, with a straight line

The gain is about 15 % above that of the maps published with these frames; see the page *Limits* of the guide.
"""

# sphinx_gallery_thumbnail_path = "images/gallery/photon_transfer.png"

import numpy as np
from drawing import BLUE, DATA, ORANGE, main, new_figure

import calibration

# %%
# One pair of exposures is enough: the long exposure gives the signal, the short exposure gives the variance.


def draw():
    folder = DATA / "exposures_miro"
    (pair,) = calibration.read_pairs([folder / "channel1_050ms.tif"], [folder / "channel1_long.tif"])
    line = calibration.measure_detector([calibration.align_pair(pair)]).line
    figure, axes = new_figure(width=6, height=4)
    axis = axes[0, 0]
    axis.errorbar(line.signal, line.variance, line.variance_error, fmt="o", color=BLUE, label="pixels of equal signal")
    signal = np.linspace(line.signal.min(), line.signal.max())
    label = f"gain {line.gain:.2f} ± {line.gain_error:.2f} counts per electron"
    axis.plot(signal, line.gain * signal + line.intercept, color=ORANGE, label=label)
    axis.set(xlabel="signal (counts)", ylabel="variance (counts²)", title="photon transfer, 50 ms exposure")
    axis.legend()
    return figure


if __name__ == "__main__":
    main(draw)
