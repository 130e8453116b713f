"""Rounding and saturation around any noise model: the likelihood of an interval instead of a density at a point."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions import tabulated
from noiseflow.distributions.base import NoiseDistribution
from noiseflow.distributions.picked import Signal, given_to, values_of
from noiseflow.models.around import ModelAround
from noiseflow.models.base import NoiseModelBase

_MOMENT_NODES = 257
_MOMENT_COUNT = 2**18
_LEAST_KEPT, _RAILED = 256, 0.02


class Digitised(ModelAround):
    """A detector that rounds to steps and clips at rails, in front of any noise model.

    An observation k stands for every reading in (k − step/2, k + step/2]; the rails stand for everything beyond them too.

    Args:
        model: the noise model before digitisation.
        step: rounding step, detector units; 0 for readings that are clipped but not rounded.
        low, high: rails, detector units; infinite where there is none.

    Raises:
        ValueError: negative step, or rails in the wrong order, or a model with offsets of rows or columns.
    """

    describes_single_readings = True
    step: float = 1.0
    low: float = -math.inf
    high: float = math.inf

    def __init__(self, model: nn.Module, step: float = 1.0, low: float = -math.inf, high: float = math.inf) -> None:
        super().__init__(model)
        if step < 0:
            raise ValueError(f"step is {step}; give a positive rounding step, or 0 for clipping without rounding")
        if not low < high:
            raise ValueError(f"low is {low} and high is {high}; the low rail must lie below the high one")
        if self.model.shared_axis is not None:
            raise ValueError("offsets of rows are added before rounding: write ScanNoise(Digitised(model, …)) instead")
        self.step, self.low, self.high = float(step), float(low), float(high)

    def forward(self, signal: Signal) -> DigitisedDistribution:
        return DigitisedDistribution(self, self.model(given_to(self.model, signal)), values_of(signal))

    def without_rails(self) -> Digitised:
        """The same detector with the same model inside, rounding but never clipping."""
        return Digitised(self.model, step=self.step)

    def standardise(self, signal: Signal, observation: Tensor) -> None:
        """Standardise the model inside, on what of the (N,) pixels clipping leaves as it was, where that is enough."""
        values, by_level = values_of(signal), self.model.standardises_by_level
        kept, seen = self._before_rails(values, observation, mirror=by_level)
        if int(kept.sum()) < max(_LEAST_KEPT, 0.1 * kept.numel()):
            kept, seen = torch.ones_like(kept), observation
        span = {"span": (float(values.min()), float(values.max()))} if by_level else {}
        self.model.standardise(given_to(self.model, signal[kept]), seen[kept], **span)
        if not self.model.needs_image:  # the converter spoils what it was standardised on; now its part is known
            self.model.settle(values, observation, lambda inner: Digitised(inner, self.step, self.low, self.high))

    def _before_rails(self, signal: Tensor, observation: Tensor, *, mirror: bool) -> tuple[Tensor, Tensor]:
        """Which pixels the rails leave as they were, boolean, and their readings.

        Of 64 equally populated groups by signal, those are kept of which hardly any reading is clipped. Where one rail clips,
        `mirror` keeps what lies on the other side of the signal, half of it mirrored: it is as wide as the noise was.
        """
        kept, seen = torch.ones_like(observation, dtype=torch.bool), observation.clone()
        within = (signal > self.low) & (signal < self.high)
        for group in torch.tensor_split(torch.argsort(signal), 64):
            on_low, on_high = (
                float(railed.float().mean()) > _RAILED
                for railed in (observation[group] <= self.low, observation[group] >= self.high)
            )
            kept[group] = not (on_low or on_high)
            if mirror and on_low != on_high:
                deviation = observation[group] - signal[group]
                free = group[within[group] & (deviation > 0 if on_low else deviation < 0)]
                kept[free] = True
                seen[free[::2]] = 2 * signal[free[::2]] - observation[free[::2]]
        return kept, seen

    def fixed_part(self, signal: Tensor, observation: Tensor) -> Tensor | None:
        """What of the likelihood of (N,) pixels does not change while the model inside learns; None where everything may."""
        on_low, on_high = observation <= self.low, observation >= self.high
        below, above = (observation - self.step / 2, observation + self.step / 2)
        low, high = torch.where(on_low, -math.inf, below), torch.where(on_high, math.inf, above)
        if self.step > 0:
            return self.model.fixed_interval_part(signal, low, high)
        # readings between the rails have a density: their interval is the whole line, and is not used
        on_rail = on_low | on_high
        low, high = torch.where(on_rail, low, -math.inf), torch.where(on_rail, high, math.inf)
        interval, density = (
            self.model.fixed_interval_part(signal, low, high),
            self.model.fixed_part(signal, observation),
        )
        if interval is None or density is None:
            return None
        return torch.cat([interval, density, on_rail[:, None].to(interval.dtype)], -1)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels by their `fixed_part`."""
        found = self.model.log_interval_prob_from(signal, fixed_part[:, :3])
        if self.step > 0:
            return found
        between = self.model.log_prob_from(signal, fixed_part[:, 3:5])
        return torch.where(fixed_part[:, 5] > 0, found, between)

    def without_converter(self) -> NoiseModelBase:
        return self.model.without_converter()

    def config(self) -> dict[str, Any]:
        """The arguments that make this model again, besides the model inside."""
        rails = {"low": self.low, "high": self.high}
        return {"step": self.step} | {name: rail for name, rail in rails.items() if math.isfinite(rail)}

    def extra_repr(self) -> str:
        return f"step={self.step:g}, low={self.low:g}, high={self.high:g}"


