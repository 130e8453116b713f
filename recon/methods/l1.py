"""Least absolute deviations with the field and the regulariser of the joint fit."""

import math

import torch
from torch import Tensor, nn

from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.models.base import NoiseModelBase
from recon.methods._fitted import fitted


class Laplace(NoiseModelBase):
    """Laplace noise with the same width at all signals.

    Args:
        scale: mean absolute deviation, detector units.
    """

    def __init__(self, scale: float = 0.1) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(scale)))

    def forward(self, signal: Tensor) -> NoiseDistribution:
        law = torch.distributions.Laplace(signal, self.log_scale.exp(), validate_args=False)
        return as_noise_distribution(law, like=signal)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the scale to the mean absolute residual of (N,) signals and observations."""
        self.log_scale.copy_(torch.log((observation.double() - signal.double()).abs().mean()))


METHOD = fitted(
    "l1",
    "Least absolute deviations, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Laplace},
)
