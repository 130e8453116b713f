"""Samples of the posterior of a fitted volume by Langevin steps (Roberts & Tweedie 1996, doi:10.2307/3318418)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from recon.joint.stages import RunStage, run_stage
from recon.joint.task import block_mask
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import TiltSeries, Volume
from recon.uncertainty.energy import Energy
from recon.uncertainty.moments import Moments
from recon.uncertainty.result import Uncertainty
from recon.uncertainty.shell_band import ShellSums

if TYPE_CHECKING:
    from recon.scale.blocks import Block

_STEPS = 30  # between two samples
_SETTLE = 120  # steps that lead from the most likely volume to a usual one
_EVERY = 3  # steps between volumes that are averaged: neighbours are nearly alike
_SHARE = 0.1  # of the pixels, left out as in the fit, so that the posterior knows no more


class Posterior:
    """A chain of volumes that are compatible with the images and with the regulariser, as a stage: one step gives one sample.

    A step goes down the gradient of `Energy` and is disturbed by Gaussian noise; what would be negative is reflected. Noise
    model, weight and detector response stay as the fit left them.

    Args:
        outcome: a fitted reconstruction.
        tilt_series: what it was made of, tilts in the same order.
        num_samples: how many.
        seed: of the fit and of the chain.
        block: the slices of these images among all of the volume: they say which pixels its fit left out.
        visit: called with every sample, (z, y, x), attenuation per voxel.

    Raises:
        ValueError: a reconstruction that no fit made, or fewer than two samples.
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
            raise ValueError(
                f"method {outcome.method} fits no volume under a noise model; error bars need --method joint"
            )
        if num_samples < 2:
            raise ValueError(f"--uncertainty {num_samples}: a spread needs at least 2 samples; 16 are usual")
        self.done, self.num_steps, self.visit = 0, num_samples, visit
        self.voxel_size, device = outcome.volume.voxel_size, model.field.scale.device
        self.orientation = outcome.orientation  # the fit saw the series so
        rising = tilt_series.select(slice(None, None, -1)) if self.orientation.negated else tilt_series
        tilt_series = self.orientation.series(rising)
        observation = _native(tilt_series.images.astype(np.float32)).to(device)
        generator = torch.Generator().manual_seed(seed)
        rows, height = (None, observation.shape[2]) if block is None else (block.wide, block.height)
        shape = (*observation.shape[:2], height)
        train = ~block_mask(shape, share=_SHARE, rows=rows, generator=generator).to(device)
        if tilt_series.mask is not None:
            train &= _native(tilt_series.mask).to(device)
        self.energy = Energy(model, noise_model, observation, train)
        self.step_size = 1 / (self.energy.stiffness() or 1.0)  # a block of vacuum has none, and nothing moves
        first = 0 if rows is None else rows.start
        self.generator = torch.Generator(device).manual_seed(seed + 1 + first)  # blocks must not share their noise
        self.units, self.moments = self.energy.start.clone(), Moments(self.energy.start)
        shares = None if block is None else torch.from_numpy(block.shares())
        self.sums = ShellSums(self.energy.volume(self.units), shares=shares, height=height)

    @torch.no_grad()
    def step(self) -> str:
        """Lead the chain to its next sample."""
        if self.done == 0:
            for _ in range(_SETTLE):
                self._move()
        for number in range(_STEPS):
            self._move()
            if number % _EVERY == 0:
                self.moments.add(self.units)
        if not bool(torch.isfinite(self.units).all()):
            raise ValueError("the error bars diverged: a voxel is no longer finite; check the data's scale")
        self.done += 1
        self.sums.add(self.energy.volume(self.units))
        if self.visit is not None:
            self.visit(torch.from_numpy(self._volume(self.units)))
        return f"sample {self.done}"

    def _move(self) -> None:
        noise = torch.randn(self.units.shape, generator=self.generator, device=self.units.device)
        self.units.sub_(self.energy.gradient(self.units), alpha=self.step_size)
        self.units.add_(noise, alpha=(2 * self.step_size) ** 0.5).abs_().mul_(self.energy.filled)

    def _volume(self, units: Tensor) -> np.ndarray:
        return np.ascontiguousarray(self.orientation.volume(self.energy.volume(units).cpu().numpy()))

    def state(self) -> dict[str, Any]:
        """The chain where it is, and its moments so far."""
        chain = {"done": self.done, "units": self.units, "generator": self.generator.get_state()}
        return chain | {"moments": self.moments.state(), "sums": self.sums.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.done, self.units = state["done"], state["units"].to(self.units).clone()
        self.generator.set_state(state["generator"])
        self.moments.load_state(state["moments"])
        self.sums.load_state(state["sums"])

    def result(self) -> Uncertainty:
        """Standard deviation, bias and expected shell correlation from the samples so far."""
        parts = self.moments.std, self.moments.mean - self.energy.start
        std, bias = (Volume(self._volume(part), self.voxel_size) for part in parts)
        return Uncertainty(std, bias, self.done, self.sums.powers().band())


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

    The posterior is what noise model and weight say: the likelihood of the pixels that were fitted, times
    exp(−weight · regulariser).
    Where the missing wedge hides something, only the regulariser speaks. Voxels that count as vacuum have no spread.

    Args:
        outcome: of a method that fits a volume under a noise model.
        tilt_series: what it was made of, tilts in the same order.
        num_samples: how many; they are thirty steps of the chain apart.
        seed: of the fit; it leaves the same pixels out.
        run_stage: carries the stage out; `recon.joint.checkpoint.Journal.run_stage` keeps what it has reached.
        prefix: of the name under which it does.

    Raises:
        ValueError: a reconstruction that no fit made, or fewer than two samples.
    """
    posterior = Posterior(outcome, tilt_series, num_samples, seed=seed)
    run_stage(f"{prefix}error bars", posterior)
    return posterior.result()


def _native(images: np.ndarray) -> Tensor:
    """(tilt, y, u) to the projector's order (tilt, u, y)."""
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 2, 1)))
