"""The negative log-posterior of a fitted volume as a function of the voxels, with its gradient."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from noiseflow.fitting.observation_table import ObservationTable
from recon.joint.signal_model import TomographySignal
from recon.projection.base import from_columns

_SOFTENED = 10  # factor on the smoothing: a tenth of the stiffness, and with 0.2 units still below relevant differences
_POWER_STEPS = 8
_SAFE = 1.2  # a power iteration with few steps underestimates


class Energy:
    """Negative log-density of a volume in units of the field's scale: −log p(observation | volume) + weight · regulariser.

    Args:
        model: the fitted signal model.
        noise_model: the noise model of the fit.
        observation: (tilt, u, y) pixel values.
        train: (tilt, u, y) True at the pixels used in the fit.
    """

    def __init__(self, model: TomographySignal, noise_model: nn.Module, observation: Tensor, train: Tensor) -> None:
        self.model = model
        self.scale, self.train = float(model.field.scale), train
        with torch.no_grad():
            field = model.field
            self.start = field().clone() / self.scale if model.occupancy is None else field.on(model.tiles).clone()
            signal = model.signal()
        self.weight = model.weight * float(train.sum()) / (self.scale * model.num_pixels)
        pixels = observation[train]
        low, high = (float(end) for end in torch.aminmax(torch.cat([signal.reshape(-1), pixels])))
        filled = torch.where(train, observation, pixels.mean())  # excluded pixels may be NaN
        self.table = ObservationTable(noise_model, filled.reshape(-1), low, high)

    @property
    def filled(self) -> Tensor | float:
        """1 at occupied voxels."""
        return 1.0 if self.model.occupancy is None else self.model.tiles.filled

    def _rays(self, units: Tensor) -> Tensor:
        values = units * self.scale
        return (
            self.model.projector.project(values) if self.model.occupancy is None else self.model.tiles.project(values)
        )

    def _misfit(self, units: Tensor) -> Tensor:
        """A function with the gradient of the negative log-likelihood; its value is not meaningful."""
        signal: Tensor = self.model.image_formation(self._rays(units).view(self.train.shape))
        return -torch.dot(self.table.slope(signal.detach().reshape(-1)) * self.train.reshape(-1), signal.reshape(-1))

    def _cost(self, units: Tensor) -> Tensor:
        values, scale, model = units * self.scale, _SOFTENED * self.scale, self.model
        shape = (model.field.depth, model.field.width, model.field.height)
        volume = values.view(shape) if model.occupancy is None else model.tiles.spread(values)
        return self.weight * model.regulariser(volume, scale)

    def gradient(self, units: Tensor) -> Tensor:
        """Gradient of the energy, nats per unit."""
        return _slope(lambda values: self._misfit(values) + self._cost(values), units)

    def stiffness(self) -> float:
        """Largest curvature at the fit, nats per square unit, by power iteration for likelihood and regulariser separately."""
        generator = torch.Generator(self.start.device).manual_seed(0)
        rough = torch.randn(self.start.shape, generator=generator, device=self.start.device)
        even = torch.ones_like(self.start)
        return _SAFE * (self._largest(self._misfit, even) + self._largest(self._cost, rough))

    def _largest(self, part: Callable[[Tensor], Tensor], direction: Tensor) -> float:
        start, found = _slope(part, self.start), 0.0
        for _ in range(_POWER_STEPS):
            direction = direction * self.filled
            # units: within the quadratic range of the smoothing
            step = 0.01 * direction / direction.abs().max().clamp_min(1e-30)
            direction = _slope(part, self.start + step) - start
            found = float(direction.norm() / step.norm().clamp_min(1e-30))
        return found

    def volume(self, units: Tensor) -> Tensor:
        """Attenuation per voxel, (z, y, x)."""
        columns = units if self.model.occupancy is None else self.model.tiles.lattice(units)
        return from_columns(columns * self.scale, self.model.field.depth).contiguous()


def _slope(function: Callable[[Tensor], Tensor], units: Tensor) -> Tensor:
    with torch.enable_grad():
        leaf = units.detach().requires_grad_()
        (found,) = torch.autograd.grad(function(leaf), leaf)
    return found
