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


def block_compressed(frame: Image) -> bool:
    """Whether a frame went through a block compression such as JPEG's.

    A compressor rounds the coefficients of its own blocks, fine ones to zero. On every other raster of blocks they spread again.

    Args:
        frame: (y, x) pixel values.
    """
    from scipy.fft import dctn

    part = frame[:MOST, :MOST]
    shares = np.empty((SIDE, SIDE))
    for dy in range(SIDE):
        for dx in range(SIDE):
            rows, columns = ((size - shift) // SIDE for size, shift in zip(part.shape, (dy, dx), strict=True))
            blocks = part[dy : dy + rows * SIDE, dx : dx + columns * SIDE].reshape(rows, SIDE, columns, SIDE)
            fine = dctn(blocks, axes=(1, 3), norm="ortho")[:, SIDE // 2 :, :, SIDE // 2 :]
            spread = np.median(np.abs(fine), axis=(0, 2), keepdims=True)
            typical = np.sqrt(np.mean(fine**2, axis=(0, 2), keepdims=True))
            shares[dy, dx] = float(np.mean(spread / np.maximum(typical, np.finfo(float).tiny)))
    middle = np.median(shares)
    scatter = 1.4826 * np.median(np.abs(shares - middle))
    return bool(np.abs(shares - middle).max() > CLEAR * max(float(scatter), np.finfo(float).tiny))
