"""What the images still share with each other after the volume's projections are taken away."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.series.first_guess import contrast_slab
from recon.series.tilt_series import TiltSeries

Array = NDArray[Any]
_MOST_PIXELS = (
    4_000_000  # of a large series, the slices of most contrast: more pixels only sharpen what is sharp already
)


@dataclass(frozen=True)
class Residuals:
    """Images and projections of the slices of most contrast, in order of the tilt angle.

    Attributes:
        images, projections: (tilt, y, u) detector units, and their difference `residual`, zero where masked.
        tilt_angles: (tilt,) degrees, ascending.
        height: (y,) pixels from the middle of the whole images.
    """

    images: Array
    projections: Array
    residual: Array
    tilt_angles: Array
    height: Array

    @classmethod
    def of(cls, tilt_series: TiltSeries, projections: Array | Callable[[slice], Array]) -> Residuals:
        """The residuals of a series under the projections of its volume, (tilt, y, u), or what gives those of some rows."""
        count, height, width = tilt_series.images.shape
        rows = contrast_slab(tilt_series, max(8, _MOST_PIXELS // (count * width)))
        order = np.argsort(tilt_series.tilt_angles, kind="stable")
        images = tilt_series.images[order, rows].astype(np.float32)
        of_rows = projections(rows) if callable(projections) else projections[:, rows]
        predicted = np.asarray(of_rows[order], dtype=np.float32)
        residual = images - predicted
        if tilt_series.mask is not None:
            residual = np.where(tilt_series.mask[order, rows], residual, np.float32(0))
        position = np.arange(height, dtype=np.float32)[rows] - (height - 1) / 2
        return cls(images, predicted, residual, tilt_series.tilt_angles[order], position)

    @property
    def contrast(self) -> float:
        """Standard deviation of the projections."""
        return float(self.projections.std())

    @property
    def noise(self) -> float:
        """Standard deviation of the residual."""
        return float(self.residual.std())

    def unexplained(self) -> tuple[float, float]:
        """Power that residuals share with their neighbours, over that of the images, and its standard error by chance.

        White noise shares none. The larger of both directions counts: what is broken from row to row shows along u alone.
        """
        flat = self.images - self.images.mean()
        power, chance = float(np.mean(self.residual**2)), np.sqrt(self.residual.size)
        found = []
        for axis in (1, 2):
            whole = max(neighbours(flat, axis), float(np.mean(flat**2)) / chance, 1e-30)
            found.append((float(neighbours(self.residual, axis) / whole), float(power / chance / whole)))
        return max(found)

    def whiteness(self) -> dict[str, float]:
        """Correlation of neighbouring residuals along y, along u, and from tilt to tilt."""
        power = max(float(np.mean(self.residual**2)), 1e-30)
        r = self.residual
        along = {"y": r[:, 1:] * r[:, :-1], "u": r[:, :, 1:] * r[:, :, :-1], "tilt": r[1:] * r[:-1]}
        return {name: float(product.mean()) / power if product.size else 0.0 for name, product in along.items()}


def neighbours(images: Array, axis: int) -> float:
    """Mean product of neighbouring pixels of (tilt, y, u) images along an axis; zero where there is one pixel alone."""
    along = np.moveaxis(images, axis, 0)
    return float(np.mean(along[1:] * along[:-1])) if len(along) > 1 else 0.0