class DigitisedDistribution(NoiseDistribution):
    """A rounded and clipped distribution. ``log_prob`` is a log-mass on the rails and, with a step, on every level.

    With ``step = 0`` the readings between the rails keep their log-density.
    """

    def __init__(self, detector: Digitised, base: NoiseDistribution, signal: Tensor | None = None) -> None:
        super().__init__(base.batch_shape)
        self.base = base
        self.step, self.low, self.high = detector.step, detector.low, detector.high
        self._detector, self._signal = detector, signal

    def rescaled(self, scale: Tensor, shift: Tensor) -> DigitisedDistribution:
        return DigitisedDistribution(self._detector, self.base.rescaled(scale, shift))

    def log_prob(self, value: Tensor) -> Tensor:
        found = None if self._signal is None else tabulated.automatic_log_prob(self._detector, self._signal, value)
        if found is not None:
            return found
        inside = value.clamp(self.low, self.high)  # what lies beyond a rail is not used, and must not spoil a gradient
        on_low, on_high = value <= self.low, value >= self.high
        between, half = self.step == 0, self.step / 2
        result = self.base.log_prob(inside) if between else self.base.log_interval_prob(inside - half, inside + half)
        if between and value.shape == self.batch_shape and math.isfinite(self.low) and math.isfinite(self.high):
            low = torch.full_like(inside, self.high).masked_fill(on_low, -math.inf)
            high = torch.full_like(inside, math.inf).masked_fill(on_low, self.low)
            return torch.where(on_low | on_high, self.base.log_interval_prob(low, high), result)
        # the mass of a rail depends on the signal alone, so it has the batch's shape, which may be smaller than the values'
        infinity = torch.full(self.batch_shape, math.inf, dtype=value.dtype, device=value.device)
        if math.isfinite(self.low):
            mass = self.base.log_interval_prob(-infinity, torch.full_like(infinity, self.low + half))
            result = torch.where(on_low, mass, result)
        if math.isfinite(self.high):
            mass = self.base.log_interval_prob(torch.full_like(infinity, self.high - half), infinity)
            result = torch.where(on_high, mass, result)
        return result

    def log_interval_prob(self, low: Tensor, high: Tensor) -> Tensor:
        return self.base.log_interval_prob(self._edge(low), self._edge(high))

    def cdf(self, value: Tensor) -> Tensor:
        return self._base_cdf(self._edge(value))

    def cdf_below(self, value: Tensor) -> Tensor:
        edge = self._level(value, torch.ceil) - self.step / 2 if self.step > 0 else value
        edge = torch.where(value <= self.low, torch.full_like(edge, -math.inf), edge)
        return self._base_cdf(torch.where(value > self.high, torch.full_like(edge, math.inf), edge))

    def _base_cdf(self, edge: Tensor) -> Tensor:
        finite = torch.isfinite(edge)
        inside = self.base.cdf(torch.where(finite, edge, torch.zeros_like(edge)))
        return torch.where(finite, inside, (edge > 0).to(inside.dtype))

    def _edge(self, value: Tensor) -> Tensor:
        """The undigitised reading below which everything is digitised to at most `value`."""
        edge = self._level(value, torch.floor) + self.step / 2 if self.step > 0 else value
        edge = torch.where(value < self.low, torch.full_like(edge, -math.inf), edge)
        return torch.where(value >= self.high, torch.full_like(edge, math.inf), edge)

    def _level(self, value: Tensor, rounding: Callable[[Tensor], Tensor]) -> Tensor:
        origin = self.low if math.isfinite(self.low) else 0.0
        steps = (value - origin) / self.step
        nearest = torch.round(steps)
        on_level = (steps - nearest).abs() < 1e-3  # a level itself must not leave itself by rounding error
        level: Tensor = torch.where(on_level, nearest, rounding(steps))
        return level * self.step + origin

    def digitise(self, value: Tensor) -> Tensor:
        """Round and clip undigitised readings."""
        rounded = self._level(value, torch.round) if self.step > 0 else value
        return rounded.clamp(self.low, self.high)

    def icdf(self, value: Tensor) -> Tensor:
        return self.digitise(self.base.icdf(value))

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        return self.digitise(self.base.sample(sample_shape, generator))

    @property
    def mean(self) -> Tensor:
        return torch.stack([values.sum(0) for values in self._quantiles()]).sum(0) / _MOMENT_NODES

    @property
    def variance(self) -> Tensor:
        parts = list(self._quantiles())
        mean = torch.stack([values.sum(0) for values in parts]).sum(0) / _MOMENT_NODES
        return torch.stack([((values - mean) ** 2).sum(0) for values in parts]).sum(0) / _MOMENT_NODES

    def _quantiles(self) -> Iterator[Tensor]:
        """Readings at equally likely places, (some, *batch) at a time."""
        nodes = (torch.arange(_MOMENT_NODES, dtype=torch.float64) + 0.5) / _MOMENT_NODES
        at_once = max(1, _MOMENT_COUNT // max(1, math.prod(self.batch_shape)))
        for part in torch.split(nodes.float(), at_once):
            yield self.icdf(part.view(-1, *[1] * len(self.batch_shape)).expand(-1, *self.batch_shape))
