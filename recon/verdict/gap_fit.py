"""Tilts left out in contiguous gaps and predicted from the others: exactly, for all gaps at once, by one linear fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from recon.projection.projector import _joseph

Array = NDArray[Any]
GAP = 12.0  # degrees: neighbours give each other away, tilts so far apart do not
_RIDGE = 0.02  # of the smoothness: keeps voxels that no ray meets determined
_FEWEST_GAPS = 4


class GapFit:
    """Least squares with a smooth prior for one geometry, and what it predicts for every gap from outside of it.

    For a linear fit y → H y, the tilts of a gap G are predicted by a fit without them with the error
    (I − H_GG)⁻¹ (y − H y)_G (the block form of Allen's PRESS, doi:10.1080/00401706.1974.10489157), so no fit is repeated. A
    constant that all pixels share is fitted too: it stands for the offset or the logarithm of the incident intensity.

    Args:
        tilt_angles: (tilt,) degrees.
        depth, width: voxels.
        detector_width: pixels along u.
        detector_offset: pixels, see `SliceProjector`.
        smoothness: weight of the squared gradient, relative to the data.
    """

    def __init__(
        self,
        tilt_angles: Array,
        *,
        depth: int,
        width: int,
        detector_width: int,
        detector_offset: float = 0.0,
        smoothness: float = 0.1,
        gap: float = GAP,
    ) -> None:
        angles = np.asarray(tilt_angles, dtype=np.float64)
        offsets = np.full(angles.shape, detector_offset)
        rays, voxels, weights = _joseph(angles, offsets, depth, width, detector_width)
        matrix = np.zeros((len(angles) * detector_width, depth * width + 1), np.float32)
        matrix[rays, voxels] = weights
        matrix[:, -1] = np.sqrt(np.mean(matrix[:, :-1].sum(1) ** 2))
        self.detector_width, self.gaps = detector_width, contiguous_gaps(angles, gap)
        normal = matrix.T @ matrix
        prior = _roughness(depth, width)
        scale = smoothness * float(np.trace(normal[:-1, :-1])) / float(prior.data[prior.row == prior.col].sum())
        normal[prior.row, prior.col] += np.float32(scale) * prior.data
        # symmetric: the transpose is in the order of LAPACK, which then copies nothing
        factor = linalg.cholesky(normal.T, lower=True, overwrite_a=True, check_finite=False)
        self.half = linalg.solve_triangular(factor, matrix.T, lower=True, overwrite_b=True, check_finite=False)
        self.inverse = [self._inverse(tilts) for tilts in self.gaps]

    def _rays(self, tilts: Array) -> Array:
        return (tilts[:, None] * self.detector_width + np.arange(self.detector_width)).ravel()

    def _inverse(self, tilts: Array) -> Array:
        part = self.half[:, self._rays(tilts)]
        return np.asarray(linalg.inv(np.eye(part.shape[1], dtype=np.float32) - part.T @ part, check_finite=False))

    def fitted(self, images: Array) -> Array:
        """What the volume of all tilts predicts, (tilt, y, u)."""
        rays = _to_rays(images)
        return _to_images(self.half.T @ (self.half @ rays), images.shape)

    def errors(self, images: Array) -> Array:
        """Images less what a volume predicts of them that has not seen their gap, (tilt, y, u)."""
        rays = _to_rays(images)
        left = rays - self.half.T @ (self.half @ rays)
        result = np.empty_like(left)
        for tilts, inverse in zip(self.gaps, self.inverse, strict=True):
            here = self._rays(tilts)
            result[here] = inverse @ left[here]
        return _to_images(result, images.shape)


def contiguous_gaps(angles: Array, degrees: float) -> list[Array]:
    """Tilts grouped by angle into runs of so many degrees, at least four runs; twins stay together."""
    values, back = np.unique(np.round(angles, 3), return_inverse=True)
    span = float(values[-1] - values[0])
    count = int(max(_FEWEST_GAPS, round(span / degrees)))
    group = np.minimum(((values - values[0]) / max(span, 1e-9) * count).astype(int), count - 1)
    return [np.flatnonzero(group[back] == number) for number in np.unique(group)]


def shared(images: Array) -> float:
    """Mean product of each pixel with its neighbour along y: the power of what neighbouring rows share, free of white noise.

    Rows are fitted apart from each other, so noise that differs from row to row adds nothing to it on average.
    """
    return float(np.mean(images[:, 1:] * images[:, :-1])) if images.shape[1] > 1 else float(np.mean(images**2))


@dataclass(frozen=True)
class Unexplained:
    """Share of what neighbouring rows share that is not predicted, and its standard error."""

    share: float
    error: float


def unexplained(images: Array, errors: Array) -> Unexplained:
    """Of the structure of images (tilt, y, u), the share that is left in the errors of their prediction.

    Where noise alone is shared, the share is of no meaning and its error far above one.
    """
    flat = images - images.mean()
    chance = float(np.mean(flat**2)) / np.sqrt(flat.size)
    whole = max(shared(flat), chance, 1e-30)
    return Unexplained(shared(errors) / whole, float(np.mean(errors**2)) / np.sqrt(errors.size) / whole)


def _roughness(depth: int, width: int) -> sparse.coo_array:
    """Squared gradient of a (depth, width) slice as a sparse matrix of distinct entries, and a little of its square."""

    def line(size: int) -> Array:
        steps = np.diff(np.eye(size), axis=0)
        return steps.T @ steps

    matrix = sparse.kron(line(depth), sparse.eye_array(width)) + sparse.kron(sparse.eye_array(depth), line(width))
    return sparse.coo_array((matrix + _RIDGE * sparse.eye_array(depth * width)).tocsr().astype(np.float32))


def _to_rays(images: Array) -> Array:
    return np.ascontiguousarray(images.transpose(0, 2, 1).reshape(-1, images.shape[1]), dtype=np.float32)


def _to_images(rays: Array, shape: tuple[int, ...]) -> Array:
    return np.asarray(rays.reshape(shape[0], shape[2], shape[1]).transpose(0, 2, 1), dtype=np.float64)
