"""Rounding and clipping for any noise model: the likelihood is the probability of an interval, not a density."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.pixels import Signal, given_to, values_of
from noiseflow.distributions.wrappers.coded import CodedDistribution, matching_edges
from noiseflow.distributions.wrappers.digitised import DigitisedDistribution as DigitisedDistribution
from noiseflow.fitting.cells import in_ranges
from noiseflow.models.base import Behind
from noiseflow.models.digitisation import GROUPS, MOST_CODES
from noiseflow.models.standardisation import LEAST_PIXELS
from noiseflow.models.wrapper import ModelAround, of_inner

# Most ranges of signals that represent all pixels in the adjustment of levels.
_GROUPS = 256
# Probability of an uneven histogram of codes by chance, below which it is that of the converter.
_CHANCE = 1e-6


class Digitised(ModelAround):
    """A noise model followed by a converter that rounds to steps and clips at limits.

    An observation k represents all values in (k − step/2, k + step/2]; a clipping limit represents all values beyond it.

    Args:
        model: the noise model before digitisation.
        step: rounding step, detector units; 0 for pixel values that are clipped but not rounded.
        low, high: clipping limits, detector units; infinite if there is none.
        origin: one of the levels, which are whole steps apart; `low` is one if it is finite.
        levels: the levels, increasing, if they are not equally spaced, as for values that were stored as square roots. The
            other arguments then have no effect.
        edges: the values before the converter that separate these levels; midpoints by default. Fits adjust them, so that
            each level is as frequent as in the data, also of equal levels whose codes are not equally wide.

    Raises:
        ValueError: the step is negative, limits, levels or edges are in the wrong order, or the model has row or column offsets.

    Example:
        >>> import noiseflow, torch
        >>> camera = noiseflow.Digitised(noiseflow.Gaussian(3.0), step=1.0, low=0.0, high=255.0)
        >>> frame = camera(torch.full((4, 4), 254.0)).sample(generator=torch.Generator().manual_seed(0))
        >>> frame.max().item(), bool((frame == frame.round()).all())
        (255.0, True)
    """

    describes_single_readings = True
    without_converter = of_inner("without_converter")
    step: float = math.nan  # set by __init__; these attributes hide those of the inner model
    low: float = math.nan
    high: float = math.nan
    origin: float = math.nan
    levels: Tensor
    edges: Tensor

    def __init__(
        self,
        model: nn.Module,
        step: float = 1.0,
        low: float = -math.inf,
        high: float = math.inf,
        origin: float = 0.0,
        levels: Sequence[float] = (),
        edges: Sequence[float] = (),
    ) -> None:
        super().__init__(model)
        check(step=step)
        if not low < high:
            raise ValueError(f"low is {low} and high is {high}; the low clipping limit must be below the high one")
        if self.model.shared_axis is not None:
            raise ValueError("offsets of rows are added before rounding: write ScanNoise(Digitised(model, …)) instead")
        self.step, self.low, self.high = float(step), float(low), float(high)
        self.origin = self.low if math.isfinite(self.low) else float(origin)
        places = np.asarray(levels, np.float64)
        between = np.asarray(edges, np.float64) if len(edges) else (places[1:] + places[:-1]) / 2
        increasing = all((np.diff(each) > 0).all() for each in (places, between))
        if not increasing or places.size == 1 or between.size != max(0, places.size - 1):
            raise ValueError("levels and edges must increase, with one edge between two levels; give sorted values")
        where = next((each.device for each in (*self.model.parameters(), *self.model.buffers())), None)
        self.register_buffer("levels", torch.tensor(places, device=where), persistent=False)
        self.register_buffer("edges", torch.tensor(between, device=where), persistent=False)

    def around(self, model: nn.Module) -> Digitised:
        """The same converter behind another model."""
        return Digitised(model, **self.config())

    def _after(
        self, base: NoiseDistribution, signal: Tensor | None = None
    ) -> CodedDistribution | DigitisedDistribution:
        if self.levels.numel():
            return CodedDistribution(self.levels, self.edges, base)
        return DigitisedDistribution(self, base, signal)

    def forward(self, signal: Signal) -> NoiseDistribution:
        return self._after(self.model(given_to(self.model, signal)), values_of(signal))

    def at_read_noise(self, signal: Signal, read_noise: Tensor) -> NoiseDistribution:
        return self._after(self.model.at_read_noise(given_to(self.model, signal), read_noise))

    def without_rails(self) -> Digitised:
        """The same detector and inner model, with rounding but without clipping."""
        if self.levels.numel():
            return self
        return Digitised(self.model, step=self.step, origin=self.origin)

    @torch.no_grad()
    def match_levels(self, signal: Signal, observation: Tensor) -> bool:
        values = values_of(signal)
        levels = self.levels if self.levels.numel() else self._equal_levels(observation)
        if not levels.numel() or self.model.needs_image:
            return self.model.match_levels(signal, observation)
        place = torch.bucketize(observation.double(), (levels[1:] + levels[:-1]) / 2)
        counts = torch.bincount(place, minlength=levels.numel()).double()
        row = in_ranges(values.double(), observation.double())
        row = torch.floor(row * min(1.0, _GROUPS / (float(row.max()) + 1))).long()
        size = torch.bincount(row)
        level = torch.bincount(row, values.double())[size > 0] / size[size > 0]
        weight = (size[size > 0] / values.numel()).double()
        edges, chance = matching_edges(self.model, level, weight, counts, levels)
        if not self.levels.numel() and chance > _CHANCE:
            return False
        self.levels, self.edges = levels, edges
        return True

    def _equal_levels(self, observation: Tensor) -> Tensor:
        """Few equal levels, as far beyond the observations as these reach unless they are clipped; none if there are many."""
        low, high = (float(each) for each in torch.aminmax(observation))
        if not 2 * self.step < high - low < MOST_CODES * self.step:
            return self.levels
        low, high = max(self.low, 2 * low - high), min(self.high, 2 * high - low)
        count = round((high - low) / self.step) + 1
        return low + self.step * torch.arange(count, dtype=torch.float64, device=observation.device)

    @property
    def settles(self) -> bool:
        return self.model.settles and not self.model.needs_image

    def standardise(self, signal: Signal, observation: Tensor, *, settle: bool = True) -> None:
        """Standardise the inner model on those of the (N,) pixels that clipping does not affect, if they suffice."""
        values, by_level = values_of(signal), self.model.standardises_by_level
        kept, seen = self._before_rails(values, observation, mirror=by_level)
        if int(kept.sum()) < max(LEAST_PIXELS, 0.1 * kept.numel()):
            kept, seen = torch.ones_like(kept), observation
        options: dict[str, Any] = {"span": (float(values.min()), float(values.max()))} if by_level else {}
        options |= {"settle": False} if self.settles else {}
        self.model.standardise(given_to(self.model, signal[kept]), seen[kept], **options)
        if settle:  # digitisation biases the standardisation; settle accounts for it
            self.settle(values, observation)

    def settle(self, signal: Tensor, observation: Tensor, behind: Behind | None = None) -> None:
        """Set the maximum-likelihood parameters of the inner model behind this converter, and the edges of its levels."""
        if self.model.needs_image:
            return
        if self.settles and self.levels.numel():
            self.match_levels(signal, observation)
        self.model.settle(signal, observation, self.around)
        if self.settles:
            self.match_levels(signal, observation)

    def _before_rails(
        self, signal: Tensor, observation: Tensor, *, mirror: bool, few: float = 0.02
    ) -> tuple[Tensor, Tensor]:
        """Boolean mask of pixels that clipping does not affect, and their pixel values. The pixels are divided into 64 equally
        populated groups by signal; groups with few clipped values are kept. If one limit clips, `mirror` keeps the
        residuals on the other side of the signal and mirrors half of them, so that their width is that of the noise."""
        kept, seen = torch.ones_like(observation, dtype=torch.bool), observation.clone()
        within = (signal > self.low) & (signal < self.high)
        for group in torch.tensor_split(torch.argsort(signal), GROUPS):
            railed = observation[group] <= self.low, observation[group] >= self.high
            on_low, on_high = (float(each.float().mean()) > few for each in railed)
            kept[group] = not (on_low or on_high)
            if mirror and on_low != on_high:
                deviation = observation[group] - signal[group]
                free = group[within[group] & (deviation > 0 if on_low else deviation < 0)]
                kept[free] = True
                seen[free[::2]] = 2 * signal[free[::2]] - observation[free[::2]]
        return kept, seen

    def fixed_part(self, signal: Tensor, observation: Tensor, upto: Tensor | None = None) -> Tensor | None:
        """The part of the likelihood of (N,) pixels that training does not change; None if there is none."""
        if upto is not None:
            return None
        if self.step > 0 or self.levels.numel():
            ends = self._after(self.model(signal[:0])).represents(observation)
            return self.model.fixed_part(signal, *(end.to(observation) for end in ends))
        # pixel values between the limits have a density; their interval (the whole line) is not used
        on_low, on_high = observation <= self.low, observation >= self.high
        low = torch.full_like(observation, -math.inf).masked_fill(on_high, self.high)
        high = torch.full_like(observation, math.inf).masked_fill(on_low, self.low)
        interval, density = (self.model.fixed_part(signal, *each) for each in ((low, high), (observation,)))
        if interval is None or density is None:
            return None
        return torch.cat([interval, density, (on_low | on_high)[:, None].to(interval.dtype)], -1)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels from their `fixed_part`."""
        found = self.model.log_prob_from(signal, fixed_part[:, :3])
        if self.step > 0 or self.levels.numel():
            return found
        return torch.where(fixed_part[:, 5] > 0, found, self.model.log_prob_from(signal, fixed_part[:, 3:5]))

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this model, without the inner model."""
        if self.levels.numel():
            return {"step": self.step, "levels": self.levels.tolist(), "edges": self.edges.tolist()}
        rails = {name: rail for name, rail in (("low", self.low), ("high", self.high)) if math.isfinite(rail)}
        return {"step": self.step} | rails | ({"origin": self.origin} if self.origin and "low" not in rails else {})

    def extra_repr(self) -> str:
        coded = f"{self.levels.numel()} unequal levels"
        return coded if self.levels.numel() else f"step={self.step:g}, low={self.low:g}, high={self.high:g}"
