"""A noise model as deepinv's noise model and data fidelity; importing this module needs deepinv."""

from __future__ import annotations

from typing import Any

import torch
from deepinv.optim import DataFidelity, Distance
from deepinv.physics import NoiseModel
from torch import Tensor, nn

from noiseflow.models.wrapper import as_noise_model


class FittedNoise(NoiseModel):  # type: ignore[misc]
    """The noise of a noise model for deepinv's ``Physics(noise_model=…)``.

    Args:
        generator: source of the draws, on the model's device.
    """

    def __init__(self, model: nn.Module, generator: torch.Generator) -> None:
        super().__init__(noise_model=self._sample, rng=generator)
        self.model = as_noise_model(model)

    def _sample(self, signal: Tensor) -> Tensor:
        with torch.no_grad():
            noisy: Tensor = self.model(signal).sample(generator=self.rng)
        return noisy


class LikelihoodDistance(Distance):  # type: ignore[misc]
    """−log p(y | u) for an image u and its observation y, summed over all but the first axis."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = as_noise_model(model)

    def fn(self, x: Tensor, y: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        """The distance of each image of a batch, (B,), nats."""
        log_prob: Tensor = self.model(x).log_prob(y)
        return -log_prob.flatten(1).sum(1)


class Likelihood(DataFidelity):  # type: ignore[misc]
    """The data fidelity −log p(y | A(x)) of a noise model."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.d = LikelihoodDistance(model)
