"""`NoiseModelBase`, the base class of noise models: one abstract method, and defaults for the rest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.arrays import as_tensor, distribution_of_array, is_array
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.pixels import values_of
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.models.standardisation import Standardisation

Behind = Callable[["NoiseModelBase"], "NoiseModelBase"]
"""Function that wraps a noise model in later stages of the detector, such as rounding and clipping."""


class Described(nn.Module):
    """A module with a one-line repr: its settings, its described submodules and its units.

    Attributes:
        measured_in: units of the inputs and outputs of the module.
    """

    measured_in: str = "detector units"

    def summary(self) -> str:
        """The settings, the described submodules, and the number of parameters."""
        described = [child for child in self.children() if isinstance(child, Described)]
        inside = [f"{type(child).__name__}({child.summary()})" for child in described]  # in units of the whole
        count = sum(parameter.numel() for parameter in self.parameters())
        parts = [self.extra_repr(), *inside, f"{count} parameters" if count > 8 else ""]
        return ", ".join(part for part in parts if part)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.summary()}, units={self.measured_in!r})"


class NoiseModelBase(Described, ABC):
    """Base class of noise models, conditional densities p(observation | signal).

    A subclass must define `forward`. All other methods and properties have defaults that are valid for any model and can be
    overridden, properties also by a class attribute of the same name. A property describes the whole model, including inner
    models.

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
        """Return the distribution of the observations, given the signals of the pixels.

        Args:
            signal: clean signals, any shape, detector units; images (..., y, x) or a `PickedSignal` if the model
                `needs_image`.

        Returns:
            A distribution with ``batch_shape == signal.shape`` and ``event_shape == ()``.
        """

    def __call__(self, signal: Any) -> Any:
        """As `forward`, but also accepts numbers and arrays of any library; the distribution then takes and returns arrays."""
        if is_array(signal):
            return distribution_of_array(self, signal, needs_image=self.needs_image)
        as_tensor(values_of(signal))  # or an error that says what is wrong
        return as_noise_distribution(super().__call__(signal))

    # Input of the model

    @property
    def needs_image(self) -> bool:
        """Whether the model depends on more than single pixels and takes images (..., y, x). Default: False."""
        return False

    @property
    def neighbourhood(self) -> int:
        """Side (odd) of the window of clean signals around each pixel that the model uses. Default: 1."""
        return 1

    @property
    def shared_axis(self) -> int | None:
        """Image axis, −1 or −2, along which pixels share a random offset; None if pixels are independent (default)."""
        return None

    def at_read_noise(self, signal: Any, read_noise: Tensor) -> NoiseDistribution:
        """As `forward`, with a separate read noise for each pixel instead of that of the model.

        Args:
            signal: as in `forward`.
            read_noise: read noise of each pixel, detector units rms, shape of the signal.

        Raises:
            ValueError: the model has no read noise.
        """
        raise ValueError(
            f"{type(self).__name__} has no read noise that a variance map could replace; use a PoissonGaussian, or remove "
            "the variance map"
        )

    # Rounding and clipping

    @property
    def describes_single_readings(self) -> bool:
        """Whether pixel values are discrete and have probabilities, as for rounding or counting. Default: False (a density).

        `fit` wraps continuous models in `Digitised` if the data are rounded or clipped.
        """
        return False

    @property
    def step(self) -> float:
        """Rounding step, detector units; 0 if pixel values are not rounded (default)."""
        return 0.0

    @property
    def low(self) -> float:
        """Lower clipping limit, detector units; −∞ if there is none (default)."""
        return -float("inf")

    @property
    def high(self) -> float:
        """Upper clipping limit, detector units; ∞ if there is none (default)."""
        return float("inf")

    def without_rails(self) -> NoiseModelBase:
        """The same model with rounding but without clipping. Default: the model itself."""
        return self

    @property
    def one_pixel(self) -> NoiseModelBase:
        """The model of a single pixel, before rounding, clipping and position-dependent terms. Default: the model itself."""
        return self

    def without_converter(self) -> NoiseModelBase:
        """The model before rounding, clipping and per-pixel gains and offsets. Default: the model itself."""
        return self

    def behind(self, converter: Behind) -> NoiseModelBase:
        """This model with a converter such as `Digitised` at the correct position. Default: around the whole model.

        Args:
            converter: function from a noise model to that model wrapped in the converter.
        """
        return converter(self)

    # Initialisation and settings of a fit

    def standardise(self, signal: Any, observation: Tensor) -> None:
        """Measure the scaling of (N,) signals and observations, detector units, to start a fit near the data. Default: no effect.

        A model with `standardises_by_level` also takes the argument ``span``, the range (low, high) of signals to cover.
        """
        return

    @torch.no_grad()
    def scale_to(self, signal: Any, observation: Tensor, **options: Any) -> None:
        """`standardise`, and store the range of the signals."""
        self.standardise(signal, observation, **options)
        self.fitted_range = float(values_of(signal).min()), float(values_of(signal).max())

    standardises_by_level: bool = False
    """Whether `standardise` measures centre and width of the residuals at each signal level and takes ``span``.

    For such a model, residuals mirrored about the signal replace those hidden by clipping. Default: False.
    """

    def settle(self, signal: Tensor, observation: Tensor, behind: Behind | None = None) -> None:
        """Set the maximum-likelihood parameters after `standardise`, if the model can find them directly. Default: no effect.

        Args:
            signal, observation: (N,), detector units.
            behind: function that wraps the model in later stages of the detector, such as rounding and clipping.
        """
        return

    def match_levels(self, signal: Any, observation: Tensor) -> bool:
        """Adjust the edges of unequal levels to the fitted model, for (N,) pixels. Return whether there are such levels."""
        return False

    @property
    def settles(self) -> bool:
        """Whether `standardise` ends with `settle` and takes ``settle=False`` to leave it out. Default: False."""
        return False

    starts_most_likely: bool = False
    """Whether `standardise` reaches nearly the maximum of the likelihood, so that few steps suffice. Default: False."""

    @property
    def fits_directly(self) -> bool:
        """Whether fits to known signals use a quasi-Newton method on cells of alike pixels (`noiseflow.fitting.direct`).

        The learnt part of the density must be smooth in a twentieth of the noise's standard deviation. Default: False.
        """
        return False

    @property
    def roughness(self) -> Tensor | None:
        """Penalty of a direct fit for parameters that vary fast with the signal, nats over all pixels; None if none (default)."""
        return None

    pull: float | None = None
    """Nats by which a direct fit penalises half the square of the change of each parameter; None for no penalty (default)."""

    @property
    def learning_rate(self) -> float:
        """Initial learning rate of a fit to known signals. Default: 0.01, for a model that starts near the data."""
        return 1e-2

    @property
    def num_steps(self) -> int:
        """Number of steps of a fit to known signals. Default: 500."""
        return 500

    @property
    def joint_learning_rate(self) -> float:
        """Initial learning rate in a joint fit, in which the noise must follow the signal. Default: 0.03."""
        return 3e-2

    most_joint_steps: int | None = None
    """Largest number of steps of a fit to an estimated signal; None for no limit (default)."""

    starts_anew: bool = False
    """Whether the model should be standardised again whenever its signal has improved. Default: False."""

    costly: bool = False
    """Whether a fit takes so long that `select` tries the model only if no simpler one suffices. Default: False."""

    @property
    def learns(self) -> bool:
        """Whether the model has trainable parameters."""
        return any(parameter.requires_grad for parameter in self.parameters())

    _fitted_range: tuple[float, float] | None = None

    @property
    def fitted_range(self) -> tuple[float, float] | None:
        """Smallest and largest signal of the last fit, detector units; None before the first. Learnt scales have their own."""
        scales = (part.fitted_range for part in self.modules() if isinstance(part, Standardisation))
        return next(scales, self._fitted_range)

    @fitted_range.setter
    def fitted_range(self, found: tuple[float, float]) -> None:
        self._fitted_range = found

    def learner(self, observation: Tensor) -> tuple[NoiseModelBase, Tensor]:
        """The part of the model that a direct fit learns, and a boolean mask of its (N,) pixels. Default: the model, from all."""
        return self, torch.ones_like(observation, dtype=torch.bool)

    # Computation of the likelihood

    tabulate: bool = True
    """Whether likelihoods and samples of large inputs may be looked up in tables; set it to False for exact values."""

    def fixed_part(self, signal: Tensor, observation: Tensor, upto: Tensor | None = None) -> Tensor | None:
        """The part of the likelihood of (N,) pixels, or of intervals (observation, upto], that training does not change: (N, K),
        with a larger K for intervals; None if there is none (default)."""
        return None

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of (N,) pixels or intervals from their `fixed_part`; called only if that is not None."""
        raise NotImplementedError(f"{type(self).__name__} defines fixed_part; it must define log_prob_from too")

    # Files and devices

    settings: tuple[str, ...] = ()
    """Names of the attributes that are the arguments of the constructor."""

    def config(self) -> dict[str, Any]:
        """JSON-serialisable arguments that recreate the model, without its parameters and inner models. Default: `settings`."""
        return {name: getattr(self, name) for name in self.settings}

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value:.5g}" for name, value in self.config().items())

    @property
    def device(self) -> torch.device:
        """Device of the parameters and buffers; the CPU for a model without any."""
        tensors = (tensor for group in (self.parameters(), self.buffers()) for tensor in group)
        return next((tensor.device for tensor in tensors), torch.device("cpu"))
