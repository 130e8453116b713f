"""Residuals of the projections of a volume, and their correlations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noiseflow.statistics import neighbour_products
from recon.series.first_guess import contrast_slab
from recon.series.tilt_series import TiltSeries

Array = NDArray[Any]
_MOST_PIXELS = 4_000_000  # of a large series, only the slices with the highest contrast are used


@dataclass(frozen=True)
class Residuals:
    """Images and projections of the slices with the highest contrast, sorted by tilt angle.

    Attributes:
        images, projections: (tilt, y, u) detector units, equal where masked; their difference is `residual`.
        used: (tilt, y, u) True for pixels to use.
        tilt_angles: (tilt,) degrees, ascending.
        height: (y,) pixels from the centre of the whole images.
    """

    images: Array
    projections: Array
    residual: Array
    used: Array
    tilt_angles: Array
    height: Array

    @classmethod
    def of(cls, tilt_series: TiltSeries, projections: Array | Callable[[slice], Array]) -> Residuals:
        """The residuals of a series, from projections (tilt, y, u) of its volume, or a function that returns some rows."""
        count, height, width = tilt_series.images.shape
        rows = contrast_slab(tilt_series, max(8, _MOST_PIXELS // (count * width)))
        order = np.argsort(tilt_series.tilt_angles, kind="stable")
        images = tilt_series.images[order, rows].astype(np.float32)
        of_rows = projections(rows) if callable(projections) else projections[:, rows]
        predicted = np.asarray(of_rows[order], dtype=np.float32)
        used = np.ones(images.shape, np.bool_) if tilt_series.mask is None else tilt_series.mask[order, rows]
        images = np.where(used, images, predicted)
        position = np.arange(height, dtype=np.float32)[rows] - (height - 1) / 2
        return cls(images, predicted, images - predicted, used, tilt_series.tilt_angles[order], position)

    @property
    def contrast(self) -> float:
        """Standard deviation of the projections."""
        return float(self.projections[self.used].std())

    def shared(self) -> float:
        """Largest mean product of neighbouring residuals, along y, u or the tilts, relative to the variance of the projections.

        Misfit of volume and alignment is shared, independent noise is not; a correlation alone would not say how large it is.
        """
        products = (neighbours(self.residual, axis) for axis in (0, 1, 2))
        return max(map(abs, products)) / max(self.contrast**2, 1e-30)


def neighbours(images: Array, axis: int) -> float:
    """Mean product of neighbouring pixels of (tilt, y, u) images along an axis; zero if the axis has one pixel."""
    products = neighbour_products(images, axis=axis)
    return float(np.mean(products)) if products.size else 0.0
