"""Differences between neighbouring voxels and their adjoints, and the number of layers to compute at a time."""

from __future__ import annotations

import torch
from torch import Tensor

_CACHED = 1 << 17  # voxels: arrays of this size fit in the cache, and the overhead of calls is small
_FEWEST = 8  # layers: each part also needs neighbouring layers


def layers(volume: Tensor) -> int:
    """Number of layers along z to compute at a time."""
    return max(_FEWEST, _CACHED // volume[0].numel())


def difference(array: Tensor, axis: int) -> Tensor:
    """Difference to the next element along an axis; zero at the end."""
    found = torch.zeros_like(array)
    within = inner(found, axis)
    torch.sub(array.narrow(axis, 1, within.shape[axis]), inner(array, axis), out=within)
    return found


def add_adjoint(found: Tensor, flow: Tensor, axis: int) -> None:
    """Add the adjoint of `difference`, for a flow that is zero at the end of the axis."""
    found.sub_(flow)
    within = inner(flow, axis)
    found.narrow(axis, 1, within.shape[axis]).add_(within)


def inner(array: Tensor, axis: int, *, last: bool = False) -> Tensor:
    """All elements along an axis but the last, or only the last."""
    size = array.shape[axis]
    return array.narrow(axis, size - 1, 1) if last else array.narrow(axis, 0, size - 1)
