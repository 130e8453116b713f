"""Binned tilt series as line integrals, for fast consistency tests."""

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
WIDTH = 32  # width of the coarse images; each test then takes milliseconds
_MOST_TILTS = 90  # of more tilts, every second, third … is used; neighbours add no information at this width
_LEAST_SHARE = 0.02  # of the incident intensity: darker values are clipped to it


@dataclass(frozen=True)
class Coarse:
    """Line integrals of a coarse series.

    Attributes:
        images: (tilt, y, u) line integrals, in coarse voxels.
        tilt_angles: (tilt,) degrees.
        tilts: (tilt,) indices of these tilts in the whole series.
        binning: binning factor.
        depth, width: coarse voxels.
        detector_offset: offset due to incomplete bins at the far edge, coarse pixels.
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
        """Indices of tilts sorted by angle."""
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
    """Images (tilt, y, u), binned and converted to line integrals with the estimated response of the series."""
    response = estimate_response(replace(tilt_series, mask=None))
    return inverted(response, block_means(images, binning, binning))


def inverted(response: Transmission | Linear, images: Array) -> Array:
    """Line integrals of coarse images; dark values are clipped, so that noise does not become infinite."""
    given = torch.from_numpy(np.asarray(images, dtype=np.float32))
    with torch.no_grad():
        if isinstance(response, Transmission):
            floor = _LEAST_SHARE * response.intensity.reshape(-1, 1, 1)
            given = torch.maximum(given, floor.expand(given.shape))
        return np.asarray(response.invert(given).double().numpy())
