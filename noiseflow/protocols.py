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
    """

    def __call__(self, pixels: Tensor) -> Tensor:
        """Predict signals.

        Args:
            pixels: (B,) flat pixel indices into the observation.

        Returns:
            (B,) signals, differentiable in the model's parameters.
        """
        ...
