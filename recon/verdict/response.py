"""The response of the detector, from row sums: tilting preserves the sum of a row of line integrals, but not that of squares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.checks import Effect

Array = NDArray[Any]


def bent_response(images: Array, predicted: Array) -> Effect:
    """Share of the signal that a response t − c·t² loses at the strongest contrast.

    The row sums of a tilt are those of the others, times its beam, plus its background, minus c times its sums of squares;
    standard errors are those of clusters, which are the tilts (doi:10.1080/07350015.2011.623093).

    A volume follows a part of the noise, which biases the result towards negative values; only positive ones are reported.

    Args:
        images: (tilt, y, u) line integrals.
        predicted: (tilt, y, u) line integrals of the volume, whose squares have no noise.
    """
    masses, squares = images.sum(2), (predicted**2).sum(2)
    mean = masses.mean(0)
    nuisance = np.stack([np.ones_like(mean), mean], 1)
    beside = np.eye(len(mean)) - nuisance @ np.linalg.pinv(nuisance)
    away, power = ((each - each.mean(0)) @ beside for each in (masses, squares))
    known = float((power**2).sum())
    if known <= 1e-12 * float((squares**2).sum()):
        return Effect(0.0, np.inf)
    lost = -float((power * away).sum()) / known
    left = away + lost * power
    error = float(np.sqrt(((power * left).sum(1) ** 2).sum())) / known
    strongest = float(np.quantile(predicted, 0.99))
    return Effect(max(0.0, lost * strongest), abs(error * strongest))
