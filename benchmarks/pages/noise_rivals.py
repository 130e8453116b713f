"""Rivals of the noise models: conditional spline flows of zuko and normflows, and the flow of Kniesel et al. as published.

Each is an ``nn.Module`` with the calls of a noise model, so that one loop fits and judges them all. zuko and normflows have no
rounding or saturation of their own: where the data show them, they get `noiseflow.Digitised` around them like every other model.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.numerics.normal import LOG_SQRT_2PI

SETTINGS: dict[str, dict[str, Any]] = {
    "zuko": {"transforms": 1, "bins": 16, "hidden": 64, "learning_rate": 5e-3, "num_steps": 500},
    "normflows": {"transforms": 1, "bins": 16, "hidden": 64, "learning_rate": 5e-3, "num_steps": 500},
}
"""The settings that `noise_models.py search` found best for each."""


def require(name: str) -> Any:
    """Import a rival, or leave with one line that says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise SystemExit(f"noise_models.py: {name} is not installed; python -m pip install '.[benchmark]'") from error


class Rival(nn.Module):
    """A conditional flow of another library in one dimension, standardised as its documentation asks.

    Subclasses turn (B, 1) standardised residuals into latents and back, given (B, 1) signals in [−1, 1].
    """

    low: Tensor
    span: Tensor
    centre: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name, value in (("low", 0.0), ("span", 1.0), ("centre", 0.0), ("scale", 1.0)):
            self.register_buffer(name, torch.tensor(value))

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Signals to [−1, 1], residuals to mean 0 and standard deviation 1."""
        residual = observation - signal
        self.low, self.span = signal.min(), (signal.max() - signal.min()).clamp(min=1e-12)
        self.centre, self.scale = residual.mean(), residual.std(correction=0)

    def forward(self, signal: Tensor) -> RivalDistribution:
        return RivalDistribution(self, signal)

    def to_latent(self, context: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Latents and log-derivatives, (B, 1) and (B,)."""
        raise NotImplementedError

    def from_latent(self, context: Tensor, latent: Tensor) -> Tensor:
        """Standardised residuals, (B, 1)."""
        raise NotImplementedError


class RivalDistribution(LatentDistribution):
    """What a `Rival` returns."""

    def __init__(self, rival: Rival, signal: Tensor) -> None:
        super().__init__(signal.shape)
        self.rival, self.signal = rival, signal

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        signal, value = torch.broadcast_tensors(self.signal, value)
        residual = (value - signal - self.rival.centre) / self.rival.scale
        latent, ladj = self.rival.to_latent(self._context(signal), residual.reshape(-1, 1))
        return latent.reshape(signal.shape), ladj.reshape(signal.shape) - torch.log(self.rival.scale)

    def from_latent(self, latent: Tensor) -> Tensor:
        signal, latent = torch.broadcast_tensors(self.signal, latent)
        residual = self.rival.from_latent(self._context(signal), latent.reshape(-1, 1)).reshape(signal.shape)
        return signal + self.rival.centre + self.rival.scale * residual

    def _context(self, signal: Tensor) -> Tensor:
        return (2 * (signal - self.rival.low) / self.rival.span - 1).reshape(-1, 1)


