"""Noise model and ray sampling of Kniesel et al. (CVPR 2022)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.numerics.monotone_maps import Radial
from noiseflow.models.base import NoiseModelBase

_PARAMETER_RANGE = 10.0


class PaperFlow(NoiseModelBase):
    """Radial layers on the residual; small networks compute the parameters of the later ones from the signal.

    Args:
        layers: number of unconditional layers, followed by the same number of conditional layers.
        width: hidden units of each conditioning network.
        normalised: True evaluates the log-derivative of each layer at its input, so that the density integrates to one; False
            evaluates it at its output, as the released code does.
    """

    def __init__(self, layers: int = 4, width: int = 16, *, normalised: bool = True) -> None:
        super().__init__()
        self.normalised = normalised
        self.free = nn.Parameter(torch.empty(layers, 3).uniform_(-1, 1))
        self.networks = nn.ModuleList(
            nn.Sequential(nn.Linear(1, width), nn.ReLU(), nn.Linear(width, 3), nn.Tanh()) for _ in range(layers)
        )

    def forward(self, signal: Tensor) -> PaperFlowDistribution:
        """The distribution of the observations, given signals of any shape, in units of the incident intensity."""
        rows = [*self.free, *(_PARAMETER_RANGE * network(signal[..., None]) for network in self.networks)]
        return PaperFlowDistribution(signal, [_radial(row) for row in rows], self.normalised)


def _radial(raw: Tensor) -> Radial:
    """Radial map from centre, log α and softplus⁻¹(α + β)."""
    return Radial(raw[..., 0], raw[..., 1], torch.log(functional.softplus(raw[..., 2]).clamp_min(1e-30)) - raw[..., 1])


class PaperFlowDistribution(LatentDistribution):
    """The distribution of the flow; if it is not normalised, `log_prob` is the published formula and not a density."""

    def __init__(self, signal: Tensor, maps: list[Radial], normalised: bool) -> None:
        super().__init__(signal.shape)
        self.signal, self.maps, self.normalised = signal, maps, normalised

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        latent = value - self.signal
        total = torch.zeros_like(latent)
        for radial in self.maps:
            image, ladj = radial.forward(latent)
            total = total + (ladj if self.normalised else radial.forward(image)[1])
            latent = image
        return latent, total

    def from_latent(self, latent: Tensor) -> Tensor:
        for radial in reversed(self.maps):
            latent = radial.inverse(latent)[0]
        return latent + self.signal

    def _like(self) -> Tensor:
        return self.signal


def stratified(edges: Tensor, generator: torch.Generator) -> Tensor:
    """One uniform sample in each of the equally wide intervals that start at `edges`, (rays, samples), sorted.

    Args:
        edges: (rays, samples), multiples of one width.
        generator: source of the samples.
    """
    width = float(edges[0].diff().abs().max()) if edges.shape[1] > 1 else 1.0
    noise = torch.rand(edges.shape, generator=generator).to(edges)
    return (edges + width * noise).sort(-1).values


def by_density(edges: Tensor, density: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Intervals drawn in proportion to their density, in addition to one of each, (rays, count + samples).

    Args:
        edges: (rays, samples) starts of the intervals.
        density: (rays, samples); rays with zero density get uniform draws.
        count: number of draws per ray.
        generator: source of the draws.
    """
    weights = torch.where(density.sum(-1, keepdim=True) > 0, density, torch.ones_like(density)).cpu()
    drawn = torch.multinomial(weights, count, replacement=True, generator=generator).to(edges.device)
    return torch.cat([edges, edges.gather(-1, drawn)], -1)
