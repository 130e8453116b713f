"""Dead and hot pixels, and zeros beside a density: a share of the pixels, which may depend on the signal, reports one value."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy  # its packages load when they are first used
import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.noise_distribution import DistributionAround, NoiseDistribution
from noiseflow.distributions.pixels import Signal, values_of
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.digitisation import FEWEST, GROUPS, MOST_CODES, Digitisation
from noiseflow.models.standardisation import interpolate_linear
from noiseflow.models.wrapper import ModelAround, of_inner

# Where a level stands alone, it has at least five pixels, and the two levels beside it have a tenth as many; and so have, where
# values are continuous, all but the most frequent few values.
_BESIDE = 0.1


class StuckPixels(ModelAround):
    """A noise model of which a share of the pixels is one value instead: dead and hot pixels, or zeros of sums of few events.

    Args:
        model: the noise model of the other pixels.
        level: the value, detector units.
        share: its share of the pixels, at least 0 and below 1; or the shares at signals that are equally spaced over `span`.
        span: lowest and highest of these signals, detector units; beyond them, the share is that at the end.

    Raises:
        ValueError: `share` is out of range, or the model needs images.

    Example:
        >>> import noiseflow, torch
        >>> counter = noiseflow.StuckPixels(noiseflow.Poisson(), level=0.0, share=0.1)
        >>> round(counter(torch.tensor(30.0)).log_prob(0.0).exp().item(), 3)
        0.1
    """

    settings = ("level", "share", "span")
    describes_single_readings = True
    step, low, high, settles, without_converter = map(of_inner, ["step", "low", "high", "settles", "without_converter"])

    def __init__(
        self,
        model: nn.Module,
        level: float = 0.0,
        share: float | Sequence[float] = 0.0,
        span: Sequence[float] = (0.0, 1.0),
    ) -> None:
        super().__init__(model)
        self._shares = [share] * 2 if isinstance(share, float | int) else list(share)
        for each in self._shares:
            check(share=each)
        if self.model.needs_image:
            raise ValueError(f"{type(self.model).__name__} needs images; put it around StuckPixels instead")
        self.level, self.share, self.span = float(level), share, (float(span[0]), float(span[1]))

    def _share_at(self, signal: Tensor) -> Tensor:
        place = (signal - self.span[0]) / (self.span[1] - self.span[0])
        return interpolate_linear(place.new_tensor(self._shares), place.nan_to_num(0.5).clamp(0, 1))

    def forward(self, signal: Signal) -> NoiseDistribution:
        base = self.model(signal)
        return StuckDistribution(base, self.level, self._share_at(base.working(values_of(signal))))

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

    def learner(self, observation: Tensor) -> tuple[NoiseModelBase, Tensor]:
        here, beside = _at(self.level, self.step, observation)
        if not _stands_alone(here, beside):
            return super().learner(observation)
        model, needed = self.model.learner(observation)
        return model, needed & ~here

    def extra_repr(self) -> str:
        low, high = (f"{end(self._shares):.5g}" for end in (min, max))
        return f"level={self.level:g}, share={low}" + (f" to {high}" if low != high else "")

    def _others(self, signal: Tensor, observation: Tensor) -> Tensor:
        """Indices of (N,) pixels without those at the level that are stuck, as many in each group by signal as its share."""
        here, beside = _at(self.level, self.step, observation)
        if _stands_alone(here, beside):
            return (~here).nonzero()[:, 0]
        kept, share = torch.ones_like(observation, dtype=torch.bool), self._share_at(signal)
        for group in torch.tensor_split(torch.argsort(signal), min(GROUPS, signal.numel())):
            here, beside = _at(self.level, self.step, observation[group])
            there = group[here]
            # where the level stands alone, nothing else is there
            alone = _stands_alone(here, beside)
            count = there.numel() if alone else min(there.numel(), round(float(share[group].sum())))
            places = (torch.arange(count, device=there.device) + 0.5) * there.numel() / max(count, 1)
            kept[there[places.long()]] = False
        return kept.nonzero()[:, 0]


class StuckDistribution(DistributionAround):
    """The distribution `base`, of which a share, of the batch shape, is replaced by one level."""

    per_pixel = ("share",)
    has_rsample = False  # type: ignore[misc]

    def __init__(self, base: NoiseDistribution, level: float, share: Tensor) -> None:
        super().__init__(base)
        self.level, self.share = level, share

    def _mixed(self, log_mass: Tensor, inside: Tensor, *, density: bool = False) -> Tensor:
        other, some = log_mass + torch.log1p(-self.share), self.share > 0
        log_share = torch.log(torch.where(some, self.share, torch.ones_like(self.share))) + torch.zeros_like(other)
        return torch.where(inside & some, log_share if density else torch.logaddexp(other, log_share), other)

    def log_prob(self, value: Tensor) -> Tensor:
        return self._mixed(self.base.log_prob(value), value == self.level, density=not self.base.discrete)

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
        return torch.cat([nodes, level]), torch.cat([(1 - self.share) * weights, self.share.expand_as(level)])

    @property
    def mean(self) -> Tensor:
        return (1 - self.share) * self.base.mean + self.share * self.level

    @property
    def variance(self) -> Tensor:
        return (1 - self.share) * (self.base.variance + self.share * (self.base.mean - self.level) ** 2)


def with_stuck_pixels(
    models: Mapping[str, NoiseModelBase], signal: Tensor, stuck: Sequence[tuple[float, Any]], digitisation: Digitisation
) -> dict[str, NoiseModelBase]:
    """Single-pixel models with the values and shares of (N,) pixels that `stuck_at` found; others as they are."""
    found = dict(models)
    for level, share in stuck:
        span = tuple(map(float, signal.aminmax()))
        for name, model in found.items():
            if not model.needs_image and (model.describes_single_readings or not digitisation.step):
                found[name] = StuckPixels(model, level, share, span)
    return found


@torch.no_grad()
def stuck_at(
    signal: Tensor, observation: Tensor, digitisation: Digitisation, *, few: int = 4
) -> list[tuple[float, float | tuple[float, ...]]]:
    """Values of (N,) pixels at which some are stuck, and their shares. Of rounded values, these are the lowest, the highest,
    both, or none: a level holds stuck pixels if its share is the same at all signals at which the levels beside it are rare. Of
    others, they are those that repeat, and are no clipping limit; their shares may depend on the signal."""
    found, step = list[tuple[float, Any]](), digitisation.step
    if observation.numel() < 5 * GROUPS or (digitisation.levels and not step):
        return found
    if not step:
        values, counts = torch.unique(observation, return_counts=True)
        counts, order = counts.sort(descending=True)
        often = values[order[:few][counts[:few] >= max(FEWEST, float(counts[few : few + 1].sum()) / _BESIDE)]]
        inside = (digitisation.low < often) & (often < digitisation.high) & (values.numel() > MOST_CODES)
        return [(level, _shares(signal, observation == level)) for level in often[inside].tolist()]
    groups = torch.tensor_split(torch.argsort(signal), GROUPS)
    for level in map(float, observation.aminmax()):
        marked = [_at(level, step, observation[group]) for group in groups]
        here, beside = torch.tensor([[int(each.sum()) for each in pair] for pair in marked], dtype=torch.float64).T
        size = torch.tensor([group.numel() for group in groups], dtype=torch.float64)
        # at all signals, at none of which it is the law of most pixels, as 0 is in vacuum
        if here.sum() >= FEWEST and _stands_alone(here, beside) and bool((2 * here < size).all()):
            found.append((level, _shares(signal, observation == level)))
            continue
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


def _stands_alone(here: Tensor, beside: Tensor) -> bool:
    return bool(beside.sum() <= _BESIDE * here.sum())


def _shares(signal: Tensor, here: Tensor, *, fewest: int = 5) -> tuple[float, ...]:
    """The share of (N,) pixels that are `here`, at equally spaced signals: the arcsine of its root, which is as uncertain at any
    share, is a spline as smooth as cross-validation asks."""
    known, least = signal.cpu().double().numpy(), 0.5 / len(here)  # no share is known better
    place = np.histogram_bin_edges(known, GROUPS).searchsorted(known).clip(1, GROUPS) - 1
    total, found, signals = (np.bincount(place, each, GROUPS) for each in (None, here.cpu().numpy(), known))
    some, nodes = total > 0, np.linspace(known.min(), known.max(), GROUPS + 1)
    share, middle = found[some] / total[some], signals[some] / total[some]
    if len(share) < fewest:  # of a spline
        return (float(found.sum() / len(known)),) * 2
    root = scipy.interpolate.make_smoothing_spline(middle, np.arcsin(np.sqrt(share)), total[some])(nodes)
    return tuple((np.sin(root.clip(0, np.pi / 2)) ** 2).clip(least, 1 - least).tolist())
