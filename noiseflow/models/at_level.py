"""Noise models of detectors that add a large constant, evaluated without it to preserve float32 precision."""

import torch
from torch import Tensor, nn

from noiseflow.arguments import check
from noiseflow.distributions.image_pixels import Signal, given_to, values_of
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.baselines import Poisson
from noiseflow.models.digitised import Digitised
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

    level: float = 0.0
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

    Rounding and clipping remain the outermost terms.

    Args:
        model: single-pixel noise model.
        level: constant level, detector units.
    """
    if isinstance(model, Digitised):
        low, high, origin = model.low + level, model.high + level, model.origin + level
        coded = ((each + level).tolist() for each in (model.levels, model.edges))
        return Digitised(at_level(model.model, level), model.step, low, high, origin, *coded)
    if isinstance(model, Poisson):
        return Poisson(float(model.log_gain.exp()), float(model.offset) + level, spread=model.spread)
    return AtLevel(model, level)
