"""Noise models that wrap other noise models, and modules of other libraries as noise models."""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.arrays import HALF
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.pixels import Signal, values_of
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.standardisation import Standardisation


class ModelAround(NoiseModelBase):
    """Base class of noise models that wrap another one. Properties are taken from the inner model unless overridden.

    Args:
        model: the inner noise model.

    Raises:
        TypeError: `model` is not a module.
    """

    model: NoiseModelBase

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = as_noise_model(model)


def of_inner(name: str) -> property:
    """A trait that a wrapper takes from its inner model, and sets there."""
    return property(lambda self: getattr(self.model, name), lambda self, value: setattr(self.model, name, value))


_TRAITS = """
needs_image neighbourhood shared_axis describes_single_readings tabulate one_pixel starts_most_likely fits_directly costly
roughness learning_rate num_steps joint_learning_rate most_joint_steps starts_anew fitted_range
"""
for _name in _TRAITS.split():
    setattr(ModelAround, _name, of_inner(_name))


class DensityAround(ModelAround):
    """Base class of models around a density of single pixels, which describes a function of the observations. Raises ValueError
    if the inner model needs images or has discrete values."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__(model)
        if self.model.describes_single_readings or self.model.needs_image:
            raise ValueError(
                f"{type(self.model).__name__} is no model of single pixels with a density; put it around "
                f"{type(self).__name__} instead"
            )
        self.scale = Standardisation().to(self.model.device)

    @abstractmethod
    def inside(self, signal: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        """What the inner model describes of (N,) pixels, and its log-derivative."""

    @torch.no_grad()
    def fixed_part(self, signal: Tensor, observation: Tensor, upto: Tensor | None = None) -> Tensor | None:
        """What the inner model describes, in standard deviations and as is, and its log-derivative; None for intervals."""
        if upto is not None:
            return None
        inner, ladj = self.inside(signal, observation)
        location, log_scale = self.scale(self.scale.coordinate(signal.double()))
        return torch.stack([(inner - signal - location) * torch.exp(-log_scale), inner, ladj], -1)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels from their `fixed_part`."""
        found: Tensor = self.model(signal).log_prob(fixed_part[:, 1]) + fixed_part[:, 2]
        return found.to(signal.dtype)


class ForeignModel(NoiseModelBase):
    """Any module that returns a distribution for signals, as a noise model with default properties.

    Half-precision signals are passed in single precision, unless the parameters of the module are in half precision. Infinite
    signals are passed as NaN.

    Args:
        module: called with signals; returns a distribution of one observation per signal.
    """

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, signal: Signal) -> NoiseDistribution:
        values = values_of(signal)
        if not values.is_floating_point():
            return as_noise_distribution(self.module(values))
        own = next((p.dtype for p in self.module.parameters() if p.is_floating_point()), torch.float32)
        working = values.to(torch.promote_types(values.dtype, own if own in HALF else torch.float32))
        working = torch.where(torch.isfinite(working), working, torch.full_like(working, math.nan))
        return as_noise_distribution(self.module(working), like=values)

    def standardise(self, signal: Signal, observation: Tensor) -> None:
        """Call ``standardise`` of the module if it has one."""
        own: Callable[..., Any] | None = getattr(self.module, "standardise", None)
        if own is not None:
            own(values_of(signal), observation)


def as_noise_model(module: nn.Module) -> NoiseModelBase:
    """Return the module if it is a noise model, otherwise wrap it in `ForeignModel`. Raises TypeError if the argument is not a
    module."""
    if not isinstance(module, nn.Module):
        raise TypeError(f"a noise model is a torch module, not {type(module).__name__}; derive it from NoiseModelBase")
    return module if isinstance(module, NoiseModelBase) else ForeignModel(module)
