"""Do frames share noise? Bursts whose frames follow one another, and long exposures that contain the short one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from calibration.detector.residual import residual_of
from calibration.exposures.frames import Burst, Image
from calibration.exposures.scaling import BLOCK, finest_band
from calibration.registration.aligned import AlignedPair

CLEAR = 5.0
"""Standard errors beyond which frames share noise: a test or two of a calibration reach them by chance once in 10⁶."""

LEAST_FRAMES = 3
"""Of a burst, from which on some frames follow one another and others do not."""

MOST_FRAMES = 24
"""Frames that are compared: 23 that follow one another tell a correlation of 1 % in 256 pixels each to five standard errors."""

WHITE = 1.3
"""Ratio of the power of two bands that noise of independent pixels fills alike, below which what fills them is such noise. Optics
leave several times as much detail at the frequencies along one axis as at those along both."""

LEVEL = 1.5
"""Ratio of the shares found in the bright and in the dim half of the pixels, up to which it is one share. Patterns of the pixels'
sensitivities and offsets are white detail too, but over the variance of shot noise they grow, or fade, as the signal does."""

LEAST_COMMON = 0.75
"""Share of the long exposure's finest noise that must be the short exposure's for it to contain that exposure: then all of it is,
while of two separate exposures none is."""


def correlation_in_time(pairs: Sequence[AlignedPair]) -> float:
    """Correlation of the noise of successive frames of a burst, beyond that of frames further apart; 0 where none shows.

    Image lag, recursive filters and running means make frames follow one another. Their differences then have less than the
    variance of two frames: by twice the correlation, if what is kept of one frame is taken from the next.
    """
    if pairs[0].frames == 1:
        return 0.0
    chosen = pairs[:MOST_FRAMES]
    mask = np.logical_and.reduce([pair.mask for pair in chosen])
    z = np.stack([residual_of(pair).z[mask] for pair in chosen])
    return _of_successive(
        [np.sqrt(1 - 1 / len(pairs)) * z]
    )  # residuals from the mean of the others scatter more by that


def correlation_of_flats(bursts: Sequence[Burst]) -> float:
    """The same of frames without a scene, all levels together; 0 also where every level has two frames."""
    standardised = []
    for burst in bursts:
        frames = burst.frames[:MOST_FRAMES].reshape(-1, burst.frames[0].size)
        residual = frames - frames.mean(axis=1, keepdims=True)
        residual = residual - residual.mean(axis=0)
        deviation = float(residual.std()) * np.sqrt(len(frames) / (len(frames) - 1))
        standardised.append(np.clip(residual / max(deviation, np.finfo(float).tiny), -CLEAR, CLEAR))
    return _of_successive(standardised)


def _of_successive(bursts: Sequence[Image]) -> float:
    """Mean product of successive frames less that of frames further apart, of (frame, pixel) residuals of unit variance."""
    excess = information = 0.0
    for z in bursts:
        if len(z) < LEAST_FRAMES or not z.shape[1]:
            continue
        products = z @ z.T / z.shape[1]
        first, second = np.triu_indices(len(z), 1)
        near = second - first == 1
        weight = z.shape[1] / (1 / near.sum() + 1 / (~near).sum())
        excess += weight * float(products[first, second][near].mean() - products[first, second][~near].mean())
        information += weight
    found = excess / information if information else 0.0
    return found if abs(found) * np.sqrt(information) > CLEAR else 0.0


def contained_share(pair: AlignedPair) -> float:
    """Share of the signal that is the short exposure itself, as where the long one is a mean or sum of frames with the short one
    among them; 0 where none shows.

    The finest detail that both exposures show is then white noise, and all the noise that the long one has. Detail of a scene
    is not white, for optics blur it, and leaves the long exposure a noise of its own.
    """
    if pair.frames > 1 or pair.registration.warp(pair.long)[0] is not pair.long:  # the same frame lies on itself
        return 0.0
    inner = np.asarray(ndimage.binary_erosion(pair.mask, np.ones((5, 5)), border_value=0))
    inner &= np.abs(pair.short - pair.signal) < CLEAR * np.std((pair.short - pair.signal)[pair.mask])
    if not inner.any():
        return 0.0
    short, signal = finest_band(pair.short), finest_band(pair.signal)
    middle = np.median(pair.signal[inner])
    shares = []
    for part in (inner, inner & (pair.signal > middle), inner & (pair.signal <= middle)):
        common, error = _mean_and_error(short * signal, part)
        if not (common > CLEAR * error and common > LEAST_COMMON * float(np.mean(signal[part] ** 2))):
            return 0.0
        shares.append(common / float(np.mean(short[part] ** 2)))
    common = float(np.mean((short * signal)[inner]))
    along = 0.5 * sum(
        float(np.mean((_fourth_difference(pair.short, axis) * _fourth_difference(pair.signal, axis))[inner]))
        for axis in (0, 1)
    )
    alike = max(shares[1], shares[2]) < LEVEL * min(shares[1], shares[2])
    return shares[0] if alike and along < WHITE * common else 0.0


def _fourth_difference(image: Image, axis: int) -> Image:
    """Blind to detail that is smooth along one axis; of unit gain for white noise."""
    kernel = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70)
    return np.asarray(ndimage.convolve1d(image, kernel, axis=axis))


def _mean_and_error(values: Image, mask: Image) -> tuple[float, float]:
    """Mean over the mask, and its standard error from the scatter between blocks."""
    row, column = np.indices(mask.shape) // BLOCK
    block = (row * (column.max() + 1) + column)[mask]
    middle = float(values[mask].mean())
    sums = np.bincount(block, values[mask] - middle)
    return middle, float(np.sqrt(np.sum(sums**2)) / mask.sum())
