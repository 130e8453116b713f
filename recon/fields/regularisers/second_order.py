"""Total variation, for volumes with few faces, and second-order variation, if these may be curved or have gradients."""

import math
from typing import Any

import torch
from torch import Tensor

from noiseflow.arrays import Given, alike, as_tensor
from recon.fields.regularisers.base import SMOOTHING, Regulariser, layers
from recon.projection.base import SavedGradient


class SecondOrderVariation(Regulariser):
    """Joint norm of gradient and Hessian: Σ √(‖∇v‖² + c‖∇²v‖² + ε²) − ε, divided by √(1 + c) + √c.

    Total variation turns slopes into staircases. The Hessian (Frobenius norm, doi:10.1109/TIP.2011.2168232) penalises a slope
    only at its ends. Together they preserve edges and slopes (doi:10.1007/s10851-013-0445-4). With this normalisation, a step
    across a flat face costs its jump, as for total variation, so that weights are comparable.

    Args:
        curvature: c, weight of the Hessian relative to the gradient.
        smoothing: ε, changes below this value, in units of the scale, have quadratic cost.

    Raises:
        ValueError: `smoothing` is not positive, or `curvature` is negative.
    """

    def __init__(self, curvature: float = 1.0, smoothing: float = SMOOTHING) -> None:
        if not (smoothing > 0 and 0 <= curvature < math.inf):
            raise ValueError(f"smoothing {smoothing} must be positive, and curvature {curvature} zero or more")
        self.curvature, self.smoothing = curvature, smoothing

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        value: Tensor = _Variation.apply(volume, self.curvature, self.smoothing * scale)  # type: ignore[no-untyped-call]
        return value / (math.sqrt(1 + self.curvature) + math.sqrt(self.curvature))


class _Variation(SavedGradient):
    """Computes cost and gradient in one pass, a few layers at a time; layers of vacuum are skipped."""

    @staticmethod
    def forward(ctx: Any, volume: Tensor, curvature: float, smoothing: float) -> Tensor:
        gradient, total, count = torch.zeros_like(volume), volume.new_zeros(()), layers(volume)
        for start in range(0, len(volume), count):
            first, last = max(0, start - 1), start + count + 1  # a term depends on one layer on each side
            part = volume[first:last]
            if bool(part.any()):
                own = slice(start - first, start - first + count)
                total += _add(part, own, gradient[first:last], curvature=curvature, smoothing=smoothing)
        ctx.save_for_backward(gradient)
        return total


def _add(part: Tensor, own: slice, gradient: Tensor, *, curvature: float, smoothing: float) -> Tensor:
    """The cost of the layers `own` of a part of a volume; its gradient is added to that of the part."""
    slopes = [_difference(part, axis) for axis in range(3)]
    pairs = [(first, second) for first in range(3) for second in range(first, 3) if curvature]
    bends = [_bend(slopes[first], first, second) for first, second in pairs]
    squared = torch.full_like(part, smoothing**2)
    for slope in slopes:
        squared.addcmul_(slope, slope)
    shares = [curvature * (1 if first == second else 2) for first, second in pairs]  # off-diagonal terms count twice
    for bend, share in zip(bends, shares, strict=True):
        squared.addcmul_(bend, bend, value=share)
    magnitude = squared[own].sqrt_()
    inverse = torch.zeros_like(part)
    torch.reciprocal(magnitude, out=inverse[own])
    flows = [slope.mul_(inverse) for slope in slopes]
    for (first, second), bend, share in zip(pairs, bends, shares, strict=True):
        bend.mul_(inverse).mul_(share)
        if first == second:
            flows[first].sub_(_difference(bend, first))
        else:
            _add_adjoint(flows[first], bend, second)
    for axis, flow in enumerate(flows):
        flow.narrow(axis, -1, 1).zero_()  # there is no difference across the edge
        _add_adjoint(gradient, flow, axis)
    return (magnitude - smoothing).sum()


def _bend(slope: Tensor, first: int, second: int) -> Tensor:
    """Second difference: centred along one axis; for two axes, the difference of the slope along the first."""
    if first != second:
        return _difference(slope, second)
    found = slope.clone()
    within = _inner(slope, first)
    found.narrow(first, 1, within.shape[first]).sub_(within)
    return found


def _difference(array: Tensor, axis: int) -> Tensor:
    """Difference to the next element along an axis; zero at the end."""
    found = torch.zeros_like(array)
    within = _inner(found, axis)
    torch.sub(array.narrow(axis, 1, within.shape[axis]), _inner(array, axis), out=within)
    return found


def _add_adjoint(found: Tensor, flow: Tensor, axis: int) -> None:
    """Add the adjoint of `_difference`, for a flow that is zero at the end of the axis."""
    found.sub_(flow)
    within = _inner(flow, axis)
    found.narrow(axis, 1, within.shape[axis]).add_(within)


def _inner(array: Tensor, axis: int) -> Tensor:
    return array.narrow(axis, 0, array.shape[axis] - 1)


class TotalVariation(SecondOrderVariation):
    """Isotropic total variation: no curvature. Raises ValueError if `smoothing` is not positive.

    Args:
        smoothing: jumps below this value, in units of the scale, have quadratic cost.
    """

    def __init__(self, smoothing: float = SMOOTHING) -> None:
        super().__init__(0.0, smoothing)


def total_variation(volume: Given, *, smoothing: float) -> Given:
    """Isotropic total variation of a 3D array, summed: Σ √(‖∇v‖² + ε²) − ε (doi:10.1016/0167-2789(92)90242-F).

    Uses forward differences. The gradient is defined everywhere and computed in the same pass. A constant volume has zero cost.

    Args:
        volume: (a, b, c), any axis order, a tensor or an array.
        smoothing: ε, in the units of `volume`: jumps well below it have quadratic cost.

    Raises:
        ValueError: `smoothing` is not positive.

    Example:
        >>> import recon, torch
        >>> step = torch.zeros(4, 4, 4)
        >>> step[2:] = 1.0  # one face of 16 voxels
        >>> bool(abs(recon.total_variation(step, smoothing=1e-3) - 16) < 0.5)
        True
    """
    return alike(TotalVariation(smoothing)(as_tensor(volume), 1.0), volume)


REGULARISER = SecondOrderVariation
REGULARISERS = {"total-variation": TotalVariation}
