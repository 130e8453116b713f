"""What a noise model is: `NoiseModelBase`, one abstract method and every other trait with its default."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.array_distribution import distribution_of_array
from noiseflow.arrays import is_array
from noiseflow.distributions.base import NoiseDistribution
from noiseflow.distributions.numerical import as_noise_distribution


class Described(nn.Module):
    """A module whose repr is one line: its settings, the described modules inside, and its units.

    Attributes:
        measured_in: units of what the module takes or gives.
    """

    measured_in: str = "detector units"

    def summary(self) -> str:
        """The settings, then the described modules inside, then how many parameters there are."""
        inside = [repr_without_units(child) for child in self.children() if isinstance(child, Described)]
        count = sum(parameter.numel() for parameter in self.parameters())
        parts = [self.extra_repr(), *inside, f"{count} parameters" if count > 8 else ""]
        return ", ".join(part for part in parts if part)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.summary()}, units={self.measured_in!r})"


def repr_without_units(module: Described) -> str:
    """A module inside another one, whose units are those of the whole."""
    return f"{type(module).__name__}({module.summary()})"


class NoiseModelBase(Described, ABC):
    """A conditional density p(observation | signal): the contract of every noise model.

    A model defines `forward`. Everything else has a default that serves any model; override what is known better, a property by
    a class attribute of the same name. What a property says holds for the model as a whole, models inside it included.

    Example:
        >>> import noiseflow, torch
        >>> class Laplace(noiseflow.NoiseModelBase):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.raw = torch.nn.Parameter(torch.zeros(()))
        ...     def forward(self, signal):
        ...         return torch.distributions.Laplace(signal, self.raw.exp().expand(signal.shape))
        >>> Laplace()(torch.tensor([2.0, 3.0])).variance
        tensor([2., 2.], grad_fn=<MulBackward0>)
    """

    @abstractmethod
    def forward(self, signal: Any) -> NoiseDistribution:
        """The distribution of the observations of pixels with the given signals.

        Args:
            signal: clean signals, any shape, detector units; for a model that `needs_image`, images (..., y, x) or a
                `PickedSignal`.

        Returns:
            A distribution with ``batch_shape == signal.shape`` and ``event_shape == ()``.
        """

    def __call__(self, signal: Any) -> Any:
        """As `forward`; numbers and arrays of any library are taken too, and the distribution then takes and gives arrays."""
        if is_array(signal):
            return distribution_of_array(self, signal, needs_image=self.needs_image)
        return as_noise_distribution(super().__call__(signal))

    # What the model looks at

    @property
    def needs_image(self) -> bool:
        """Whether the model looks beyond single pixels, so that it takes images (..., y, x); False."""
        return False

    @property
    def neighbourhood(self) -> int:
        """Side, odd, of the window of clean signals around each pixel that the model looks at; 1."""
        return 1

    @property
    def shared_axis(self) -> int | None:
        """The axis of an image, −1 or −2, along which pixels share a random offset; None where pixels are independent."""
        return None

    def at_read_noise(self, signal: Any, read_noise: Tensor) -> NoiseDistribution:
        """As `forward`, of pixels that have a read noise of their own in place of the model's.

        Args:
            signal: as in `forward`.
            read_noise: of each pixel, detector units rms, shape of the signal.

        Raises:
            ValueError: the model has no read noise of single pixels.
        """
        raise ValueError(
            f"{type(self).__name__} has no read noise that pixels could have of their own; use a PoissonGaussian, or leave "
            "the map of variance out"
        )

    # Rounding and clipping

    @property
    def describes_single_readings(self) -> bool:
        """Whether single pixel values have a mass, as rounded or counted ones do; False: the model is a density.

        `fit` puts rounding and clipping around a model that is a density.
        """
        return False

    @property
    def step(self) -> float:
        """Rounding step, detector units; 0 where pixel values are not rounded."""
        return 0.0

    @property
    def low(self) -> float:
        """Lower clipping limit, detector units; −∞ where there is none."""
        return -float("inf")

    @property
    def high(self) -> float:
        """Upper clipping limit, detector units; ∞ where there is none."""
        return float("inf")

    def without_rails(self) -> NoiseModelBase:
        """The same model, rounding as it does but never clipping; itself."""
        return self

    @property
    def one_pixel(self) -> NoiseModelBase:
        """The model of a pixel by itself, before rounding, clipping and what its place in an image adds; itself."""
        return self

    def without_converter(self) -> NoiseModelBase:
        """The model before rounding, clipping and the gains and offsets of single pixels; itself."""
        return self

    def behind(self, converter: Callable[[NoiseModelBase], NoiseModelBase]) -> NoiseModelBase:
        """This model with a converter, such as `Digitised`, put where it belongs; around the whole.

        Args:
            converter: takes a noise model and returns that model behind the converter.
        """
        return converter(self)

    # Where a fit starts, and how it goes on

    def standardise(self, signal: Any, observation: Tensor) -> None:
        """Measure the scaling of (N,) signals and observations, detector units, so that a fit starts near the data; nothing.

        A model with `standardises_by_level` takes the argument ``span`` too, the range (low, high) of signals to cover.
        """
        return

    @property
    def standardises_by_level(self) -> bool:
        """Whether `standardise` takes centre and width of the residuals at each signal level, and ``span``; False.

        Residuals mirrored about the signal serve such a model where clipping hides one side.
        """
        return False

    def settle(
        self, signal: Tensor, observation: Tensor, behind: Callable[[NoiseModelBase], NoiseModelBase] | None = None
    ) -> None:
        """Move to the most likely parameters, after `standardise`, where the model can find them directly; nothing.

        Args:
            signal, observation: (N,), detector units.
            behind: puts the model behind what stands in front of its values, such as rounding and clipping.
        """
        return

    @property
    def starts_most_likely(self) -> bool:
        """Whether `standardise` leaves little to learn, so that a few steps suffice; False."""
        return False

    @property
    def learning_rate(self) -> float:
        """Starting rate of a fit of the model to known signals; 0.01, for a model that starts near the data."""
        return 1e-2

    @property
    def num_steps(self) -> int:
        """Steps that a fit to known signals takes; 500."""
        return 500

    @property
    def joint_learning_rate(self) -> float:
        """Starting rate in a joint fit, in which the noise must keep up with the signal; 0.03."""
        return 3e-2

    @property
    def most_joint_steps(self) -> int | None:
        """Most steps of a fit to a signal that is itself an estimate; None for as many as asked for."""
        return None

    @property
    def starts_anew(self) -> bool:
        """Whether the model had better be standardised again whenever its signal has improved; False."""
        return False

    @property
    def learns(self) -> bool:
        """Whether anything of the model is trainable."""
        return any(parameter.requires_grad for parameter in self.parameters())

    @property
    def fitted_range(self) -> tuple[float, float] | None:
        """Least and greatest signal of the last fit, detector units; None where the model does not keep them."""
        return None

    # How its likelihood is computed

    tabulate: bool = True
    """Whether likelihoods and samples of large inputs may be looked up in tables; set it to False for exact ones at any size."""

    def fixed_part(self, signal: Tensor, observation: Tensor) -> Tensor | None:
        """What of the likelihood of (N,) pixels does not change while the model learns, (N, K); None where everything may."""
        return None

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of (N,) pixels by their `fixed_part`, which decides whether this is called."""
        raise NotImplementedError(f"{type(self).__name__} has a fixed_part, so it needs log_prob_from too")

    def fixed_interval_part(self, signal: Tensor, low: Tensor, high: Tensor) -> Tensor | None:
        """As `fixed_part`, of the likelihood of intervals (low, high]."""
        return None

    def log_interval_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of (N,) intervals by their `fixed_interval_part`, which decides whether this is called."""
        raise NotImplementedError(
            f"{type(self).__name__} has a fixed_interval_part: it needs log_interval_prob_from too"
        )

    # Files and places

    def config(self) -> dict[str, Any]:
        """The arguments, JSON can hold them, that make this model again besides its parameters and the models inside; none."""
        return {}

    @property
    def device(self) -> torch.device:
        """Where the parameters and buffers are; the CPU for a model without any."""
        tensors = (tensor for group in (self.parameters(), self.buffers()) for tensor in group)
        return next((tensor.device for tensor in tensors), torch.device("cpu"))


ArrayModel = NoiseModelBase
"""The name of `NoiseModelBase` in version 0.1; kept for one version."""
