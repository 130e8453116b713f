"""The published method of Kniesel et al. (CVPR 2022): its networks and its flow, ray by ray or on all voxels at once."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.distributions.numerics.monotone_maps import Radial, back_through
from noiseflow.models.base import NoiseModelBase
from recon.fields.kinds.network import DENSEST, CoordinateDensity, PaperField
from recon.joint.signal_model import TomographySignal
from recon.methods._registry import Method, Settings
from recon.projection.dual_axis import projector_of
from recon.projection.image_formation import Transmission
from recon.reconstruction import Reconstruction
from recon.series.first_guess import estimate_response
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid

_PARAMETER_RANGE = 10.0
_PARTS = ("coarse", "fine", "noise_model", "field_optimiser", "noise_optimiser")  # of the state of a run


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
        free = self.free.expand(*signal.shape, *self.free.shape)
        conditional = [_PARAMETER_RANGE * network(signal[..., None]) for network in self.networks]
        return PaperFlowDistribution(signal, torch.cat([free, torch.stack(conditional, -2)], -2), self.normalised)


class PaperFlowDistribution(LatentDistribution):
    """The distribution of the flow; if it is not normalised, `log_prob` is the published formula and not a density."""

    def __init__(self, signal: Tensor, raw: Tensor, normalised: bool) -> None:
        """Parameters have shape (*signal, layers, 3)."""
        super().__init__(signal.shape)
        self.signal, self.raw, self.normalised = signal, raw, normalised

    @property
    def _maps(self) -> list[Radial]:
        first, second, third = self.raw[..., None, :].unbind(-1)
        third = torch.log(functional.softplus(third).clamp_min(1e-30)) - second
        return list(map(Radial, first.unbind(-2), second.unbind(-2), third.unbind(-2)))

    def to_latent(self, value: Tensor) -> tuple[Tensor, Tensor]:
        latent = value - self.signal
        total = torch.zeros_like(latent)
        for radial in self._maps:
            image, ladj = radial.forward(latent)
            total = total + (ladj if self.normalised else radial.forward(image)[1])
            latent = image
        return latent, total

    def from_latent(self, latent: Tensor) -> Tensor:
        return back_through(self._maps, latent) + self.signal


def by_density(edges: Tensor, density: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """One of each of the intervals that start at `edges`, and `count` drawn in proportion to their density, or uniformly for
    rays of density zero: (rays, samples) to (rays, count + samples)."""
    weights = torch.where(density.sum(-1, keepdim=True) > 0, density, torch.ones_like(density)).cpu()
    drawn = torch.multinomial(weights, count, replacement=True, generator=generator).to(edges.device)
    return torch.cat([edges, edges.gather(-1, drawn)], -1)


# bytes for each point of a batch and unit of the hidden layers: a run ray by ray takes 2934 MiB
_PER_POINT_AND_UNIT = 110


@dataclass(frozen=True)
class Kniesel2022:
    """Kniesel et al., *Clean Implicit 3D Structure from Noisy 2D STEM Images*, CVPR 2022 (doi:10.1109/CVPR52688.2022.02018).

    As published, two coordinate networks are trained ray by ray, the second on samples placed by the first, for 400 000 steps.
    Without `rays`, the second one alone is evaluated once per step on all voxels, and projected to all tilts: the gradient is
    that of the whole series, and 200 steps suffice. The preset takes them by least squares, while the flow learns the residuals:
    steps by the likelihood of the flow, which has no bound at clipped values, emptied the volume. There are three differences
    from the released code: gradients of the noise model are cleared at every step, images are divided by the incident intensity
    instead of min–max scaled, and the final state is used, because only clean validation images could show the best one.

    Attributes:
        width: width of the hidden layers (512 for the paper's real data).
        rays: rays per batch; None for all rays of all tilts.
        accumulate: batches per optimiser step, with `rays`.
        coarse_samples, fine_samples: samples along a ray, uniform and drawn by density, with `rays`.
        field_rate, noise_rate: learning rates; constant up to `decay_start`, then decreasing linearly to a hundredth.
        l2_steps: number of initial steps that train only the field, by least squares.
        density_scale: attenuation per unit length (half the image width) at a density of one.
        normalised: False reproduces the published log-density, which does not integrate to one.
    """

    width: int
    num_steps: int
    rays: int | None
    accumulate: int
    coarse_samples: int
    fine_samples: int
    field_rate: float
    noise_rate: float
    decay_start: int
    l2_steps: int
    density_scale: float
    normalised: bool = True
    seed: int = 0
    device: torch.device | str = "cpu"

    @property
    def memory(self) -> int:
        """Bytes that a step needs."""
        if self.rays is None:
            return PaperField.more_memory
        return _PER_POINT_AND_UNIT * self.rays * (self.coarse_samples + self.fine_samples) * self.width

    def start(
        self, tilt_series: TiltSeries, grid: VolumeGrid | None = None, *, max_steps: int | None = None
    ) -> PresetState:
        """The initial state, before the first step.

        Args:
            grid: the voxels, where the field is evaluated without `rays`; by default a cube as wide as the images.
            max_steps: stop after this number of steps; learning rates still depend on `num_steps`.

        Raises:
            ValueError: the series is not bright field.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            steps = min(self.num_steps, max_steps or self.num_steps)
            return PresetState(self, tilt_series, grid or VolumeGrid.of(tilt_series), steps)

    def train(
        self, tilt_series: TiltSeries, grid: VolumeGrid | None = None, *, max_steps: int | None = None
    ) -> Iterator[PresetState]:
        """Train step by step and yield the state after each; arguments and errors as for `start`."""
        state = self.start(tilt_series, grid, max_steps=max_steps)
        while state.done < state.num_steps:
            state.step()
            yield state


class PresetState:
    """Networks, noise model and optimisers of a running preset: a `Stage` of a reconstruction."""

    def __init__(self, preset: Kniesel2022, tilt_series: TiltSeries, grid: VolumeGrid, num_steps: int) -> None:
        self.preset, self.done, self.num_steps, self.loss = preset, 0, num_steps, math.nan
        self.grid, self.projector = grid, projector_of(tilt_series, grid, preset.device)
        width = preset.width
        self.coarse = CoordinateDensity(frequencies=5, layers=3, width=width, skip=0).to(preset.device)
        scale = 2 * preset.density_scale / grid.width / DENSEST
        self.on_grid = PaperField(grid.shape, scale=scale, width=width).to(preset.device)
        self.on_grid.voxel_size = grid.voxel_size
        self.fine = self.on_grid.network
        self.noise_model = PaperFlow(normalised=preset.normalised).to(preset.device)
        fields = [*self.coarse.parameters(), *self.fine.parameters()]
        self.field_optimiser = torch.optim.Adam(fields, lr=preset.field_rate)
        # the step of Adam does not depend on the number of rays
        noise = list(self.noise_model.parameters())
        self.noise_optimiser: torch.optim.Optimizer = torch.optim.Adam(noise, lr=preset.noise_rate)
        if preset.rays is not None:
            self.noise_optimiser = torch.optim.SGD(noise, lr=preset.noise_rate, momentum=0.9, weight_decay=1e-3)
        self.generator = torch.Generator().manual_seed(preset.seed)
        self.response = response = estimate_response(tilt_series)
        if not isinstance(response, Transmission):
            raise ValueError("kniesel2022 supports only bright-field images; use another method for a linear series")
        images = np.asarray(tilt_series.images, dtype=np.float32) / response.intensity.numpy()[:, None, None]
        response.to(preset.device)
        self.images = torch.from_numpy(images).to(preset.device)
        self.theta = torch.from_numpy(np.deg2rad(tilt_series.tilt_angles)).float().to(preset.device)
        if preset.rays is None:  # from denser beginnings, all gradients at once lead to an empty volume
            through = -torch.log(self.images.clamp(0.01, 1)).mean()
            self.on_grid.start_from((through / grid.depth).expand(1, 1, 1))

    def state(self) -> dict[str, Any]:
        """Everything that further steps depend on."""
        kept = {name: getattr(self, name).state_dict() for name in _PARTS}
        return kept | {"generator": self.generator.get_state(), "done": self.done, "loss": self.loss}

    def load_state(self, state: dict[str, Any]) -> None:
        for name in _PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.generator.set_state(state["generator"])
        self.done, self.loss = state["done"], state["loss"]

    def step(self) -> str:
        """One iteration: the coarse network, then the fine one, then all optimisers."""
        preset, step = self.preset, self.done + 1
        likelihood = step > preset.l2_steps
        past = max(step - preset.decay_start, 0) / max(preset.num_steps - preset.decay_start, 1)
        for optimiser, rate in ((self.field_optimiser, preset.field_rate), (self.noise_optimiser, preset.noise_rate)):
            optimiser.param_groups[0]["lr"] = rate * (1 + past * (0.01 - 1))
            optimiser.zero_grad(set_to_none=True)
        if preset.rays is None:
            predicted, observed = self._signal_of_voxels(), self.images.mT
            loss = self._nll(predicted, observed, likelihood)
            # the flow learns the residuals from the first step: before that, it would empty the volume
            noise = loss if likelihood else loss + self._nll(predicted.detach(), observed, likelihood=True)
            noise.backward()  # type: ignore[no-untyped-call]
            self.loss = float(loss.detach())
        else:
            self.loss = sum(self._batch(fine, likelihood) for fine in (False, True) for _ in range(preset.accumulate))
        self.field_optimiser.step()
        if likelihood or preset.rays is None:
            nn.utils.clip_grad_norm_(self.noise_model.parameters(), 100.0)
            self.noise_optimiser.step()
        self.done = step
        return f"loss {self.loss:.4f}"

    def _nll(self, predicted: Tensor, observed: Tensor, likelihood: bool) -> Tensor:
        if likelihood:
            return torch.neg(self.noise_model(predicted).log_prob(observed).mean())
        error = ((predicted - observed) ** 2).mean()
        # in nats, for all rays: with gradients a hundred times smaller, Adam's first steps of the likelihood emptied the volume
        return error if self.preset.rays else 0.5 * torch.log(error)

    def _signal_of_voxels(self) -> Tensor:
        """The signal at all pixels, (tilts, width, height), of the fine network on the voxels."""
        tilts, height, width = self.images.shape
        return torch.exp(-self.projector.project(self.on_grid())).view(tilts, width, height)

    def _batch(self, fine: bool, likelihood: bool) -> float:
        """Add the gradient of one batch of rays, and return its loss, or zero for the coarse network."""
        origin, direction, observed = self._rays()
        edges = torch.arange(self.preset.coarse_samples, device=origin.device) / self.preset.coarse_samples
        edges = (edges * 2 * math.sqrt(2) - math.sqrt(2)).expand(len(origin), -1)
        if fine:
            with torch.no_grad():
                density = self.coarse(self._points(origin, direction, edges)[1])
            edges = by_density(edges, density, self.preset.fine_samples, self.generator)
        predicted = self._signal(self.fine if fine else self.coarse, origin, direction, edges)
        loss = self._nll(predicted, observed, likelihood) / self.preset.accumulate
        loss.backward()  # type: ignore[no-untyped-call]
        return float(loss.detach()) if fine else 0.0

    def _rays(self) -> tuple[Tensor, Tensor, Tensor]:
        """Origins and directions (x, y, z) and pixel values of random rays; the cube is as wide as the image."""
        tilts, height, width = self.images.shape
        tilt, row, column = (
            torch.randint(size, (self.preset.rays or 1,), generator=self.generator).to(self.images.device)
            for size in (tilts, height, width)
        )
        u, y = (2 * column + 1) / width - 1, (2 * row + 1 - height) / width
        cosine, sine = torch.cos(self.theta[tilt]), torch.sin(self.theta[tilt])
        origin = torch.stack([u * cosine, y, u * sine], -1)
        return origin, torch.stack([-sine, torch.zeros_like(sine), cosine], -1), self.images[tilt, row, column]

    def _points(self, origin: Tensor, direction: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
        """One uniform draw in each of the equally wide intervals that start at `edges`, sorted: along the ray, and (x, y, z)."""
        noise = torch.rand(edges.shape, generator=self.generator).to(edges)
        along = (edges + 2 * math.sqrt(2) / self.preset.coarse_samples * noise).sort(-1).values
        return along, origin[:, None] + along[..., None] * direction[:, None]

    def _signal(self, network: nn.Module, origin: Tensor, direction: Tensor, edges: Tensor) -> Tensor:
        along, points = self._points(origin, direction, edges)
        inside = (points.abs() <= 1).all(-1)
        steps = torch.diff(along, dim=-1, prepend=along[:, :1])
        line_integral: Tensor = (network(points) * inside * steps).sum(-1) * self.preset.density_scale
        return torch.exp(-line_integral)

    def volume(self) -> NDArray[Any]:
        """The fine network on the voxel grid, (z, y, x), attenuation per voxel."""
        return self.on_grid.volume().cpu().numpy()


_PUBLISHED = Kniesel2022(
    width=256,
    num_steps=400_000,
    rays=512,
    accumulate=4,
    coarse_samples=64,
    fine_samples=128,
    field_rate=5e-5,
    noise_rate=5e-5,
    decay_start=100_000,
    l2_steps=100,
    density_scale=7.0,
    normalised=False,
)
PRESETS = {
    "kniesel2022": replace(
        _PUBLISHED,
        rays=None,
        num_steps=200,
        decay_start=150,
        l2_steps=200,
        field_rate=5e-3,
        noise_rate=0.05,
        normalised=True,
    ),
    "kniesel2022-as-published": _PUBLISHED,
}
"""Presets by name."""


def preset_method(name: str, description: str) -> Method:
    """Wrap a preset of `PRESETS` as a method."""

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        width = tilt_series.images.shape[2]
        if grid.width != width or grid.depth > width:
            raise ValueError(f"method {name} fills a cube as wide as the images; give a grid {width} wide, no deeper")
        preset = replace(PRESETS[name], seed=settings.seed, device=settings.device)
        state = preset.start(tilt_series, grid, max_steps=settings.num_steps)
        settings.run_stage(name, state)
        model = TomographySignal(state.on_grid, state.projector, state.response, weight=0.0)
        volume, choices = Volume(state.volume(), grid.voxel_size), {"steps": state.done, "loss": state.loss}
        return Reconstruction(volume, model.images(), name, state.noise_model, signal_model=model, choices={**choices})

    return Method(
        name,
        description,
        run,
        learns_noise=True,
        memory=PRESETS[name].memory,
        continuous=True,
        refuses=("second-axis",),
    )


METHOD = preset_method("kniesel2022", "Network and flow of Kniesel et al. 2022, least squares on voxels (200 steps).")
METHODS = {
    "kniesel2022-as-published": preset_method(
        "kniesel2022-as-published",
        "Kniesel et al. 2022 exactly as published; its log-density does not integrate to one (days).",
    )
}
