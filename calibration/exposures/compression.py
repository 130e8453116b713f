"""Image compression: coefficients that gather at few values on the compressor's own raster, and on no other.

JPEG and its successors round cosine coefficients of 8 × 8 blocks; JPEG 2000 rounds coefficients of wavelets.
"""

from __future__ import annotations

import numpy as np

from calibration.exposures.frames import Image
from noiseflow.models.digitisation import detect_digitisation

SIDE = 8
"""Pixels of a block's side in JPEG and its successors."""

MOST = 512
"""Pixels of the frame's side that are looked at."""

CLEAR = 8.0
"""Standard deviations among the 64 rasters by which the compressed one stands out; among 63 equal ones 4 occurs by chance."""


CLEAR_LOSS = 5.0
"""The same for their power, where one raster must also lose `LEAST_LOSS`."""

LEAST_LOSS = 0.1
"""Power, in nats, that the fine coefficients of the compressed raster lack. That of noise in the thousand blocks of 256² pixels
differs by 0.01 between rasters; a compressor that leaves only rounding takes 1.5, one that keeps more moves no gain by 2 %."""

LIFTING = ((-1 / 2, 1 / 4), (-1.586134342, -0.052980118, 0.882911075, 0.443506852))
"""Lifting steps of the two wavelets of JPEG 2000 (ITU-T T.800, annex F): 5/3 and 9/7."""

CLEAR_LATTICE = 40.0
"""Power, N·|mean of exp(2πi·coefficient/step)|², at which wavelet coefficients are multiples of a step: 20 000 frequencies, bands
and rasters together exceed it by chance once in 10¹³ frames."""

ALONE = 4.0
"""By which the compressor's raster exceeds another. Values that are multiples of a step themselves show on all four alike. After
strong compression, which leaves few coefficients, two others resemble the compressor's."""


def block_compressed(frame: Image) -> bool:
    """Whether a frame went through a block compression such as JPEG's.

    A compressor rounds the coefficients of its own blocks, fine ones to zero. On every other raster of blocks they spread again.
    Where all of them are zero, rounding of the pixel values is left there, and the edges of the blocks on the others.

    Args:
        frame: (y, x) pixel values.
    """
    from scipy.fft import dctn

    part = frame[:MOST, :MOST]
    shares, power = np.empty((2, SIDE, SIDE))
    for dy in range(SIDE):
        for dx in range(SIDE):
            rows, columns = ((size - shift) // SIDE for size, shift in zip(part.shape, (dy, dx), strict=True))
            blocks = part[dy : dy + rows * SIDE, dx : dx + columns * SIDE].reshape(rows, SIDE, columns, SIDE)
            fine = dctn(blocks, axes=(1, 3), norm="ortho")[:, SIDE // 2 :, :, SIDE // 2 :]
            spread = np.median(np.abs(fine), axis=(0, 2), keepdims=True)
            squares = np.maximum(np.mean(fine**2, axis=(0, 2), keepdims=True), np.finfo(float).tiny)
            shares[dy, dx] = float(np.mean(spread / np.sqrt(squares)))
            power[dy, dx] = float(np.mean(np.log(squares)))
    share, loss = _deviations(shares), _deviations(power)
    least = np.argmin(power)
    lost = float(np.median(power) - power.min()) > LEAST_LOSS and loss.flat[least] < -CLEAR_LOSS
    return bool(np.abs(share).max() > CLEAR or lost)


def wavelet_compressed(frame: Image) -> bool:
    """Whether a frame went through a lossy wavelet compression, that of JPEG 2000, or has every second pixel from its neighbours.

    The compressor rounds wavelet coefficients to multiples of a step. On its own raster, one of four, they still are.

    Args:
        frame: (y, x) pixel values.
    """
    part = frame[:MOST, :MOST] / (detect_digitisation(frame).step or 1.0)
    power = [
        max(_lattice(band) for steps in LIFTING for band in _finest_bands(part[dy:, dx:], steps))
        for dy in (0, 1)
        for dx in (0, 1)
    ]
    return max(power) > CLEAR_LATTICE and max(power) > ALONE * min(power)


def _lattice(values: Image) -> float:
    """The largest power of exp(2πi·value/step) over steps from 3 rounding steps to a standard deviation of the values."""
    values = values.ravel() - np.median(values)
    deviation = float(np.diff(np.percentile(values, (15.87, 84.13)))[0]) / 2
    inner = values[np.abs(values) < 8 * max(deviation, 4.0)]
    index = np.round(2 * inner).astype(int)
    density = np.fft.rfft(np.bincount(index - index.min(), minlength=1 << 12))
    frequency = 2 * np.arange(len(density)) / (2 * len(density) - 2)
    tried = (frequency > 0.8 / max(deviation, 4.0)) & (frequency < 1 / 3)
    return float(np.max(np.abs(density[tried]) ** 2, initial=0.0)) / len(inner)


def _finest_bands(image: Image, steps: tuple[float, ...]) -> tuple[Image, Image, Image]:
    """The wavelet coefficients of the finest level: high frequencies along y, along x, and along both."""
    low, high = _split(image, steps, 1)
    (_, along_y), (along_x, both) = _split(low, steps, 0), _split(high, steps, 0)
    return along_y, along_x, both


def _split(image: Image, steps: tuple[float, ...], axis: int) -> tuple[Image, Image]:
    """Low and high frequencies along an axis, by lifting: odd samples less their prediction by even ones, and in turn."""
    image = np.moveaxis(image, axis, 0)
    image = image[: len(image) // 2 * 2]
    low, high = image[::2].copy(), image[1::2].copy()
    for number, step in enumerate(steps):
        if number % 2:
            low += step * (high + np.concatenate([high[:1], high[:-1]]))
        else:
            high += step * (low + np.concatenate([low[1:], low[-1:]]))
    return np.moveaxis(low, 0, axis), np.moveaxis(high, 0, axis)


def _deviations(values: Image) -> Image:
    """Distance from the median in robust standard deviations."""
    middle = np.median(values)
    scatter = 1.4826 * float(np.median(np.abs(values - middle)))
    return np.asarray((values - middle) / max(scatter, np.finfo(float).tiny))
