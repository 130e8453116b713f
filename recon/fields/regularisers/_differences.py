"""Differences between neighbouring voxels and their adjoints, and how many layers to compute at a time."""

from __future__ import annotations

import torch
from torch import Tensor

_CACHED = 1 << 17  # voxels: what is computed for so many stays in the cache, and takes longer than the calls
_FEWEST = 8  # layers: each part also needs some of those beside it


def layers(volume: Tensor) -> int:
    """How many along z to compute at a time."""
    return max(_FEWEST, _CACHED // volume[0].numel())


def difference(array: Tensor, axis: int) -> Tensor:
    """To the next along an axis; zero at its end."""
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
    """All but the last along an axis, or the last alone."""
    size = array.shape[axis]
    return array.narrow(axis, size - 1, 1) if last else array.narrow(axis, 0, size - 1)
