"""The joint fit: a volume and the noise model of its images, learnt together from one noisy tilt series."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow import Digitised, FitResult, Gaussian, RadialFlow, fit
from recon.fields import Field, MultiresolutionField
from recon.image_formation import Linear, Transmission
from recon.projector import SliceProjector, from_rays
from recon.regularisers import total_variation
from recon.sirt import sirt
from recon.tilt_series import TiltSeries, Volume, VolumeGrid

Progress = Callable[[int, str], None]


class TomographySignal(nn.Module):
    """A volume, its projections and the detector's response as one signal model, for `noiseflow.fit`.

    Pixels are numbered in the projector's native order: ``images.transpose(0, 2, 1)``, that is (tilt, u, y), made flat.

    Args:
        field: the volume.
        projector: line integrals along all rays.
        image_formation: line integrals to signals, such as `Transmission` or `Linear`.
        weight: of the total variation, nats per unit of jump in attenuation (in units of the field's scale) over one
            voxel face.
        smoothing: jumps below this, in units of the field's scale, count quadratically.
        learning_rate: of the field; the detector's response learns at a twentieth of it.
    """

    def __init__(
        self,
        field: Field,
        projector: SliceProjector,
        image_formation: nn.Module,
        *,
        weight: float = 1.0,
        smoothing: float = 0.05,
        learning_rate: float = 0.2,
    ) -> None:
        super().__init__()
        self.field, self.projector, self.image_formation = field, projector, image_formation
        self.weight, self.smoothing, self.learning_rate = weight, smoothing, learning_rate
        self._columns: Tensor | None = None
        self._seen: tuple[tuple[int, ...], Tensor] | None = None

    @property
    def num_pixels(self) -> int:
        """How many pixels the tilt series has."""
        return self.projector.num_tilts * self.projector.detector_width * self.field.height

    def signal(self) -> Tensor:
        """The signal of all pixels, flat."""
        self._columns, self._seen = self.field(), None
        rays = self.projector.project(self._columns)
        shape = (self.projector.num_tilts, self.projector.detector_width, self.field.height)
        signal: Tensor = self.image_formation(rays.view(shape))
        return signal.reshape(-1)

    def forward(self, pixels: Tensor) -> Tensor:
        """The signal of some pixels; without gradients, all are projected once for each state of the parameters."""
        if torch.is_grad_enabled():
            return self.signal()[pixels]
        # a fused optimiser does not count as a new version of its tensors, but no step comes without signal()
        version = tuple(parameter._version for parameter in self.parameters())
        if self._seen is None or self._seen[0] != version:
            signal = self.signal()
            self._seen = version, signal
        return self._seen[1][pixels]

    def penalty(self) -> Tensor:
        """The weighted total variation per pixel; after `signal` it reuses the volume evaluated there."""
        columns = self.field() if self._columns is None else self._columns
        self._columns = None
        scale = float(self.field.scale)
        lattice = columns.view(self.field.depth, self.field.width, self.field.height)
        variation = total_variation(lattice, smoothing=self.smoothing * scale)
        return variation * (self.weight / (scale * self.num_pixels))

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Parameters with their learning rates, for Adam."""
        response = [parameter for parameter in self.image_formation.parameters() if parameter.requires_grad]
        groups: list[dict[str, Any]] = [
            {"params": list(self.field.parameters()), "lr": self.learning_rate, "eps": 1e-15}
        ]
        return groups + ([{"params": response, "lr": self.learning_rate / 20}] if response else [])


@dataclass(frozen=True)
class Reconstruction:
    """What a fit of a volume gives.

    Attributes:
        volume: the clean volume.
        projections: (tilt, y, u) the clean images that the volume predicts, detector units.
        noise_model: the noise model it was fitted with.
        signal_model: field, projector and image formation, as fitted.
        fit_result: held-out likelihood and its history.
    """

    volume: Volume
    projections: np.ndarray[Any, np.dtype[np.float32]]
    noise_model: nn.Module
    signal_model: TomographySignal
    fit_result: FitResult


@dataclass(frozen=True)
class JointReconstructor:
    """Reconstruct a volume together with the noise model of its images; with a `Gaussian`, plain least squares.

    Attributes:
        weight: of the total variation; see `TomographySignal`.
        noise_model: makes the noise model for given images; a mean-preserving flow behind the detector's rounding and
            rails by default. One without trainable parameters is used as it is.
        make_field: makes the field from shape and scale.
        num_steps: steps of the joint fit.
        warm_up: steps of least squares before it.
        noise_warm_up: steps of the noise model alone, after those.
        estimate_response: whether incident intensity or offset are learnt.
        seed: of every random choice.
        device: where to compute.
    """

    weight: float = 0.25
    noise_model: Callable[[NDArrayAny], nn.Module] = field(default_factory=lambda: automatic_noise_model)
    make_field: Callable[..., Field] = MultiresolutionField
    num_steps: int = 150
    warm_up: int = 40
    noise_warm_up: int = 150
    estimate_response: bool = True
    seed: int = 0
    device: torch.device | str = "cpu"

    def __call__(
        self, tilt_series: TiltSeries, grid: VolumeGrid | None = None, *, progress: Progress | None = None
    ) -> Reconstruction:
        """Reconstruct on `grid`, by default one voxel per pixel and as deep as wide.

        Raises:
            ValueError: the grid does not match the images, or the fit found no finite step.
        """
        grid = VolumeGrid.of(tilt_series) if grid is None else grid
        signal_model = self.prepare(tilt_series, grid)
        observation = _observation(tilt_series, self.device)
        generator = torch.Generator().manual_seed(self.seed)
        held_out = block_mask(observation.shape, generator=generator).to(observation.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            noise_model = self.noise_model(tilt_series.images).to(self.device)
        options: dict[str, Any] = {"held_out": held_out, "generator": generator}
        if not isinstance(noise_model, Gaussian):
            fit(Gaussian().to(self.device), signal_model, observation, num_steps=self.warm_up, **options)
            with torch.no_grad():
                signal = signal_model.signal().view_as(observation)
            fit(noise_model, signal, observation, num_steps=self.noise_warm_up, **options)
            options["standardise"] = False
        result = fit(noise_model, signal_model, observation, num_steps=self.num_steps, progress=progress, **options)
        return _finished(signal_model, noise_model, result, grid)

    def prepare(self, tilt_series: TiltSeries, grid: VolumeGrid) -> TomographySignal:
        """The signal model before any fit: an almost empty field on the scale of the data."""
        _, height, width = tilt_series.images.shape
        if grid.height != height:
            raise ValueError(
                f"the volume is {grid.height} voxels high and the images {height} pixels; they must be equal"
            )
        projector = SliceProjector(
            tilt_angles=tilt_series.tilt_angles,
            depth=grid.depth,
            width=grid.width,
            detector_width=width,
            device=self.device,
        )
        response = estimate_response(tilt_series, estimate=self.estimate_response).to(self.device)
        scale = _attenuation_scale(tilt_series, response, projector)
        volume = self.make_field(grid.shape, scale=scale).to(self.device)
        return TomographySignal(volume, projector, response, weight=self.weight)


NDArrayAny = np.ndarray[Any, np.dtype[Any]]


def automatic_noise_model(images: NDArrayAny) -> nn.Module:
    """A mean-preserving radial flow behind the rounding and the rails that the images show."""
    step = 1.0 if np.issubdtype(images.dtype, np.integer) else 0.0
    low, high = find_rails(images)
    flow = RadialFlow(mean_preserving=True)
    return flow if step == 0 and not np.isfinite([low, high]).any() else Digitised(flow, step=step, low=low, high=high)


def find_rails(images: NDArrayAny, *, least: int = 10) -> tuple[float, float]:
    """The readings (low, high) at which a detector saturates, or infinity where it does not.

    A rail is an extreme reading that at least `least` pixels share, and twice as many as share the reading next to it.
    """
    rails = []
    for extreme, none in ((images.min(), -np.inf), (images.max(), np.inf)):
        rest = images[images != extreme]
        neighbour = (rest.min() if none < 0 else rest.max()) if rest.size else extreme
        count, beside = images.size - rest.size, int((rest == neighbour).sum())
        rails.append(float(extreme) if count >= least and count > 2 * beside else none)
    return rails[0], rails[1]


def estimate_response(tilt_series: TiltSeries, *, estimate: bool = True) -> Transmission | Linear:
    """A first guess of the detector's response: vacuum is brightest in bright field, darkest in HAADF."""
    images = tilt_series.images.astype(np.float32)
    block = max(1, min(8, *(size // 8 for size in images.shape[1:])))
    tilts, height, width = (images.shape[0], *(size // block * block for size in images.shape[1:]))
    means = images[:, :height, :width].reshape(tilts, height // block, block, width // block, block).mean((2, 4))
    if tilt_series.mode == "linear":
        return Linear(offset=float(np.quantile(means, 0.02)), estimate=estimate)
    intensity = float(np.quantile(means, 0.95))
    if intensity <= 0:
        raise ValueError(
            "a transmission series is brightest where there is vacuum; these images are negative: try --mode linear"
        )
    return Transmission(intensity, estimate=estimate)


def block_mask(shape: tuple[int, ...], *, share: float = 0.1, block: int = 4, generator: torch.Generator) -> Tensor:
    """Pixels (tilt, u, y) to hold out: whole blocks in every image, so that neighbours do not give them away."""
    tilts, *sides = shape
    coarse = torch.rand((tilts, *(-(-side // block) for side in sides)), generator=generator) < share
    return coarse.repeat_interleave(block, 1).repeat_interleave(block, 2)[:, : sides[0], : sides[1]]


def _observation(tilt_series: TiltSeries, device: torch.device | str) -> Tensor:
    images = np.ascontiguousarray(tilt_series.images.transpose(0, 2, 1), dtype=np.float32)
    return torch.from_numpy(images).to(device)


def _attenuation_scale(tilt_series: TiltSeries, response: Transmission | Linear, projector: SliceProjector) -> float:
    """Attenuation of what is not vacuum, from a few iterations of SIRT on a thin sample of smoothed slices."""
    images = torch.from_numpy(np.asarray(tilt_series.images, dtype=np.float32))
    bands = torch.nn.functional.avg_pool2d(images[:, None], (min(4, images.shape[1]), 1))[:, 0]
    bands = bands[:, :: max(1, bands.shape[1] // 16)].to(projector.matrix.device)
    with torch.no_grad():
        volume = sirt(response.invert(bands).contiguous(), projector, num_iterations=30)
        power = (volume**2).sum()
        return float((volume**3).sum() / power) if power > 0 else 1.0


def _finished(model: TomographySignal, noise_model: nn.Module, result: FitResult, grid: VolumeGrid) -> Reconstruction:
    with torch.no_grad():
        volume = Volume(model.field.volume().cpu().numpy(), grid.voxel_size)
        shape = (model.projector.num_tilts * model.projector.detector_width, model.field.height)
        projections = from_rays(model.signal().view(shape), model.projector.num_tilts).contiguous().cpu().numpy()
    return Reconstruction(volume, projections, noise_model, model, result)
