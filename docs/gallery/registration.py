"""
Registration
============

A short exposure, a long exposure of the same scene that was rotated and shifted, and their difference after registration.

.. image:: /images/gallery/registration.png
   :alt: A short exposure, a long exposure turned by 2°, and their difference after registration
"""

# sphinx_gallery_thumbnail_path = "images/gallery/registration.png"

import numpy as np
from drawing import DATA, main, new_figure, show
from skimage.transform import EuclideanTransform, warp

import calibration
import noiseflow

# %%
# The long exposure is rotated by 2° and shifted on purpose. ``align_pair`` finds both again.


def draw():
    folder = DATA / "exposures_miro"
    short, long = (noiseflow.io.read_image(folder / f"channel1_{name}.tif").astype(float) for name in ("050ms", "long"))
    moved = warp(long, EuclideanTransform(rotation=np.deg2rad(2), translation=(9, -6)), mode="edge")
    pair = calibration.ExposurePair(short, moved)
    aligned = calibration.align_pair(pair)
    registration, bar = aligned.registration, (20, "20 pixels")
    part = (slice(230, 310), slice(60, 140))
    turn = np.rad2deg(np.arctan2(registration.matrix[1, 0], registration.matrix[0, 0]))
    residual = np.where(aligned.mask, aligned.short - aligned.signal, 0)
    figure, axes = new_figure(3, width=12, height=3.6)
    show(axes[0, 0], short[part], "short exposure", bar=bar, unit="counts", vmax=np.quantile(short, 0.995))
    show(axes[0, 1], moved[part], "long exposure, turned by 2°", bar=bar, unit="counts", vmax=np.quantile(moved, 0.995))
    title = f"short − aligned long: found {abs(turn):.2f}° ± {registration.error_px:.2f} px"
    show(axes[0, 2], residual[part], title, bar=bar, unit="counts", cmap="PuOr", vmin=-60, vmax=60)
    return figure


if __name__ == "__main__":
    main(draw)
