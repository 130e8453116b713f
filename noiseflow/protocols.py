"""The two plugs of the library: what a noise model is, and what a signal model is. No logic lives here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor

    from noiseflow.distributions.base import NoiseDistribution


@runtime_checkable
class NoiseModel(Protocol):
    """A conditional density p(observation | signal); an ``nn.Module``.

    `NoiseModelBase` is its full contract, with a default for everything but the call.

    Example:
        >>> import noiseflow
        >>> isinstance(noiseflow.Poisson(), noiseflow.NoiseModel)
        True
    """

    def __call__(self, signal: Tensor) -> NoiseDistribution:
        """The distribution of the observations of pixels with the given signals.

        Args:
            signal: clean signals, any shape, detector units.

        Returns:
            A distribution with ``batch_shape == signal.shape`` and ``event_shape == ()``.
        """
        ...


@runtime_checkable
class SignalModel(Protocol):
    """Anything differentiable that predicts the signal of given pixels; an ``nn.Module``.

    Two methods are optional: ``signal()`` returns all pixels at once, flat, where that is cheaper than asking for them by
    index; ``penalty()`` returns a scalar added to the mean negative log-likelihood (a regulariser, already weighted).

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
            (B,) signals, differentiable in the model's parameters.
        """
        ...
