"""Least squares and least absolute deviations: with field and regulariser of the joint fit, on plain voxels, or denoised."""

import math

import torch
from torch import Tensor, nn

from noiseflow import Gaussian
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.models.base import NoiseModelBase
from recon.fields.kinds.grids import VoxelField
from recon.fields.regularisers import TotalVariation
from recon.methods._registry import after_denoising
from recon.methods.joint import fitted


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
    "l2",
    "Least squares, with the field and the regulariser of the joint fit.",
    lambda settings: {"noise_model": Gaussian},
)
METHODS = {
    "l1": fitted(
        "l1",
        "Least absolute deviations, with the field and the regulariser of the joint fit.",
        lambda settings: {"noise_model": Laplace},
    ),
    "explicit": fitted(
        "explicit",
        "Least squares on plain voxels without total variation, stopped where held-out pixels are predicted best.",
        lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "weight": 0.0, "held_out": 0.1},
        refuses=("weight", "regulariser", "field"),
    ),
    "tv": fitted(
        "tv",
        "Least squares with total variation on plain voxels.",
        lambda settings: {"noise_model": Gaussian, "make_field": VoxelField, "regulariser": TotalVariation()},
        refuses=("regulariser", "field"),
    ),
    "l2-denoised": after_denoising("l2-denoised", "Images denoised one by one, then least squares as of l2.", METHOD),
}
