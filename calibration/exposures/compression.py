"""Block compression: cosine coefficients of 8 × 8 blocks that gather at zero on one block raster and on no other."""

from __future__ import annotations

import numpy as np

from calibration.exposures.frames import Image

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


def _deviations(values: Image) -> Image:
    """Distance from the median in robust standard deviations."""
    middle = np.median(values)
    scatter = 1.4826 * float(np.median(np.abs(values - middle)))
    return np.asarray((values - middle) / max(scatter, np.finfo(float).tiny))
