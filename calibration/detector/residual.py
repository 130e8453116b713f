"""Residual of the short exposure from its signal: noise, and changes between the exposures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.exposures.frames import Image
from calibration.exposures.masks import Mask
from calibration.exposures.scaling import smoothed, spread_by_level
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import CLEAR

BLUR = 1.5
"""Smoothing of a signal, pixels, which suppresses its noise."""


@dataclass(frozen=True)
class Residual:
    """Standardised residual of a pair's short exposure.

    Attributes:
        z: (..., y, x) residuals of one or several frames over the standard deviation at their level, clipped at `CLEAR`; 0
            outside the mask.
        mask: (y, x) valid pixels.
        share: share of the residual variance due to the noise of the signal.
        spread: (y, x) standard deviation at the level, counts.
        signal: (y, x) counts; None for frames without a scene.
        expected: (y, x) squares expected from each pixel's own signal, which the pixels of a mosaic do not share; None if all are
            equal.
    """

    z: Image
    mask: Mask
    share: float
    spread: Image
    signal: Image | None = None
    expected: Image | None = None


def residual_of(pair: AlignedPair) -> Residual:
    """Return the standardised residual of a pair, which is computed once."""
    known = vars(pair)
    if "_residual" not in known:
        known["_residual"] = _residual_of(pair)
    return known["_residual"]  # type: ignore[no-any-return]


def _residual_of(pair: AlignedPair, *, little: float = 0.1) -> Residual:
    share = float(pair.share[pair.mask].mean())
    # as little as the noise allows: at the same local average, a peak in the dark part of a crystal lattice is noisier than a
    # valley in the bright part
    blur = BLUR / 2 if share < little else BLUR
    difference, level = (pair.short - pair.signal)[pair.mask], smooth_signal(pair, blur=blur)[pair.mask]
    spread = np.ones(pair.mask.shape)
    spread[pair.mask] = spread_by_level(level, difference)
    z = np.zeros(pair.mask.shape)
    cut = np.clip(difference / spread[pair.mask], -CLEAR, CLEAR)
    z[pair.mask] = cut - cut.mean()  # the median of skewed noise differs from its mean, and would add a correlation
    scale = float(np.sqrt(np.mean(z[pair.mask] ** 2)))
    expected = pair.total_variance(pair.signal) / spread**2
    return Residual(z / max(scale, np.finfo(float).tiny), pair.mask, share, spread * scale, pair.signal, expected)


def smooth_signal(pair: AlignedPair, *, blur: float = BLUR) -> Image:
    """Return the (y, x) signal smoothed with a Gaussian of `blur` pixels within the mask, counts."""
    weight = smoothed(pair.mask.astype(float), blur)
    inside = smoothed(np.where(pair.mask, pair.signal, 0.0), blur)
    middle = float(pair.signal[pair.mask].mean())
    return np.asarray(np.divide(inside, weight, out=np.full(inside.shape, middle), where=weight > 0.05))
