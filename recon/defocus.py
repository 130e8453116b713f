"""Blur of tilted images away from the tilt axis, where the specimen leaves the plane of focus."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_REACH = 4.0  # standard deviations at which a kernel ends


def defocus_widths(width: int, tilt_angle: float, strength: float) -> NDArray[np.float64]:
    """Standard deviation of the blur in each column: strength · |tan(tilt)| · distance from the tilt axis.

    As in Kniesel et al. (CVPR 2022, doi:10.1109/CVPR52688.2022.02018, suppl. eq. 1), the blur depends on the place in the
    image, not on the depth in the specimen: it holds where the specimen is thin against its width.

    Args:
        width: of the image, pixels.
        tilt_angle: degrees.
        strength: pixels of blur per pixel out of the plane of focus: the beam's half angle, radians.

    Returns:
        (width,) pixels.

    Raises:
        ValueError: a negative strength.
    """
    if not 0 <= strength < math.inf:
        raise ValueError(f"defocus {strength} must be zero or more, pixels of blur per pixel out of focus")
    distance = np.abs(np.arange(width) - (width - 1) / 2)
    return np.asarray(strength * abs(math.tan(math.radians(tilt_angle))) * distance)


def defocused(image: NDArray[Any], tilt_angle: float, strength: float) -> NDArray[np.float32]:
    """An image (y, u) with every pixel averaged over the Gaussian of its column's `defocus_widths`; mirrored at the edges.

    Blurs below a quarter of a pixel are left out.

    Args:
        image: (y, u), tilt axis along y at the middle of u.
        tilt_angle: degrees.
        strength: see `defocus_widths`.
    """
    result = np.array(image, dtype=np.float32)
    for column, deviation in enumerate(defocus_widths(image.shape[1], tilt_angle, strength)):
        if deviation >= 0.25:
            reach = math.ceil(_REACH * deviation)
            weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
            weights /= weights.sum()
            across = image[:, _mirrored(column, reach, image.shape[1])] @ weights
            rows = np.pad(across, reach, mode="symmetric")
            result[:, column] = np.convolve(rows, weights, mode="valid")
    return result


def _mirrored(centre: int, reach: int, size: int) -> NDArray[np.intp]:
    """Indices from centre − reach to centre + reach, mirrored into 0 … size − 1."""
    place = np.arange(centre - reach, centre + reach + 1) % (2 * size)
    return np.minimum(place, 2 * size - 1 - place)
