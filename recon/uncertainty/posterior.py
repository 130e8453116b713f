"""Posterior samples of a fitted volume by Langevin dynamics (Roberts & Tweedie 1996, doi:10.2307/3318418)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow import Correlated
from noiseflow.fitting.observation_table import ObservationTable
from noiseflow.metrics.spatial import correlation_kernel
from recon.joint.checkpoint import RunStage, run_stage
from recon.joint.signal_model import TomographySignal
from recon.reconstruction import Reconstruction
from recon.scale.blocks import Block
from recon.series.tilt_series import TiltSeries, Volume, central
from recon.uncertainty.measure import wedge_std
from recon.uncertainty.result import ShellBand, ShellSums, Uncertainty

_STEPS = 30  # between two samples
# pixels whose residuals are enough to measure how neighbours correlate, to 0.001
CORRELATED = 2**20
_PARTS = ("units", "away", "squares")  # of the state of a chain


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

    def _misfit(self, units: Tensor) -> Tensor:
        """A function with the gradient of the negative log-likelihood; its value is not meaningful."""
        signal: Tensor = self.model.image_formation(self.model.rays(units * self.scale).view(self.train.shape))
        return -torch.dot(self.table.slope(signal.detach().reshape(-1)) * self.train.reshape(-1), signal.reshape(-1))

    def _cost(self, units: Tensor, softened: int = 10) -> Tensor:
        """The regulariser with so many times the smoothing: a tenth of the stiffness, and with 0.2 units still below relevant
        differences."""
        return self.weight * self.model.cost(units * self.scale, softened * self.scale)

    def gradient(self, units: Tensor) -> Tensor:
        """Gradient of the energy, nats per unit."""
        return _slope(lambda values: self._misfit(values) + self._cost(values), units)

    def stiffness(self, *, steps: int = 8, safe: float = 1.2) -> float:
        """Largest curvature at the fit, nats per square unit, by power iteration for likelihood and regulariser separately, which
        with few `steps` underestimates it."""
        generator = torch.Generator(self.start.device).manual_seed(0)
        rough = torch.randn(self.start.shape, generator=generator, device=self.start.device)
        even = torch.ones_like(self.start)
        return safe * (self._largest(self._misfit, even, steps) + self._largest(self._cost, rough, steps))

    def _largest(self, part: Callable[[Tensor], Tensor], direction: Tensor, steps: int) -> float:
        start, found = _slope(part, self.start), 0.0
        for _ in range(steps):
            direction = direction * self.filled
            # units: within the quadratic range of the smoothing
            step = 0.01 * direction / direction.abs().max().clamp_min(1e-30)
            direction = _slope(part, self.start + step) - start
            found = float(direction.norm() / step.norm().clamp_min(1e-30))
        return found

    def volume(self, units: Tensor) -> Tensor:
        """Attenuation per voxel, (z, y, x)."""
        return self.model.volume_of(units * self.scale)


def _slope(function: Callable[[Tensor], Tensor], units: Tensor) -> Tensor:
    with torch.enable_grad():
        leaf = units.detach().requires_grad_()
        (found,) = torch.autograd.grad(function(leaf), leaf)
    return found


class Posterior:
    """A Markov chain of posterior volumes as a stage; one step of the stage gives one sample.

    Langevin steps follow the negative gradient of `Energy` with added Gaussian noise; negative values are reflected. Noise model,
    weight and detector response are fixed. If residuals of neighbouring pixels correlate, the likelihood counts each of them as
    too many; the chain then runs at the temperature 1 / `noiseflow.Correlated.effective_share`, which leaves the mode in place.

    Args:
        outcome, tilt_series: a fitted reconstruction, and its data, with tilts in the same order.
        block: the slices of these images within the whole volume.
        visit: called with every sample, (z, y, x), attenuation per voxel.

    Raises:
        ValueError: the reconstruction was not fitted, or `num_samples` is less than two.
    """

    def __init__(
        self,
        outcome: Reconstruction,
        tilt_series: TiltSeries,
        num_samples: int,
        *,
        seed: int = 0,
        block: Block | None = None,
        visit: Callable[[Tensor], None] | None = None,
    ) -> None:
        model, noise_model = outcome.signal_model, outcome.likelihood or outcome.noise_model
        if model is None or noise_model is None:
            raise ValueError(f"method {outcome.method} fits no noise model; for error bars use --method joint")
        if num_samples < 2:
            raise ValueError(f"--uncertainty {num_samples}: give at least 2 samples (typically 16)")
        self.done, self.num_steps, self.visit = 0, num_samples, visit
        self.fitted, self.tilt_angles = outcome.volume.attenuation, tilt_series.tilt_angles
        self.width = outcome.volume.attenuation.shape[2]
        self.voxel_size, device = outcome.volume.voxel_size, model.field.scale.device
        self.orientation = outcome.orientation  # as in the fit
        if outcome.tilts is not None:
            tilt_series = tilt_series.select(np.unique(outcome.tilts, return_index=True)[1])
        tilt_series = self.orientation.series(tilt_series)
        observation = torch.from_numpy(tilt_series.images.astype(np.float32)).mT.contiguous().to(device)
        rows, height = (None, observation.shape[2]) if block is None else (block.wide, block.height)
        use = torch.ones_like(observation, dtype=torch.bool)
        if tilt_series.mask is not None:
            use = torch.from_numpy(np.ascontiguousarray(tilt_series.mask)).mT.contiguous().to(device)
        self.energy = Energy(model, noise_model, observation, use)
        # the stiffness of a block of vacuum is zero, and nothing changes
        self.step_size = 1 / (self.energy.stiffness() or 1.0)
        seen = torch.where(use, observation, torch.nan)
        # residuals of some tilts tell how many independent pixels each is worth; a blur of 1.5 pixels correlates neighbours up to
        # twice as far as the kernel reaches, but little
        some = slice(None, None, -(-observation.numel() // CORRELATED))
        signal = model.signal().detach().view_as(observation)
        kernel = correlation_kernel(noise_model, signal[some], seen[some])
        self.temperature = 1 / Correlated(noise_model, kernel).effective_share
        first = 0 if rows is None else rows.start
        self.generator = torch.Generator(device).manual_seed(seed + 1 + first)  # different blocks need different noise
        self.units = self.energy.start.clone()
        self.away, self.squares = torch.zeros_like(self.units), torch.zeros_like(self.units)  # from the fit, summed
        shares = None if block is None else torch.from_numpy(block.shares())
        self.sums = ShellSums(self._central(self.units), shares=shares, height=height)

    @torch.no_grad()
    def step(self) -> str:
        """Advance the chain to the next sample."""
        if self.done == 0:
            for _ in range(4 * _STEPS):  # from the posterior mode to a typical volume
                self._move()
        for _ in range(_STEPS):
            self._move()
            away = self.units - self.energy.start
            self.away.add_(away)
            self.squares.addcmul_(away, away)
        if not bool(torch.isfinite(self.units).all()):
            raise ValueError("the sampling of error bars diverged (a voxel is not finite); check the scale of the data")
        self.done += 1
        self.sums.add(self._central(self.units))
        if self.visit is not None:
            self.visit(torch.from_numpy(self._volume(self.units)))
        return f"sample {self.done}"

    def _move(self) -> None:
        noise = torch.randn(self.units.shape, generator=self.generator, device=self.units.device)
        self.units.sub_(self.energy.gradient(self.units), alpha=self.step_size)
        self.units.add_(noise, alpha=(2 * self.temperature * self.step_size) ** 0.5).abs_().mul_(self.energy.filled)

    def _central(self, units: Tensor) -> Tensor:
        """The volume on the grid of the reconstruction, without the margins of the fit."""
        found: Tensor = central(self.energy.volume(units), self.width)
        return found

    def _volume(self, units: Tensor) -> np.ndarray:
        return np.ascontiguousarray(self.orientation.volume(self._central(units).cpu().numpy()))

    def state(self) -> dict[str, Any]:
        chain = {"done": self.done, "generator": self.generator.get_state(), "sums": self.sums.state()}
        return chain | {name: getattr(self, name) for name in _PARTS}

    def load_state(self, state: dict[str, Any]) -> None:
        self.done = state["done"]
        self.generator.set_state(state["generator"])
        self.sums.load_state(state["sums"])
        for name in _PARTS:
            setattr(self, name, state[name].to(self.units).clone())

    def maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviation and bias from the samples so far, (z, y, x), attenuation per voxel."""
        count = self.done * _STEPS
        mean = self.away / count
        std = ((self.squares - self.away * mean) / (count - 1)).clamp_min(0).sqrt()
        return self._volume(std), self._volume(mean)

    def result(self) -> Uncertainty:
        """Error bars and expected Fourier shell correlation from the samples so far."""
        std, bias = self.maps()
        wedge = wedge_std(self.fitted, std, bias, self.tilt_angles)
        parts = [Volume(part, self.voxel_size) for part in (std, bias, wedge)]
        return Uncertainty(parts[0], parts[1], parts[2], self.done, ShellBand.of(self.sums.powers()))


def error_bars(
    outcome: Reconstruction,
    tilt_series: TiltSeries,
    num_samples: int = 16,
    *,
    seed: int = 0,
    run_stage: RunStage = run_stage,
    prefix: str = "",
) -> Uncertainty:
    """Standard deviation and bias of every voxel of a fitted volume, from samples of its posterior.

    The posterior is the likelihood of the fitted pixels times exp(−weight · regulariser). In the missing wedge it is determined
    by the regulariser alone. Voxels treated as vacuum have zero standard deviation.

    Args:
        outcome, tilt_series: a volume that was fitted with a noise model, and its data, with tilts in the same order.
        num_samples: number of samples, thirty steps of the chain apart.
        run_stage: runs the stage; `recon.joint.checkpoint.Journal.run_stage` also saves its state.
        prefix: prefix of the name of the stage.

    Raises:
        ValueError: the reconstruction was not fitted, or `num_samples` is less than two.
    """
    posterior = Posterior(outcome, tilt_series, num_samples, seed=seed)
    run_stage(f"{prefix}error bars", posterior)
    return posterior.result()
