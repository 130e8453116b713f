"""Regularisers on trial: written for brevity, differentiated by torch, and not part of the package."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from recon.fields.regularisers import Regulariser, SecondOrderVariation, TotalVariation

_SMOOTHING = 0.02  # as of total variation


def _squares(volume: Tensor, along_z: float = 1.0) -> Tensor:
    """Squared gradient of (z, x, y), its z part weighted."""
    total = torch.zeros_like(volume)
    for axis, factor in enumerate((along_z, 1.0, 1.0)):
        size = volume.shape[axis]
        step = torch.diff(volume, dim=axis, append=volume.narrow(axis, size - 1, 1))
        total = total + (factor * step) ** 2
    return total


class GroupSparsity(Regulariser):
    """Jumps count together with those of their neighbours, 2³ voxels that overlap (doi:10.1007/s10915-013-9736-1)."""

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        together = avg_pool3d(_squares(volume)[None, None], 2, stride=1)
        smoothing = _SMOOTHING * scale
        return ((together + smoothing**2).sqrt() - smoothing).sum()


class FlatterAlongBeam(Regulariser):
    """Total variation whose differences along z, which few tilts saw, count `along_z` times."""

    def __init__(self, along_z: float) -> None:
        self.along_z = along_z

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        smoothing = _SMOOTHING * scale
        return ((_squares(volume, self.along_z) + smoothing**2).sqrt() - smoothing).sum()


class WithAttenuation(Regulariser):
    """Total variation and a share of the sum of attenuation, which is never negative."""

    def __init__(self, share: float) -> None:
        self.share, self.variation = share, TotalVariation()

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        return self.variation(volume, scale) + self.share * volume.sum()


CANDIDATES: dict[str, Regulariser] = {
    "total-variation": TotalVariation(),
    "second-order": SecondOrderVariation(),
    "second-order, c = 0.3": SecondOrderVariation(curvature=0.3),
    "group sparsity, 2³": GroupSparsity(),
    "TV, z counts 0.7": FlatterAlongBeam(0.7),
    "TV, z counts 1.4": FlatterAlongBeam(1.4),
    "TV + 0.1 attenuation": WithAttenuation(0.1),
}
