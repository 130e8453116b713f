"""Noise models of detectors that add a large constant, evaluated without it to preserve float32 precision."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn

from noiseflow.arguments import check, check_precision, noise_width, resolved_in_single
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.pixels import Signal, given_to, values_of
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.baselines import Poisson
from noiseflow.models.conditioned import Conditioned
from noiseflow.models.digitised import Digitised
from noiseflow.models.stuck_pixels import StuckPixels
from noiseflow.models.wrapper import ModelAround


class AtLevel(ModelAround):
    """A noise model of signals and observations above a constant level.

    The observation at a signal s is that of the inner model at s − level, plus the level.

    Args:
        model: single-pixel noise model of values above the level, without rounding and clipping; see `at_level`.
        level: constant level, detector units.

    Raises:
        ValueError: the model needs images, or rounds or clips.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.AtLevel(noiseflow.Gaussian(2.0), level=1000.0)
        >>> noise(torch.tensor(1005.0)).mean.item()
        1005.0
    """

    level: float
    settings = ("level",)

    def __init__(self, model: nn.Module, level: float = 0.0) -> None:
        super().__init__(model)
        check(level=level)
        if self.model.needs_image or self.model.describes_single_readings:
            raise ValueError(
                "AtLevel must be the innermost model: put rounding, clipping and image terms around AtLevel(model, level)"
            )
        self.level = float(level)

    def forward(self, signal: Signal) -> NoiseDistribution:
        values = values_of(signal)
        base: NoiseDistribution = self.model(values - self.level)
        return base.rescaled(torch.ones_like(values), torch.full_like(values, self.level))

    def standardise(self, signal: Signal, observation: Tensor) -> None:
        self.model.standardise(given_to(self.model, values_of(signal) - self.level), observation - self.level)

    @property
    def one_pixel(self) -> NoiseModelBase:
        return self

    @property
    def fitted_range(self) -> tuple[float, float] | None:
        inside = self.model.fitted_range
        return None if inside is None else (inside[0] + self.level, inside[1] + self.level)

    @fitted_range.setter
    def fitted_range(self, found: tuple[float, float]) -> None:
        self.model.fitted_range = found[0] - self.level, found[1] - self.level


def at_level(model: NoiseModelBase, level: float) -> NoiseModelBase:
    """Convert a noise model that was fitted to values above a level to one of the values themselves.

    Rounding and clipping remain the outermost terms. A model at the opposite level is taken out of its `AtLevel`.

    Args:
        model: single-pixel noise model.
        level: constant level, detector units.
    """
    if not level:
        return model
    if isinstance(model, Digitised):
        low, high, origin = model.low + level, model.high + level, model.origin + level
        coded = ((each + level).tolist() for each in (model.levels, model.edges))
        return Digitised(at_level(model.model, level), model.step, low, high, origin, *coded)
    if isinstance(model, StuckPixels):
        span = [end + level for end in model.span]
        return StuckPixels(at_level(model.model, level), model.level + level, model.share, span)
    if isinstance(model, Conditioned):
        return model.of_each(partial(at_level, level=level), model.values)
    if isinstance(model, Poisson):
        raised, ends = copy.deepcopy(model), model.fitted_range
        raised.offset.data += level
        raised._fitted_range = ends and (ends[0] + level, ends[1] + level)
        return raised
    inner, level = (model.model, level + model.level) if isinstance(model, AtLevel) else (model, level)
    return AtLevel(inner, level) if level else inner


def without_level(model: NoiseModelBase) -> NoiseModelBase:
    """The model of values above its `AtLevel`, if it has one."""
    return at_level(model, -next((part.level for part in model.modules() if isinstance(part, AtLevel)), 0.0))


def level_of(signal: Tensor, observation: Tensor, models: Sequence[NoiseModelBase]) -> float:
    """The level above which single precision resolves the noise of finite (N,) pixels; 0 if it does without, or at no level.

    Raises:
        ValueError: the number format does not resolve the noise, or single precision does not and a model needs images.
    """
    check_precision(signal, observation)
    if resolved_in_single(signal, observation):
        return 0.0
    if any(model.needs_image for model in models):
        check_precision(signal.float(), observation.float())
        return 0.0
    low, high = (float(end) for end in torch.aminmax(signal))
    # whole steps of the level leave whole numbers whole
    unit = 2.0 ** math.floor(math.log2(max(high - low, noise_width(signal, observation))))
    level = unit * math.floor(low / unit)
    return level if abs(level) > high - low else 0.0


def above(level: float, *values: Tensor) -> list[Tensor]:
    """Pixel values above a level, which is subtracted in double precision."""
    if not level:
        return list(values)
    kinds = (each.dtype if each.is_floating_point() else torch.float64 for each in values)
    return [(each.double() - level).to(kind) for each, kind in zip(values, kinds, strict=True)]
