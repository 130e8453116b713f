"""What is left of the short exposure beside its signal: noise, and whatever changed between the exposures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from calibration.exposures.frames import Image
from calibration.exposures.masks import Mask
from calibration.exposures.scaling import spread_by_level
from calibration.registration.aligned import AlignedPair

_BLUR = 3.0
_SHRINKS = 1 / (2 * np.sqrt(np.pi) * _BLUR)
"""What is left of white noise's standard deviation."""
_LEAST_WEIGHT = 0.9
_LITTLE_NOISE = 0.1
"""Share of the residual's variance that is the signal's own, below which a signal hardly tells its own errors."""
_LITTLE_BLUR, _MUCH_BLUR = 0.7, 1.5
"""Pixels over which the signal is averaged before it sorts the residuals: as few as its noise allows, for at the same average a
crest in the dark part of a crystal lattice is noisier than a valley in the bright part."""
CUT = 5.0
"""Standard deviations at which residuals are cut, so that a few defects do not speak for all pixels."""


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


@dataclass(frozen=True)
class Residual:
    """What a pair's short exposure leaves beside its signal, standardised.

    Attributes:
        z: (y, x) residual over the standard deviation at its level, cut at `CUT`, 0 outside the mask.
        mask: (y, x) pixels to trust.
        share: of the residual's variance that is the signal's own noise.
        spread: (y, x) that standard deviation, counts.
        signal: (y, x) counts; None for frames without a scene.
    """

    z: Image
    mask: Mask
    share: float
    spread: Image
    signal: Image | None = None


def residual_of(pair: AlignedPair) -> Residual:
    """The standardised residual of a pair."""
    share = float(pair.share[pair.mask].mean())
    blur = _LITTLE_BLUR if share < _LITTLE_NOISE else _MUCH_BLUR
    difference, level = (pair.short - pair.signal)[pair.mask], smooth_signal(pair, blur=blur)[pair.mask]
    spread = np.ones(pair.mask.shape)
    spread[pair.mask] = spread_by_level(level, difference)
    z = np.zeros(pair.mask.shape)
    cut = np.clip(difference / spread[pair.mask], -CUT, CUT)
    z[pair.mask] = cut - cut.mean()  # not the median, which skewed noise has off its mean: pixels would seem correlated
    scale = float(np.sqrt(np.mean(z[pair.mask] ** 2)))
    return Residual(z / max(scale, np.finfo(float).tiny), pair.mask, share, spread * scale, pair.signal)


def smooth_signal(pair: AlignedPair, *, blur: float = _MUCH_BLUR) -> Image:
    """(y, x) the signal averaged over a Gaussian of `blur` pixels within the mask, counts."""
    weight = ndimage.gaussian_filter(pair.mask.astype(float), blur)
    inside = ndimage.gaussian_filter(np.where(pair.mask, pair.signal, 0.0), blur)
    middle = float(pair.signal[pair.mask].mean())
    return np.asarray(np.divide(inside, weight, out=np.full(inside.shape, middle), where=weight > 0.05))
