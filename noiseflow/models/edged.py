"""Noise that ends at edges, which move with the signal, such as uniform, exponential or half-normal noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # its packages load when they are first used
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.distributions.noise_distribution import MappedDistribution, NoiseDistribution
from noiseflow.distributions.pixels import Signal, values_of
from noiseflow.models.standardisation import Standardisation, root_coordinate
from noiseflow.models.wrapper import DensityAround

# Most coefficients of an edge, a polynomial of the root of the signal, in which lines and roots of the signal are of low degree.
_MOST = 7
# Power of the distance from an edge with which the number of pixels grows: 1 where the density jumps, as of uniform and
# exponential noise, 2 where it rises like a triangle, 4 to 5 in the tail of a normal law; other models describe the latter.
_STEEPEST = 1.5


class Edged(DensityAround):
    """Noise that ends at one or two edges, which move smoothly with the signal.

    The inner model describes the logarithm of the distance from an edge, or of the ratio of the distances from both: there, a
    density that jumps or is infinite at an edge is smooth. Within `reach` of an edge and beyond it, the logarithm goes on as an
    inverse hyperbolic sine, so that pixels beyond those of the fit are possible. `standardise` finds the edges by linear
    programming: the narrowest polynomial band that holds all observations.

    Args:
        model: the noise model inside the edges, of single pixels with a density.

    Raises:
        ValueError: the inner model needs images or has discrete values.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(0.2, 1.0, 5000)
        >>> observation = signal + 0.2 * signal * torch.rand(5000, generator=torch.Generator().manual_seed(0))
        >>> noise = noiseflow.fit(noiseflow.Edged(noiseflow.Mixture(shared_shape=True)), signal, observation).noise_model
        >>> [round(share, 2) for share in noise(torch.tensor(0.5)).cdf(torch.tensor([0.499, 0.601])).tolist()]
        [0.0, 1.0]
    """

    edges: Tensor
    sides: Tensor
    reach: Tensor

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        self.register_buffer("edges", torch.tensor([[-1.0], [1.0]]) * torch.eye(1, _MOST))
        self.register_buffer("sides", torch.ones(2))
        self.register_buffer("reach", torch.tensor(0.5))

    def forward(self, signal: Signal) -> EdgedDistribution:
        signal = values_of(signal)
        ends = signal.double()[..., None] + _powers(self.scale, signal) @ self.edges.double().T
        low, high = (ends[..., side] if there else None for side, there in enumerate(self.sides.tolist()))
        return EdgedDistribution(self.model(signal), low, high, float(self.reach))

    @torch.no_grad()
    def standardise(self, signal: Signal, observation: Tensor, **options: Any) -> None:
        """Find the edges of (N,) pixels, and standardise the inner model on what it describes."""
        signal = values_of(signal)
        self.scale.set_from(signal, observation)
        places, powers, reaches = edges_of(self.scale, signal, observation, range(1, _MOST + 1))
        sides = powers <= max(_STEEPEST, powers.min())
        self.edges.copy_(torch.from_numpy(places))
        self.sides.copy_(torch.from_numpy(sides))
        rounding = torch.finfo(observation.dtype).eps * float(observation.abs().max())
        self.reach.fill_(max(rounding, reaches[sides].max()))
        inner = self.forward(signal).to_inner(observation)[0].to(signal.dtype)
        self.scale.set_from(signal, inner)
        self.model.standardise(signal, inner, **options)

    def inside(self, signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.forward(signal).to_inner(observation)


class EdgedDistribution(MappedDistribution):
    """The distribution of values whose distances from edges, float64 of the batch shape or None, follow `base`."""

    per_pixel = ("_low", "_high")

    def __init__(self, base: NoiseDistribution, low: Tensor | None, high: Tensor | None, reach: float) -> None:
        super().__init__(base)
        self._low, self._high = (None if end is None else self.clean(end) for end in (low, high))
        self._reach = reach

    def to_inner(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """What the inner model describes, and its log-derivative, float64."""
        found, slope = torch.zeros_like(value, dtype=torch.float64), torch.zeros_like(value, dtype=torch.float64)
        for edge in (self._low, self._high):
            if edge is not None:
                away = (value.double() - edge) / self._reach
                found, slope = found + torch.asinh(away), slope + torch.rsqrt(1 + away**2) / self._reach
        return found, torch.log(slope)

    def from_inner(self, inner: Tensor) -> Tensor:
        """The observation, float64."""
        ends = [edge for edge in (self._low, self._high) if edge is not None]
        half = inner.double() / len(ends)
        across = (ends[-1] - ends[0]) / (2 * self._reach)
        # sinh(a) − sinh(b) = 2·across of a + b = 2·half
        return ends[0] + self._reach * torch.sinh(half + torch.asinh(across / torch.cosh(half)))


def ends_sharply(signal: Tensor, observation: Tensor) -> bool:
    """Whether (N,) observations end at an edge that moves with the signal."""
    scale = Standardisation().to(signal.device)
    scale.set_from(signal, observation)
    return bool(edges_of(scale, signal, observation, [_MOST])[1].min() < _STEEPEST)


def _powers(scale: Standardisation, signal: Tensor) -> Tensor:
    """(..., 7) powers of the root of each signal in its range, from −1 to 1, float64."""
    share = (signal.double() - scale.signal_low) / (scale.signal_high - scale.signal_low)
    return (2 * root_coordinate(share.clamp(0, 1), 1) - 1)[..., None] ** torch.arange(_MOST, device=signal.device)


def edges_of(
    scale: Standardisation,
    signal: Tensor,
    observation: Tensor,
    sizes: Sequence[int],
    *,
    ranges: int = 512,
    every: int = 100,
) -> tuple[NDArray[np.float64], ...]:
    """Lower and upper edge of the residuals of (N,) pixels: (2, 7) coefficients, of which the likelihood of the pixels beside
    them, one in `every`, chooses one of some numbers; (2,) powers of the distance with which the number of pixels grows; and how
    far others lie beyond. The outermost pixels in `ranges` of signals determine the edges."""
    powers = _powers(scale, signal).cpu().numpy()
    parts = [part for part in np.array_split(np.argsort(powers[:, 1]), ranges) if len(part)]
    count, found = min(max(2 * _MOST, len(powers) // every), len(powers) - 1), []
    for sign in (1, -1):
        residual = sign * (observation.double() - signal.double()).cpu().numpy()
        outer, tried = [part[residual[part].argmin()] for part in parts], []
        for free in sizes:
            some = powers[outer, :free]
            place = scipy.optimize.linprog(-some.mean(0), A_ub=some, b_ub=residual[outer], bounds=(None, None)).x
            away = residual - powers[:, :free] @ place
            place[0] += away.min()
            tried.append((sign * np.pad(place, (0, _MOST - free)), free, away - away.min()))
        density = count / np.partition(tried[-1][2], count)[count]  # pixels by distance from the edge
        # another coefficient gains one nat by chance, and other pixels lose one
        costs = [density * float(away.mean()) + 2 * free for _, free, away in tried]
        place, free, away = tried[int(np.argmin(costs))]
        near = np.sort(np.partition(away, count)[:count])
        # the most likely power (Hill 1975, doi:10.1214/aos/1176343247); rounding errors may be below the edge
        power = -1 / float(np.log(np.maximum(near[free:] / near[-1], np.finfo(float).eps)).mean())
        found.append((place, power, near[-1] * (free / count) ** (1 / power)))
    return tuple(np.stack(each) for each in zip(*found, strict=True))
