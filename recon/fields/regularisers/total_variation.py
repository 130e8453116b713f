"""Total variation, for volumes with few faces."""

from __future__ import annotations

from torch import Tensor

from noiseflow.arrays import Given, alike, as_tensor
from recon.fields.regularisers.base import Regulariser
from recon.fields.regularisers.second_order import variation


class TotalVariation(Regulariser):
    """Isotropic total variation.

    Args:
        smoothing: jumps below this value, in units of the scale, have quadratic cost.

    Raises:
        ValueError: `smoothing` is not positive.
    """

    def __init__(self, smoothing: float = 0.02) -> None:
        if not smoothing > 0:
            raise ValueError(f"smoothing {smoothing} must be positive, in units of the scale")
        self.smoothing = smoothing

    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        return total_variation(volume, smoothing=self.smoothing * scale)

    def __repr__(self) -> str:
        return f"TotalVariation(smoothing={self.smoothing:g})"


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
    if not smoothing > 0:
        raise ValueError(f"smoothing {smoothing} must be positive, in the units of the volume")
    return alike(variation(as_tensor(volume), 0.0, smoothing), volume)


REGULARISER = TotalVariation
