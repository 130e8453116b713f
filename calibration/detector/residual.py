"""What is left of the short exposure beside its signal: noise, and whatever changed between the exposures."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from calibration.exposures.frames import Image
from calibration.registration.aligned import AlignedPair

_BLUR = 3.0
_SHRINKS = 1 / (2 * np.sqrt(np.pi) * _BLUR)
"""What is left of white noise's standard deviation."""
_LEAST_WEIGHT = 0.9


def smoothed_residual(pair: AlignedPair) -> tuple[Image, Image]:
    """The residual averaged over a Gaussian of 3 pixels, of unit variance where it is white noise, and its weight.

    Returns:
        (y, x) residual, in standard deviations of smoothed noise, zero where hardly any pixel is trusted; (y, x) weight, 0 to 1.
    """
    spread = np.sqrt(np.maximum(pair.total_variance(pair.signal), np.finfo(float).tiny))
    residual = np.where(pair.mask, (pair.short - pair.signal) / spread, 0.0)
    weight = ndimage.gaussian_filter(pair.mask.astype(float), _BLUR)
    smooth = np.zeros_like(residual)
    np.divide(ndimage.gaussian_filter(residual, _BLUR), weight, out=smooth, where=weight > 0.1)
    return smooth / _SHRINKS, weight


def structured_share(pair: AlignedPair) -> float:
    """The share of the residual's variance that is smooth over 3 pixels, which noise of independent pixels is not.

    It is what changed between the exposures, or was not registered, and passes for noise. Zero within its error where
    nothing is there; NaN where too few pixels are trusted.
    """
    smooth, weight = smoothed_residual(pair)
    inside = smooth[weight > _LEAST_WEIGHT]
    return float(np.mean(inside**2) - 1) * _SHRINKS**2 if inside.size else float("nan")
