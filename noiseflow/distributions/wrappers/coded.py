"""The distribution of observations that take a few levels, not equally spaced, such as square roots or tables of codes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import scipy  # its packages load when they are first used
import torch
from torch import Tensor
from torch.distributions import constraints

from noiseflow.distributions.laws.base import NEAR
from noiseflow.distributions.noise_distribution import DistributionAround, NoiseDistribution
from noiseflow.distributions.wrappers.numerical import as_noise_distribution


class CodedDistribution(DistributionAround):
    """The levels of a converter: level j represents the values before it in (edges[j − 1], edges[j]].

    A value that is no level has the probability of the nearest one: rare levels may be missing in the data of a fit.

    Args:
        levels: (K,) levels, increasing, at least two.
        edges: (K − 1,) values before the converter that separate them, increasing.
        base: distribution before the converter: any torch distribution of one number per pixel.
    """

    per_pixel = ()
    discrete = True
    has_rsample = False  # type: ignore[misc]

    def __init__(self, levels: Tensor, edges: Tensor, base: Any) -> None:
        super().__init__(as_noise_distribution(base))
        self.levels, self.edges = levels.to(self.device).double(), edges.to(self.device).double()
        self._bounds = torch.nn.functional.pad(self.edges, (1, 1), value=math.inf)
        self._bounds[0] = -math.inf

    def rescaled(self, scale: Tensor, shift: Tensor) -> CodedDistribution:
        return CodedDistribution(self.levels, self.edges, self.base.rescaled(scale, shift))

    def _bound(self, value: Tensor, *, before: bool = False) -> Tensor:
        """The upper end, before the converter, of the levels up to a value, or only of those before it."""
        slack = (-NEAR if before else NEAR) * torch.diff(self.levels).amin()
        return self._bounds[torch.searchsorted(self.levels, (value.double() + slack).contiguous())]

    def represents(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """The ends of the interval before the converter that each value stands for."""
        place = torch.bucketize(value.double().contiguous(), (self.levels[1:] + self.levels[:-1]) / 2)
        return self._bounds[place], self._bounds[place + 1]

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base.log_interval_prob(*self.represents(value))

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.base.log_interval_prob(self._bound(low), self._bound(high))

    def cdf(self, value: Tensor) -> Tensor:
        return self.base.cdf(self._bound(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        return self.base.cdf(self._bound(value, before=True))

    def code(self, value: Tensor) -> Tensor:
        """The levels of values before the converter."""
        return self.levels[torch.searchsorted(self.edges, value.double().contiguous())].to(value)

    def icdf(self, value: Tensor) -> Tensor:
        return self.code(self.base.icdf(value))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        return self.code(self.base.sample(sample_shape, generator=generator))

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """The lowest and the highest level."""
        return self.levels[0], self.levels[-1]

    @property
    def support(self) -> constraints.Constraint:
        """The range of the levels."""
        return constraints.interval(self.levels[0], self.levels[-1])  # type: ignore[no-untyped-call]

    def quadrature(self) -> tuple[Tensor, Tensor]:
        """All levels and their probabilities, (K, *batch) each."""
        nodes = self.levels.view(-1, *(1,) * len(self.batch_shape)).expand(-1, *self.batch_shape)
        return nodes, torch.exp(self.log_prob(nodes))


@torch.no_grad()
def matching_edges(
    model: Callable[[Tensor], NoiseDistribution], signal: Tensor, weight: Tensor, counts: Tensor, levels: Tensor
) -> tuple[Tensor, float]:
    """The edges between levels at which each is as frequent as among the observations, as far as these are no chance.

    Args:
        model: function from signals to distributions before the converter.
        signal: (S,) signals, increasing.
        weight: (S,) shares of the pixels with these signals.
        counts: (K,) pixels at each level.
        levels: (K,) levels, increasing; their midpoints are the edges of an ideal converter.

    Returns:
        (K − 1,) edges, increasing: those of a histogram test of a converter. And the smallest probability that an ideal converter
        has as uneven a histogram, see `_shrunk`.
    """
    ideal, gaps = (levels[1:] + levels[:-1]) / 2, torch.diff(levels)
    start = torch.cat([ideal[:1] - gaps[:1], ideal, ideal[-1:] + gaps[-1:]])
    # in half a gap, the distribution function is nearly a line
    grid = torch.stack([start, start + torch.nn.functional.pad(torch.diff(start), (0, 1)) / 2], 1).reshape(-1)[:-1]
    parts = [torch.tensor_split(each, math.isqrt(signal.numel())) for each in (signal, weight)]
    never = NEAR / counts.sum()
    below = torch.stack([_below(model, at, grid, never) @ share for at, share in zip(*parts, strict=True)]).sum(0)
    inside = torch.diff(below[2:-2:2], prepend=below.new_zeros(1), append=below.new_ones(1))
    shares, chance = _shrunk(inside.clamp(min=0), counts, _codes(levels))
    wanted = torch.cumsum(shares, 0)[:-1].contiguous()
    after = torch.searchsorted(below, wanted).clamp(1, grid.numel() - 1)
    slope = (below[after] - below[after - 1]).clamp(min=torch.finfo(torch.float64).tiny)
    share = ((wanted - below[after - 1]) / slope).clamp(0, 1)
    found = grid[after - 1] + share * (grid[after] - grid[after - 1])
    shown = torch.minimum(wanted, 1 - wanted) * counts.sum() > 0.5  # of other edges, the pixels say nothing
    # no level that the data lack is impossible
    return torch.lerp(torch.cummax(torch.where(shown, found, ideal), 0).values, ideal, NEAR), chance


def _below(model: Callable[[Tensor], NoiseDistribution], signal: Tensor, grid: Tensor, never: Tensor) -> Tensor:
    """CDF at (G,) values for (S,) increasing signals; 0 or 1 where it is within `never` of that at the first or last of them."""

    def cdf(at: Tensor, value: Tensor) -> Any:
        return model(at).expand((value.numel(), at.numel())).cdf(value[:, None].expand(-1, at.numel())).double()

    first, last = cdf(signal[[0, -1]], grid).T
    found: Tensor = (first > never).double()[:, None].repeat(1, signal.numel())
    inside = (first > never) & (last < 1 - never)
    found[inside] = cdf(signal, grid[inside])
    return found


def _codes(levels: Tensor, *, rarest: int = 8) -> Tensor:
    """Numbers (K,) of increasing levels from 0, in steps of their least distance; their places if they are no whole steps apart,
    or fewer than one in `rarest`."""
    steps = (levels - levels[0]) / torch.diff(levels).amin()
    code = torch.round(steps)
    if float(steps[-1]) > rarest * levels.numel() or float((steps - code).abs().amax()) > NEAR:
        return torch.arange(levels.numel(), device=levels.device)
    return code.long()


def _shrunk(expected: Tensor, counts: Tensor, code: Tensor, *, few: int = 8) -> tuple[Tensor, float]:
    """Shares of levels between those expected and those counted, and the probability of counts as uneven by chance. Levels that
    have the last bits of their place or of their code in common, and at last each level alone, differ from the expectation by
    random effects, whose variance follows from their scatter beyond that of counts (DerSimonian and Laird 1986,
    doi:10.1016/0197-2456(86)90046-2). The probability is that of common bits, or of differences between neighbours. So few pixels
    of a level do not scatter as chi-squared tests need; of so few levels with common bits, errors of the noise model look like a
    pattern."""
    place, total = torch.arange(counts.numel(), device=counts.device), counts.sum()
    mean = expected * (total / expected.sum())
    # errors of the noise model are smooth along the levels; second differences, of which half are independent, are not
    common = mean >= few
    noise, ratio = 1 / mean[common], counts[common] / mean[common]
    bent = ratio.diff(n=2) / torch.sqrt(noise[2:] + 2**2 * noise[1:-1] + noise[:-2])
    above = int((bent**2 > scipy.special.chdtri(1, 0.5)).sum())
    chance = float(scipy.special.bdtrc(above // 2 - 1, max(1, bent.numel() // 2), 0.5))
    periods = [2**bit for bit in range(1, max(1, (counts.numel() // few).bit_length()))]
    # a stretched histogram lacks codes, but has a pattern by place; a converter that lacks codes, by code (0.0018 to 0.0001 nats)
    kinds = [place] if torch.equal(place, code) else [place, code]
    for number, period in [*product(kinds, periods), (place, counts.numel())]:
        likely, group = (mean >= few).double(), number % period
        if period * few <= bent.numel():
            chance = min(chance, _chance_of_pattern(bent, number[common][1:-1] % period, period))
        if period < counts.numel():  # in a set no level weighs more than the eighth: a pattern is common to all
            sets = mean.new_zeros(int(number[-1]) // period + 1, period).index_put((number // period, group), mean)
            likely *= (sets.topk(few, 0).values[-1][group] / mean).clamp(max=1).nan_to_num()
        wanted = torch.bincount(group, mean * likely, period).clamp(min=1e-30)
        ratio = torch.bincount(group, counts * likely, period) / wanted - 1
        each = (counts / mean.clamp(min=1e-30) - 1 - ratio[group]) * likely
        free = max(1, int((likely > 0).sum()) - period)
        within = max(1.0, float((mean * each**2).sum()) / free)
        excess = float((wanted * ratio**2).sum()) / within
        spread = max(0.0, excess - int((wanted > 1).sum()) + 1) / float(total - (wanted**2).sum() / total)
        mean = mean * (1 + ratio * spread / (spread + 1 / wanted))[group]
        mean *= total / mean.sum()
    return mean / total, chance


def _chance_of_pattern(bent: Tensor, group: Tensor, count: int) -> float:
    """The probability that standardised second differences of levels differ as much between groups by chance (F-test). All levels
    count alike: a peak that the noise model lacks is in one set of levels, a pattern of the converter in all."""
    size = torch.bincount(group, minlength=count).clamp(min=1)
    mean = torch.bincount(group, bent, count) / size
    free = max(1, bent.numel() - count)
    within = max(1.0, float(((bent - mean[group]) ** 2).sum()) / free)
    # half of the differences are independent
    return float(
        scipy.special.fdtrc((count - 1) / 2, free / 2, float((size * mean**2).sum()) / within / (count - 1) / 2)
    )
