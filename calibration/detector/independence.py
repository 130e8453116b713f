"""Tests for shared noise: correlated successive frames, and long exposures that contain the short one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.detector.residual import residual_of
from calibration.exposures.frames import Burst, Image
from calibration.exposures.scaling import BLOCK, Mask, eroded, finest_band, separable
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import CLEAR


def correlation_in_time(pairs: Sequence[AlignedPair], *, most: int = 24) -> tuple[float, float]:
    """Correlation of the noise of successive frames of a burst, minus that of more distant frames, and its standard error.

    At `most` so many frames are compared: 23 successive pairs with 256² pixels each determine a correlation well below 1 %.

    Image lag, recursive filters and running means correlate successive frames. This reduces the variance of their differences,
    by twice the correlation if the next frame loses what the filter keeps of the previous one.
    """
    if pairs[0].frames == 1:
        return 0.0, 0.0
    chosen = pairs[:most]
    mask = np.logical_and.reduce([pair.mask for pair in chosen])
    z = np.stack([residual_of(pair).z[mask] for pair in chosen])
    # residuals from the mean of the others have a larger variance by 1/(1 − 1/n)
    return _of_successive([np.sqrt(1 - 1 / len(pairs)) * z])


def correlation_of_flats(bursts: Sequence[Burst], *, most: int = 24) -> tuple[float, float]:
    """The same for frames without a scene, all levels together; 0 if every level has only two frames."""
    standardised = []
    for burst in bursts:
        frames = burst.frames[:most].reshape(-1, burst.frames[0].size)
        residual = frames - frames.mean(axis=1, keepdims=True)
        residual = residual - residual.mean(axis=0)
        deviation = float(residual.std()) * np.sqrt(len(frames) / (len(frames) - 1))
        standardised.append(np.clip(residual / max(deviation, np.finfo(float).tiny), -CLEAR, CLEAR))
    return _of_successive(standardised)


def _of_successive(bursts: Sequence[Image]) -> tuple[float, float]:
    """Mean product of successive frames minus that of distant frames, for (frame, pixel) residuals of unit variance."""
    excess = information = 0.0
    for z in bursts:
        if len(z) < 3 or not z.shape[1]:
            continue
        products = z @ z.T / z.shape[1]
        first, second = np.triu_indices(len(z), 1)
        near = second - first == 1
        weight = z.shape[1] / (1 / near.sum() + 1 / (~near).sum())
        excess += weight * float(products[first, second][near].mean() - products[first, second][~near].mean())
        information += weight
    return (excess / information, float(1 / np.sqrt(information))) if information else (0.0, 0.0)


def contained_share(pair: AlignedPair, *, least: float = 0.75, white: float = 1.3, alike: float = 1.5) -> float:
    """Share of the signal that is the short exposure itself; 0 if not significant.

    The share is positive if the long exposure is a mean or sum of frames that include the short one. The finest detail common to
    both exposures is then white, and includes all noise of the long one. Detail of a scene is not white because of the optics,
    and the long exposure has additional noise.

    Args:
        pair: aligned pair.
        least: smallest share of the long exposure's finest noise in common with the short exposure. It is 1 if it contains that
            exposure, and 0 for separate exposures.
        white: largest ratio of the powers of two frequency bands of white noise; images have several times as much along one
            axis.
        alike: largest ratio of equal shares in bright and dim pixels; that of fixed patterns to shot noise depends on the signal.
    """
    if pair.frames > 1 or pair.registration.interpolates(pair.long.shape):  # a contained frame needs no warping
        return 0.0
    inner = eroded(pair.mask, 2)
    inner &= np.abs(pair.short - pair.signal) < CLEAR * np.std((pair.short - pair.signal)[pair.mask])
    if not inner.any():
        return 0.0
    short, signal = finest_band(pair.short), finest_band(pair.signal)
    middle = np.median(pair.signal[inner])
    shares = []
    for part in (inner, inner & (pair.signal > middle), inner & (pair.signal <= middle)):
        common, error = _mean_and_error(short * signal, part)
        if not (common > CLEAR * error and common > least * float(np.mean(signal[part] ** 2))):
            return 0.0
        shares.append(common / float(np.mean(short[part] ** 2)))
    common = float(np.mean((short * signal)[inner]))
    along = 0.5 * sum(
        float(np.mean((_fourth_difference(pair.short, axis) * _fourth_difference(pair.signal, axis))[inner]))
        for axis in (0, 1)
    )
    equal = max(shares[1], shares[2]) < alike * min(shares[1], shares[2])
    return shares[0] if equal and along < white * common else 0.0


def _fourth_difference(image: Image, axis: int) -> Image:
    """Fourth difference along one axis, which removes smooth detail; unit gain for white noise."""
    kernel = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70)
    return separable(image, *((kernel, np.ones(1)) if axis == 0 else (np.ones(1), kernel)))


def _mean_and_error(values: Image, mask: Mask) -> tuple[float, float]:
    """Mean over the mask, and its standard error from the scatter between blocks."""
    row, column = np.indices(mask.shape) // BLOCK
    block = (row * (column.max() + 1) + column)[mask]
    middle = float(values[mask].mean())
    sums = np.bincount(block, values[mask] - middle)
    return middle, float(np.sqrt(np.sum(sums**2)) / mask.sum())
