"""The two interfaces of the library: noise models and signal models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor

    from noiseflow.distributions.noise_distribution import NoiseDistribution


@runtime_checkable
class NoiseModel(Protocol):
    """Interface of a noise model: a conditional density p(observation | signal); an ``nn.Module``.

    `NoiseModelBase` defines the complete interface, with defaults for everything but the call.

    Example:
        >>> import noiseflow
        >>> isinstance(noiseflow.Poisson(), noiseflow.NoiseModel)
        True
    """

    def __call__(self, signal: Tensor) -> NoiseDistribution:
        """Return the distribution of the observations, given the signals of the pixels.

        Args:
            signal: clean signals, any shape, detector units.

        Returns:
            A distribution with ``batch_shape == signal.shape`` and ``event_shape == ()``.
        """
        ...


@runtime_checkable
class SignalModel(Protocol):
    """Interface of a signal model: any differentiable ``nn.Module`` that predicts the signal of given pixels.

    Two methods are optional. ``signal()`` returns all pixels as a flat tensor, if that is cheaper than prediction by index.
    ``penalty()`` returns a scalar that is added to the mean negative log-likelihood (a weighted regulariser).

    Example:
        >>> import noiseflow, torch
        >>> class Plane(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.slope = torch.nn.Parameter(torch.ones(2))
        ...     def forward(self, pixels):
        ...         return self.slope[0] * (pixels // 32) / 32 + self.slope[1] * (pixels % 32) / 32
        >>> plane = Plane()
        >>> rows = torch.arange(32.0)[:, None] / 32
        >>> observation = 1.5 * rows + 0.5 * rows.T + 0.1 * torch.randn(32, 32, generator=torch.Generator().manual_seed(0))
        >>> result = noiseflow.fit(noiseflow.Gaussian(), plane, observation, num_steps=200)
        >>> [round(slope, 1) for slope in plane.slope.tolist()]
        [1.5, 0.5]
    """

    def __call__(self, pixels: Tensor) -> Tensor:
        """Predict signals.

        Args:
            pixels: (B,) flat pixel indices into the observation.

        Returns:
            (B,) signals, differentiable with respect to the model's parameters.
        """
        ...
