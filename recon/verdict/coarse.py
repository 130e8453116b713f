"""A tilt series averaged over squares of pixels, as line integrals: small enough for every test of consistency."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon.projection.image_formation import Linear, Transmission
from recon.series.first_guess import estimate_response
from recon.series.tilt_series import TiltSeries, VolumeGrid, block_means

Array = NDArray[Any]
WIDTH = 32  # of the coarse images: each further test then takes milliseconds
_MOST_TILTS = 90  # of more, every second, third … is taken: neighbours add nothing at this width
_LEAST_SHARE = 0.02  # of the incident intensity: what is darker counts as that dark


@dataclass(frozen=True)
class Coarse:
    """Line integrals of a coarse series.

    Attributes:
        images: (tilt, y, u) line integrals, in coarse voxels.
        tilt_angles: (tilt,) degrees.
        tilts: (tilt,) where these tilts stand in the whole series.
        binning: pixels along each side of a coarse one.
        depth, width: coarse voxels.
        detector_offset: coarse pixels, of what does not fill a square at the far edge.
    """

    images: Array
    tilt_angles: Array
    tilts: Array
    binning: int
    depth: int
    width: int
    detector_offset: float

    @property
    def order(self) -> Array:
        """Tilts by angle."""
        return np.argsort(self.tilt_angles, kind="stable")


def coarse_series(tilt_series: TiltSeries, grid: VolumeGrid, *, width: int = WIDTH) -> Coarse:
    """The series as line integrals, at most `width` pixels wide and `_MOST_TILTS` tilts long."""
    stride = -(-tilt_series.num_tilts // _MOST_TILTS)
    tilts = np.argsort(tilt_series.tilt_angles, kind="stable")[::stride]
    some = tilt_series.select(np.sort(tilts))
    binning = -(-tilt_series.images.shape[2] // width)
    binning = max(1, min(binning, tilt_series.images.shape[1]))
    images = line_integrals(some, some.images, binning)
    return Coarse(
        images,
        some.tilt_angles,
        np.sort(tilts),
        binning,
        max(1, -(-grid.depth // binning)),
        max(1, -(-grid.width // binning)),
        -(some.images.shape[2] % binning) / 2 / binning,
    )


def line_integrals(tilt_series: TiltSeries, images: Array, binning: int) -> Array:
    """Images of the kind of a series, (tilt, y, u), binned and inverted by the response that the series shows."""
    response = estimate_response(replace(tilt_series, mask=None))
    return inverted(response, block_means(images, binning, binning))


def inverted(response: Transmission | Linear, images: Array) -> Array:
    """Line integrals of coarse images; dark ones are bounded, for noise must not become infinite."""
    given = torch.from_numpy(np.asarray(images, dtype=np.float32))
    with torch.no_grad():
        if isinstance(response, Transmission):
            floor = _LEAST_SHARE * response.intensity.reshape(-1, 1, 1)
            given = torch.maximum(given, floor.expand(given.shape))
        return np.asarray(response.invert(given).double().numpy())
