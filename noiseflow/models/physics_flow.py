"""Physical noise model with a flow: exact shot and read noise, and a smooth map of its latent for deviations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from noiseflow.arguments import check
from noiseflow.distributions.numerics.monotone_maps import Transform
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.flow import ConditionalFlow
from noiseflow.models.layers import AFFINE, spline_layer
from noiseflow.models.physical import PoissonGaussian
from noiseflow.models.physics_distribution import PhysicsFlowDistribution


class PhysicsFlow(NoiseModelBase):
    """Poisson–Gaussian noise, corrected by a flow of its latent.

    The latent of an observation under the detector, z = Φ⁻¹(F(o | s)), is standard normal if the detector describes the noise
    completely. A conditional affine map and spline, initially the identity, map it to z′, the standard normal latent of this
    model: log p = log p_detector + log φ(z′) + log dz′/dz − log φ(z). Peaks of single electrons keep their positions.

    A fit first finds the detector by maximum likelihood and keeps it fixed while the flow is trained. The detector's part of the
    likelihood of each pixel is then computed only once.

    Args:
        num_bins: number of bins of the spline.
        width: hidden units of the conditioning network.
        detector: the physical part; by default a `PoissonGaussian`.

    Example:
        >>> import noiseflow, torch
        >>> noise = noiseflow.PhysicsFlow()
        >>> noise(torch.tensor([0.2, 0.8])).log_prob(torch.tensor([0.25, 0.75])).shape
        torch.Size([2])
    """

    most_joint_steps = PoissonGaussian.most_joint_steps
    fits_directly = True
    settles = True
    costly = True

    def __init__(self, num_bins: int = 16, *, width: int = 32, detector: PoissonGaussian | None = None) -> None:
        super().__init__()
        check(num_bins=num_bins, width=width)
        self.num_bins, self.width = num_bins, width
        self.detector = (PoissonGaussian() if detector is None else detector).requires_grad_(False)
        self.correction = ConditionalFlow([AFFINE, spline_layer(num_bins)], width=width)

    def forward(self, signal: Tensor) -> PhysicsFlowDistribution:
        """The distribution of the observations, given signals of any shape, detector units."""
        return PhysicsFlowDistribution(self.detector(signal), self._maps, model=self)

    def _maps(self, signal: Tensor) -> list[Transform]:
        coordinate = self.correction.standardisation.coordinate(signal)
        with torch.autocast(signal.device.type, enabled=False):
            return self.correction.transforms(coordinate)

    def standardise(self, signal: Tensor, observation: Tensor, *, settle: bool = True) -> None:
        """Find the maximum-likelihood detector for (N,) signals and observations."""
        self.detector.standardise(signal, observation, settle=settle)
        self.correction.standardise(signal, observation)

    def settle(
        self, signal: Tensor, observation: Tensor, behind: Callable[[NoiseModelBase], NoiseModelBase] | None = None
    ) -> None:
        """Set the detector to its maximum-likelihood parameters; see `PoissonGaussian.settle`."""
        self.detector.settle(signal, observation, behind)

    @torch.no_grad()
    def fixed_part(self, signal: Tensor, observation: Tensor) -> Tensor:
        """The part of the likelihood of (N,) pixels that training the flow does not change, (N, 2); see `log_prob_from`."""
        return torch.stack(self.forward(signal).detector_part(observation), -1)

    def log_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of pixels from their `fixed_part`."""
        latent, log_density = fixed_part.unbind(-1)
        return (log_density + self.forward(signal).correct(latent)[1]).to(signal.dtype)

    @torch.no_grad()
    def fixed_interval_part(self, signal: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """As `fixed_part`, for the likelihood of intervals, (N, 3)."""
        return torch.stack(self.forward(signal).interval_part(low, high), -1)

    def log_interval_prob_from(self, signal: Tensor, fixed_part: Tensor) -> Tensor:
        """Log-likelihood of intervals from their `fixed_interval_part`."""
        return self.forward(signal).corrected_interval(*fixed_part.unbind(-1)).to(signal.dtype)

    def extra_repr(self) -> str:
        return f"{self.num_bins} bins, width={self.width}"

    def config(self) -> dict[str, Any]:
        """Arguments that recreate this model, without the detector."""
        return {"num_bins": self.num_bins, "width": self.width}
