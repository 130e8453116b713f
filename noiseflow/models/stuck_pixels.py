"""Dead and hot pixels: a share of the pixels reports one level whatever the signal is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.image_pixels import Signal, values_of
from noiseflow.distributions.noise_distribution import DistributionAround, NoiseDistribution
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.digitisation import GROUPS
from noiseflow.models.wrapper import ModelAround, of_inner

# Where a level stands alone, it has at least five pixels, and the two levels beside it have a tenth as many.
_BESIDE = 0.1


class StuckPixels(ModelAround):
    """A noise model of discrete pixel values, of which a share is one level whatever the signal is.

    Args:
        model: the noise model of the other pixels, such as `Digitised` or `Poisson`.
        level: pixel value of the dead or hot pixels, detector units.
        share: their share of the pixels, at least 0 and below 1.

    Raises:
        ValueError: `share` is out of range, or the pixel values of the model are not discrete.

    Example:
        >>> import noiseflow, torch
        >>> counter = noiseflow.StuckPixels(noiseflow.Poisson(), level=0.0, share=0.1)
        >>> round(counter(torch.tensor(30.0)).log_prob(0.0).exp().item(), 3)
        0.1
    """

    settings = ("level", "share")
    step, low, high, settles = map(of_inner, ("step", "low", "high", "settles"))

    def __init__(self, model: nn.Module, level: float = 0.0, share: float = 0.0) -> None:
        super().__init__(model)
        check(share=share)
        if not self.model.describes_single_readings or self.model.needs_image:
            raise ValueError(
                f"{type(self.model).__name__} is no model of single pixels with discrete values; put noiseflow.Digitised around "
                "a single-pixel model first"
            )
        self.level, self.share = float(level), float(share)

    def forward(self, signal: Signal) -> NoiseDistribution:
        return StuckDistribution(self.model(signal), self.level, self.share)

    def without_converter(self) -> NoiseModelBase:
        return self.model.without_converter()

    def match_levels(self, signal: Signal, observation: Tensor) -> bool:
        kept = self._others(values_of(signal), observation)
        return self.model.match_levels(signal[kept], observation[kept])

    def standardise(self, signal: Signal, observation: Tensor, **options: Any) -> None:
        """Standardise the inner model on the pixels without the share that is stuck."""
        kept = self._others(values_of(signal), observation)
        self.model.standardise(signal[kept], observation[kept], **options)

    def settle(self, signal: Tensor, observation: Tensor, behind: Any = None) -> None:
        """Set the maximum-likelihood parameters of the inner model, on these pixels."""
        kept = self._others(signal, observation)
        self.model.settle(signal[kept], observation[kept], behind)

    def _others(self, signal: Tensor, observation: Tensor) -> Tensor:
        """Indices of (N,) pixels without those at the level that are stuck, as many in each group by signal as its share."""
        kept = torch.ones_like(observation, dtype=torch.bool)
        for group in torch.tensor_split(torch.argsort(signal), min(GROUPS, signal.numel())):
            here, beside = _at(self.level, self.step, observation[group])
            there = group[here]
            # where the level stands alone, nothing else is there
            alone = int(beside.sum()) <= _BESIDE * there.numel()
            count = there.numel() if alone else min(there.numel(), round(self.share * group.numel()))
            places = (torch.arange(count, device=there.device) + 0.5) * there.numel() / max(count, 1)
            kept[there[places.long()]] = False
        return kept.nonzero()[:, 0]


class StuckDistribution(DistributionAround):
    """The discrete distribution `base`, of which a share is replaced by one level."""

    per_pixel = ()
    has_rsample = False  # type: ignore[misc]

    def __init__(self, base: NoiseDistribution, level: float, share: float) -> None:
        super().__init__(base)
        self.level, self.share = level, share

    def _mixed(self, log_mass: Tensor, inside: Tensor) -> Tensor:
        other = log_mass + math.log1p(-self.share)
        if not self.share:
            return other
        return torch.where(inside, torch.logaddexp(other, torch.full_like(other, math.log(self.share))), other)

    def log_prob(self, value: Tensor) -> Tensor:
        return self._mixed(self.base.log_prob(value), value == self.level)

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self._mixed(self.base.log_interval_prob(low, high), (low < self.level) & (high >= self.level))

    def cdf(self, value: Tensor) -> Tensor:
        return (1 - self.share) * self.base.cdf(value) + self.share * (value >= self.level)

    def cdf_below(self, value: Tensor) -> Tensor:
        return (1 - self.share) * self.base.cdf_below(value) + self.share * (value > self.level)

    def icdf(self, value: Tensor) -> Tensor:
        level = torch.full_like(value, self.level)
        before, upto = self.cdf_below(level), self.cdf(level)
        other = self.base.icdf(((value - self.share * (value > upto)) / (1 - self.share)).clamp(0, 1))
        return torch.where((value > before) & (value <= upto), level, other)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        drawn = self.base.sample(sample_shape, generator=generator)
        chosen = torch.rand(drawn.shape, generator=generator, device=drawn.device) < self.share
        return drawn.masked_fill(chosen & ~torch.isnan(drawn), self.level)

    def quadrature(self) -> tuple[Tensor, Tensor]:
        nodes, weights = self.base.quadrature()
        level = torch.full_like(nodes[:1], self.level)
        return torch.cat([nodes, level]), torch.cat([(1 - self.share) * weights, torch.full_like(level, self.share)])

    @property
    def mean(self) -> Tensor:
        return (1 - self.share) * self.base.mean + self.share * self.level

    @property
    def variance(self) -> Tensor:
        off = self.base.mean - self.level
        return (1 - self.share) * (self.base.variance + self.share * off**2)


def with_stuck_pixels(
    models: Mapping[str, NoiseModelBase], signal: Tensor, observation: Tensor, step: float
) -> dict[str, NoiseModelBase]:
    """Single-pixel models of discrete values with the dead and hot pixels of (N,) pixels, see `stuck_at`; others as they are."""
    found = dict(models)
    for level, share in stuck_at(signal, observation, step):
        for name, model in found.items():
            if model.describes_single_readings and not model.needs_image:
                found[name] = StuckPixels(model, level, share)
    return found


@torch.no_grad()
def stuck_at(signal: Tensor, observation: Tensor, step: float) -> list[tuple[float, float]]:
    """Levels at which a share of the pixels is stuck, and these shares: the lowest, the highest, both, or none.

    A level holds stuck pixels if its share of (N,) pixels is the same at all signals at which the levels beside it are rare.
    """
    found: list[tuple[float, float]] = []
    if not step or observation.numel() < 5 * GROUPS:
        return found
    groups = torch.tensor_split(torch.argsort(signal), GROUPS)
    for level in map(float, observation.aminmax()):
        marked = [_at(level, step, observation[group]) for group in groups]
        here, beside = torch.tensor([[int(each.sum()) for each in pair] for pair in marked], dtype=torch.float64).T
        size = torch.tensor([group.numel() for group in groups], dtype=torch.float64)
        alone = (here >= 5) & (beside <= _BESIDE * here)
        share = float(here[alone].sum() / size[alone].sum())
        if alone.sum() < 8 or share == 1:
            continue
        # also where it should stand alone and does not: empty vacuum has its level at one signal only
        expected = beside <= _BESIDE * size * share
        count = int(expected.sum())
        scatter = float(((here - size * share)[expected] ** 2 / (size[expected] * share * (1 - share))).sum())
        if scatter <= count + 4 * math.sqrt(2 * count):  # within four standard errors
            found.append((level, share))
    return found


def _at(level: float, step: float, observation: Tensor) -> tuple[Tensor, Tensor]:
    """Whether observations are at a level, and whether they are within two steps beside it."""
    away = (observation - level).abs()
    return away == 0, (away > 0) & (away < 2.5 * step)
