"""Base class of regularisers: costs of volumes, homogeneous of degree one, so that weights do not depend on units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from inspect import signature

from torch import Tensor

from noiseflow.described import in_short
from noiseflow.distributions.numerics.elementwise import LONG
from recon.names import REGULARISERS
from recon.names import regulariser_names as regulariser_names

SMOOTHING = 0.02  # units of the scale: smaller changes have quadratic cost


class Regulariser(ABC):
    """A differentiable cost of a volume that is zero for vacuum."""

    @abstractmethod
    def __call__(self, volume: Tensor, scale: float) -> Tensor:
        """The cost of a whole volume, a scalar.

        Args:
            volume: (z, x, y) attenuation per voxel, non-negative.
            scale: attenuation per voxel of one unit; the cost of ``k·volume`` at ``k·scale`` is k times as large.
        """

    def at_half_resolution(self) -> Regulariser:
        """The regulariser for the first steps of a fit, at half the resolution; by default this one."""
        return self

    def __repr__(self) -> str:
        names, own = signature(type(self)).parameters, vars(self)
        shown = (f"{name}={in_short(own[name])}" for name in names if name in own)
        return f"{type(self).__name__}({', '.join(shown)})"


def find_regulariser(name: str) -> Regulariser:
    """Create the regulariser with a given name, with its default settings. Raises ValueError if the name is unknown, and
    TypeError if the entry point with that name does not create a regulariser.
    """
    made = REGULARISERS.find(name)()
    if not isinstance(made, Regulariser):
        raise TypeError(f"regulariser {name} is a {type(made).__name__}; derive it from Regulariser")
    return made


_AT_ONCE = 1 << 24  # voxels on a GPU, which waits for calls rather than for memory: about a gigabyte
_FEWEST = 8  # layers: each part also needs neighbouring layers


def layers(volume: Tensor) -> int:
    """Number of layers along z to compute at a time."""
    return max(_FEWEST, (LONG if volume.device.type == "cpu" else _AT_ONCE) // volume[0].numel())
