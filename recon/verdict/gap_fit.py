"""Prediction of contiguous held-out gaps of tilts from the others, exactly for all gaps by one linear fit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from recon.projection.projector import joseph
from recon.series.holdout import GAP, Holdout
from recon.verdict.compared import neighbours

Array = NDArray[Any]
_RIDGE = 0.02  # relative to the smoothness: regularises voxels that no ray crosses
# steps of conjugate gradients; the rows of a border of a fifth then differ from the exact fit by less than a thousandth
_COMPLETIONS = 20


class GapFit:
    """Least squares with a smoothness prior for one geometry, and its leave-out prediction of every gap.

    For a linear fit y → H y, a fit without the tilts of a gap G predicts them with the error (I − H_GG)⁻¹ (y − H y)_G (the block
    form of Allen's PRESS, doi:10.1080/00401706.1974.10489157), so that no fit is repeated. A constant common to all pixels is
    also fitted: it represents the offset or the logarithm of the incident intensity.

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
        rays, voxels, weights = joseph(angles, offsets, depth, width, detector_width)
        matrix = np.zeros((len(angles) * detector_width, depth * width + 1), np.float32)
        matrix[rays, voxels] = weights
        del rays, voxels, weights
        matrix[:, -1] = np.sqrt(np.mean(matrix[:, :-1].sum(1) ** 2))
        self.detector_width, self.gaps = detector_width, Holdout.gaps(angles, gap).tilts()
        normal = matrix.T @ matrix
        prior = _roughness(depth, width)
        scale = smoothness * float(np.trace(normal[:-1, :-1])) / float(prior.data[prior.row == prior.col].sum())
        normal[prior.row, prior.col] += np.float32(scale) * prior.data
        # symmetric: the transpose has the memory order of LAPACK, which avoids a copy
        factor = linalg.cholesky(normal.T, lower=True, overwrite_a=True, check_finite=False)
        self.half = linalg.solve_triangular(factor, matrix.T, lower=True, overwrite_b=True, check_finite=False)
        self.inverse = [self._inverse(tilts) for tilts in self.gaps]

    def _rays(self, tilts: Array) -> Array:
        return (tilts[:, None] * self.detector_width + np.arange(self.detector_width)).ravel()

    def _inverse(self, tilts: Array) -> Array:
        part = self.half[:, self._rays(tilts)]
        return np.asarray(linalg.inv(np.eye(part.shape[1], dtype=np.float32) - part.T @ part, check_finite=False))

    def fitted(self, images: Array) -> Array:
        """Prediction by the volume of all tilts, (tilt, y, u)."""
        rays = _to_rays(images)
        return _to_images(self.half.T @ (self.half @ rays), images.shape)

    def errors(self, images: Array, used: Array | None = None) -> Array:
        """Images minus their prediction by a volume without their gap, (tilt, y, u); zero at pixels that are not `used`."""
        rays = _to_rays(images)
        some = np.ones_like(rays) if used is None else _to_rays(used)
        if not some.all():
            rays = self._completed(rays, some)
        left = rays - self.half.T @ (self.half @ rays)
        result = np.empty_like(left)
        for tilts, inverse in zip(self.gaps, self.inverse, strict=True):
            here = self._rays(tilts)
            result[here] = inverse @ left[here]
        return _to_images(result * some, images.shape)

    def _completed(self, rays: Array, some: Array) -> Array:
        """Rays whose masked values are those that the fit to the others predicts, so that they do not affect the fit.

        They solve (I − H) y = 0 at the masked rays, by conjugate gradients in every row of the images.
        """
        hidden = 1 - some

        def normal(values: Array) -> Array:
            moved: Array = hidden * (values - self.half.T @ (self.half @ values))
            return moved

        start = rays * some + hidden * ((rays * some).sum(0) / np.maximum(some.sum(0), 1))
        found, residual = start, -normal(start)
        step, power = residual, (residual**2).sum(0)
        for _ in range(_COMPLETIONS):
            moved = normal(step)
            size = power / np.maximum((step * moved).sum(0), 1e-30)
            found, residual = found + size * step, residual - size * moved
            power, before = (residual**2).sum(0), power
            step = residual + power / np.maximum(before, 1e-30) * step
        return np.asarray(found)


def shared(images: Array) -> float:
    """Mean product of each pixel with its neighbour along y: the power common to neighbouring rows, without white noise.

    Rows are fitted independently, so noise that is independent between rows does not contribute on average.
    """
    return neighbours(images, 1) if images.shape[1] > 1 else float(np.mean(images**2))


def _roughness(depth: int, width: int) -> sparse.coo_array:
    """Squared gradient of a (depth, width) slice as a sparse matrix, plus a small ridge."""

    def line(size: int) -> Array:
        steps = np.diff(np.eye(size), axis=0)
        return steps.T @ steps

    matrix = sparse.kron(line(depth), sparse.eye_array(width)) + sparse.kron(sparse.eye_array(depth), line(width))
    return sparse.coo_array((matrix + _RIDGE * sparse.eye_array(depth * width)).tocsr().astype(np.float32))


def _to_rays(images: Array) -> Array:
    return np.ascontiguousarray(images.transpose(0, 2, 1).reshape(-1, images.shape[1]), dtype=np.float32)


def _to_images(rays: Array, shape: tuple[int, ...]) -> Array:
    return np.asarray(rays.reshape(shape[0], shape[2], shape[1]).transpose(0, 2, 1))