class Zuko(Rival):
    """zuko's neural spline flow, ``zuko.flows.NSF``, of one feature and one context."""

    def __init__(self, *, transforms: int, bins: int, hidden: int) -> None:
        super().__init__()
        torch.manual_seed(0)
        zuko = require("zuko")
        self.flow = zuko.flows.NSF(1, 1, bins=bins, transforms=transforms, hidden_features=(hidden, hidden))

    def to_latent(self, context: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        latent, ladj = self.flow(context).transform.call_and_ladj(residual)
        return latent, ladj

    def from_latent(self, context: Tensor, latent: Tensor) -> Tensor:
        residual: Tensor = self.flow(context).transform.inv(latent)
        return residual


class ZukoMixture(Rival):
    """zuko's conditional Gaussian mixture, ``zuko.flows.GMM``, with eight components."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.flow = require("zuko").flows.GMM(1, 1, components=8, hidden_features=(64, 64))

    def to_latent(self, context: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        mixture = self.flow(context)
        parts = mixture.base
        below = torch.distributions.Normal(parts.loc[..., 0], parts.stddev[..., 0]).cdf(residual)
        share = (torch.softmax(mixture.logits, -1) * below).sum(-1)
        latent = torch.special.ndtri(share.double().clamp(1e-12, 1 - 1e-7)).to(share)
        return latent[:, None], mixture.log_prob(residual) + latent**2 / 2 + LOG_SQRT_2PI

    def from_latent(self, context: Tensor, latent: Tensor) -> Tensor:
        raise NotImplementedError("a mixture has no closed quantile")


class Normflows(Rival):
    """normflows' conditional autoregressive rational-quadratic splines; its coupling layers need two features or more."""

    def __init__(self, *, transforms: int, bins: int, hidden: int) -> None:
        super().__init__()
        torch.manual_seed(0)
        nf = require("normflows")
        layers = [
            nf.flows.AutoregressiveRationalQuadraticSpline(
                1, 2, hidden, num_context_channels=1, num_bins=bins, tail_bound=5
            )
            for _ in range(transforms)
        ]
        self.flow = nf.ConditionalNormalizingFlow(nf.distributions.DiagGaussian(1, trainable=False), layers)

    def to_latent(self, context: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        latent, ladj = self.flow.inverse_and_log_det(residual, context=context)
        return latent, ladj

    def from_latent(self, context: Tensor, latent: Tensor) -> Tensor:
        residual: Tensor = self.flow(latent, context=context)
        return residual


def make(name: str, changes: dict[str, Any]) -> tuple[Rival, dict[str, Any]]:
    """A rival and its settings, changed where asked."""
    settings = SETTINGS[name] | changes
    architecture = {key: settings[key] for key in ("transforms", "bins", "hidden")}
    return {"zuko": Zuko, "normflows": Normflows}[name](**architecture), settings


class PaperFlow(Rival):
    """The noise model of Kniesel et al. (CVPR 2022) with its own parametrisation: four radial layers, then four conditional ones.

    The signal passes a network of 16 hidden units and a tanh per conditional layer. Intensities are scaled to [0, 1], residuals
    alike and no further, as the authors do.

    Args:
        as_published: evaluate the log-derivative of each layer at its output, as the published code does. That is not a density.
    """

    def __init__(self, *, as_published: bool) -> None:
        super().__init__()
        self.as_published = as_published
        generator = torch.Generator().manual_seed(0)
        self.shared = nn.Parameter(2 * torch.rand(4, 3, generator=generator) - 1)
        torch.manual_seed(0)
        self.networks = nn.ModuleList(
            nn.Sequential(nn.Linear(1, 16), nn.ReLU(), nn.Linear(16, 3), nn.Tanh()) for _ in range(4)
        )

    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        self.low = torch.minimum(signal.min(), observation.min())
        self.span = self.scale = torch.maximum(signal.max(), observation.max()) - self.low

    def to_latent(self, context: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        value, total = residual[:, 0], torch.zeros_like(residual[:, 0])
        for parameters in self._layers(context):
            moved = _radial(parameters, value)
            total = total + _radial_ladj(parameters, moved if self.as_published else value)
            value = moved
        return value[:, None], total

    def from_latent(self, context: Tensor, latent: Tensor) -> Tensor:
        value = latent[:, 0]
        for centre, width, change in reversed(self._layers(context)):
            u = value - centre
            q = width + change - u.abs()
            root = torch.sqrt(q * q + 4 * width * u.abs())
            distance = torch.where(q > 0, 2 * width * u.abs() / (q.clamp(min=0) + root), (root - q) / 2)
            value = centre + torch.sign(u) * distance
        return value[:, None]

    def _layers(self, context: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
        unit = (context + 1) / 2
        raw = [*self.shared, *(10 * network(unit) for network in self.networks)]
        widths = [torch.exp(each[..., 1]) for each in raw]
        changes = [nn.functional.softplus(each[..., 2]) - width for each, width in zip(raw, widths, strict=True)]
        return [(each[..., 0], width, change) for each, width, change in zip(raw, widths, changes, strict=True)]

    def fit(
        self, signal: Tensor, observation: Tensor, *, num_steps: int = 1500, rate: float = 5e-7, seed: int = 0
    ) -> float:
        """Fit with the authors' optimiser; seconds taken.

        SGD of momentum 0.9 and weight decay 1e-3 on the summed log-likelihood of 16 × 16 pixels, mean of 16 such patches; its
        rate, 5e-7 where the clean image is known, falls to a tenth over the last third of the steps. The authors take 400 000
        steps, and their pixels are neighbours.
        """
        started = time.perf_counter()
        self.standardise(signal, observation)
        optimiser = torch.optim.SGD(self.parameters(), lr=rate, momentum=0.9, weight_decay=1e-3)
        start = 2 * num_steps // 3
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimiser, lambda step: 1 - 0.9 * max(0, step - start) / (num_steps - start)
        )
        generator = torch.Generator().manual_seed(seed)
        for _ in range(num_steps):
            pixels = torch.randint(signal.numel(), (16 * 256,), generator=generator)
            optimiser.zero_grad()
            loss = -256 * self(signal[pixels]).log_prob(observation[pixels]).mean()
            loss.backward()
            optimiser.step()
            schedule.step()
        return time.perf_counter() - started

    @torch.no_grad()
    def integral(self, signal: float) -> float:
        """Integral of what it calls its density at one signal, over ±40 of its units."""
        grid = torch.linspace(-40, 40, 400_001, dtype=torch.float64)
        observation = signal + grid * self.scale.double()
        model = self.double()
        log_prob = model(torch.full_like(grid, signal)).log_prob(observation)
        total = float(torch.trapezoid(torch.exp(log_prob), observation))
        self.float()
        return total


def _radial(parameters: tuple[Tensor, Tensor, Tensor], value: Tensor) -> Tensor:
    centre, width, change = parameters
    d = value - centre
    return value + change * d / (width + d.abs())


def _radial_ladj(parameters: tuple[Tensor, Tensor, Tensor], value: Tensor) -> Tensor:
    centre, width, change = parameters
    derivative = 1 + change * width / (width + (value - centre).abs()) ** 2
    return torch.log(derivative + 1e-8)  # the authors' floor
