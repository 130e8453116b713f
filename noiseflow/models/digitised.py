"""Rounding and saturation around any noise model: the likelihood of an interval instead of a density at a point."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions.digitised import DigitisedDistribution as DigitisedDistribution
from noiseflow.distributions.picked import Signal, given_to, values_of
from noiseflow.models.around import ModelAround
from noiseflow.models.base import NoiseModelBase

_LEAST_KEPT, _RAILED = 256, 0.02


class Digitised(ModelAround):
    """A detector that rounds to steps and clips at limits, in front of any noise model.

    An observation k stands for every pixel value in (k − step/2, k + step/2]; the limits stand for everything beyond.

    Args:
        model: the noise model before digitisation.
        step: rounding step, detector units; 0 for pixel values that are clipped but not rounded.
        low, high: clipping limits, detector units; infinite where there is none.

    Raises:
        ValueError: negative step, or clipping limits in the wrong order, or a model with offsets of rows or columns.

    Example:
        >>> import noiseflow, torch
        >>> camera = noiseflow.Digitised(noiseflow.Gaussian(3.0), step=1.0, low=0.0, high=255.0)
        >>> frame = camera(torch.full((4, 4), 254.0)).sample(generator=torch.Generator().manual_seed(0))
        >>> frame.max().item(), bool((frame == frame.round()).all())
        (255.0, True)
    """

    describes_single_readings = True
    step: float = math.nan  # set when a model is made; here they hide the inner model's
    low: float = math.nan
    high: float = math.nan

    def __init__(self, model: nn.Module, step: float = 1.0, low: float = -math.inf, high: float = math.inf) -> None:
        super().__init__(model)
        if step < 0:
            raise ValueError(f"step is {step}; give a positive rounding step, or 0 for clipping without rounding")
        if not low < high:
            raise ValueError(f"low is {low} and high is {high}; the low clipping limit must lie below the high one")
        if self.model.shared_axis is not None:
            raise ValueError("offsets of rows are added before rounding: write ScanNoise(Digitised(model, …)) instead")
        self.step, self.low, self.high = float(step), float(low), float(high)

    def forward(self, signal: Signal) -> DigitisedDistribution:
        return DigitisedDistribution(self, self.model(given_to(self.model, signal)), values_of(signal))

    def at_read_noise(self, signal: Signal, read_noise: Tensor) -> DigitisedDistribution:
        return DigitisedDistribution(self, self.model.at_read_noise(given_to(self.model, signal), read_noise))

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
        """Which pixels the clipping limits leave as they were, boolean, and their pixel values.

        Of 64 equally populated groups by signal, those are kept of which hardly any pixel value is clipped. Where one
        clipping limit clips, `mirror` keeps what lies on the other side of the signal, half of it mirrored: it is as wide as
        the noise was.
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
        # a high limit between two levels has only what rounds to the level above it
        edge = self.forward(signal[:0]).edges[1]
        below = torch.where(on_high, edge, below) if math.isfinite(edge) else below
        low, high = torch.where(on_low, -math.inf, below), torch.where(on_high, math.inf, above)
        if self.step > 0:
            return self.model.fixed_interval_part(signal, low, high)
        # pixel values between the clipping limits have a density: their interval is the whole line, and is not used
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
