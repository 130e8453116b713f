"""Photon transfer: how the scatter of readings grows with their signal, level by level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.detector.levels import Levels
from calibration.exposures.frames import Image
from calibration.exposures.scaling import fit_line
from noiseflow.described import described


class NotMeasurable(ValueError):
    """The exposures cannot tell the detector's gain, though a noise model can still be fitted."""


@described(
    signal="counts", variance="counts²", variance_error="counts²", gain="counts per electron", intercept="counts²"
)
@dataclass(frozen=True)
class PhotonTransfer:
    """The straight line of variance against signal: ``variance = gain·signal + intercept``
    (doi:10.1109/TIP.2008.2001399).

    Attributes:
        signal: (L,) counts.
        variance: (L,) of the exposure alone, counts².
        variance_error: (L,) standard error.
        clipped: (L,) share of the readings at a rail; levels with any are left out of the line where others suffice.
        gain: counts per electron.
        intercept: counts²; (gain·read noise)² − gain·offset.
    """

    signal: Image
    variance: Image
    variance_error: Image
    clipped: Image
    gain: float
    intercept: float


def fit_photon_transfer(levels: Sequence[Levels]) -> PhotonTransfer:
    """Fit the line of variance against signal.

    Raises:
        NotMeasurable: the variance does not grow with the signal, so that no gain shows.
    """
    signal, variance, error, clipped = (
        np.concatenate(column) for column in zip(*(_points(one) for one in levels), strict=True)
    )
    free = clipped < 1e-3
    if free.sum() < 3:
        free = np.ones_like(free)
    line = fit_line(signal[free], variance[free])
    if not line.rate > 0:
        raise NotMeasurable(
            "the noise does not grow with the signal, so the gain cannot be measured; give exposures with more "
            "contrast, or flat frames at several levels"
        )
    return PhotonTransfer(signal, variance, error, clipped, line.rate, line.floor)


def _points(levels: Levels) -> tuple[Image, Image, Image, Image]:
    rounding = levels.step**2 / (12 if levels.absolute else 6)  # residuals are dithered too
    variance = (levels.variance - rounding) / (1 + levels.shot_share)
    error = variance * np.sqrt(2 / np.maximum(levels.count * levels.weight, 1))
    return levels.signal, variance, error, levels.clipped()
