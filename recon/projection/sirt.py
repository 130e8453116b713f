"""Simultaneous iterative reconstruction technique (doi:10.1016/0022-5193(72)90180-4), in its modern weighted form."""

from __future__ import annotations

import torch
from torch import Tensor

from noiseflow.arrays import Given, alike, as_tensor
from recon.projection.base import Projector


def sirt(
    line_integrals: Given,
    projector: Projector,
    *,
    num_iterations: int = 100,
    start: Given | None = None,
    minimum: float | None = 0.0,
    used: Given | None = None,
) -> Given:
    """Reconstruct by x ← x + C Aᵀ R (y − A x), with R and C the inverse row and column sums of A.

    Args:
        line_integrals: (tilt, y, u) measured line integrals, a tensor or an array.
        projector: the operator A.
        num_iterations: number of iterations; noise increases with it.
        start: (z, y, x) initial volume; zero if None. Thirty iterations are equivalent to ten followed by twenty.
        minimum: lower bound applied after every iteration, or None.
        used: (tilt, y, u) weights, 1 for pixels to use and 0 for the others; None for all.

    Returns:
        (z, y, x) attenuation per voxel, of the same array type as the input.

    Example:
        >>> import recon, torch
        >>> A = recon.SliceProjector(tilt_angles=range(-90, 90, 10), depth=8, width=8)
        >>> volume = torch.zeros(8, 2, 8)
        >>> volume[3:5, :, 3:5] = 1.0
        >>> found = recon.sirt(A(volume), A, num_iterations=30)
        >>> bool((found - volume).abs().mean() < 0.1)
        True
    """
    A = projector
    y = as_tensor(line_integrals, like=A)
    ones = torch.ones((A.depth, A.fixed_height or 1, A.width), dtype=y.dtype, device=y.device)
    R = _inverse(A(ones))
    weights = torch.ones_like(R) if used is None else as_tensor(used, like=A)
    R, C = R * weights, _inverse(A.T(weights))
    empty = torch.zeros((A.depth, y.shape[1], A.width), dtype=y.dtype, device=y.device)
    x = empty if start is None else as_tensor(start, like=A)
    for _ in range(num_iterations):
        x = x + C * A.T(R * (y - A(x)))
        if minimum is not None:
            x = x.clamp_min(minimum)
    return alike(x, line_integrals)


def _inverse(sums: Tensor) -> Tensor:
    return torch.where(sums > 0, 1 / sums, torch.zeros_like(sums))
