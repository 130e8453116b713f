"""The one optimisation loop: a noise model alone on known signals, or jointly with any model of the signal."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

Progress = Callable[[int, str], None]
_STANDARDISE_COUNT = 2_000_000
_MAX_RECOVERIES = 8


class KnownSignal(nn.Module):
    """A known clean image as a signal model: nothing to learn.

    Args:
        signal: clean image, any shape, detector units.
    """

    flat: Tensor

    def __init__(self, signal: Tensor) -> None:
        super().__init__()
        self.register_buffer("flat", signal.detach().reshape(-1))

    def forward(self, pixels: Tensor) -> Tensor:
        return self.flat[pixels]

    def signal(self) -> Tensor:
        """All pixels, flat."""
        return self.flat


class StaticScene(nn.Module):
    """Repeated exposures of one still scene: the clean image is learnt, one value per pixel.

    Args:
        exposures: (n, ...) repeated exposures, detector units; the clean image starts at their mean.
    """

    def __init__(self, exposures: Tensor) -> None:
        super().__init__()
        if exposures.shape[0] < 2:
            raise ValueError("a static scene needs at least two exposures; one exposure cannot tell signal from noise")
        self.count = exposures.shape[0]
        mean = exposures.to(torch.get_default_dtype()).mean(0)
        self.shape = mean.shape
        self.scene = nn.Parameter(mean.reshape(-1).clone())

    def forward(self, pixels: Tensor) -> Tensor:
        return self.scene[pixels % self.scene.numel()]

    def signal(self) -> Tensor:
        """All pixels of all exposures, flat."""
        return self.scene.repeat(self.count)

    def image(self) -> Tensor:
        """The clean image."""
        return self.scene.detach().reshape(self.shape)


@dataclass
class FitResult:
    """What a fit reached.

    Attributes:
        held_out_nll: mean negative log-likelihood of the held-out pixels, nats per pixel.
        num_steps: steps taken.
        seconds: wall time.
        recoveries: how often a non-finite step was undone with half the learning rate.
        history: step → held-out NLL, in the order measured.
    """

    held_out_nll: float = math.nan
    num_steps: int = 0
    seconds: float = 0.0
    recoveries: int = 0
    history: dict[int, float] = field(default_factory=dict)


def fit(
    noise_model: nn.Module,
    signal: Tensor | nn.Module,
    observation: Tensor,
    *,
    mask: Tensor | None = None,
    held_out: float | Tensor = 0.1,
    num_steps: int = 500,
    batch_size: int = 8192,
    learning_rate: float = 1e-2,
    signal_optimiser: torch.optim.Optimizer | None = None,
    noise_interval: int = 1,
    standardise: bool = True,
    generator: torch.Generator | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """Fit a noise model in place by maximum likelihood; with a trainable signal model, fit both jointly.

    Args:
        noise_model: the model to fit; one without trainable parameters stays as it is.
        signal: clean signals shaped like `observation`, or a `SignalModel`.
        observation: noisy readings, any shape, detector units.
        mask: pixels to use, shaped like `observation`; all by default.
        held_out: fraction of the pixels, or a boolean tensor of those, that judge the fit and never train it.
        num_steps: optimisation steps.
        batch_size: pixels per noise-model step.
        learning_rate: of the noise model, decaying to zero over the fit.
        signal_optimiser: optimiser of the signal model; Adam by default.
        noise_interval: signal steps between two noise-model steps.
        standardise: measure the data's scaling first and store it in the noise model.
        generator: source of the random choices.
        progress: called with the steps done and a note.

    Returns:
        The held-out likelihood and its history. The noise model ends at its best held-out state.

    Raises:
        ValueError: shapes differ, pixels are not finite, too few pixels, or no finite step could be made.
    """
    loop = _Loop(noise_model, signal, observation, mask, held_out, generator)
    if standardise and hasattr(noise_model, "standardise"):
        loop.standardise()
    return loop.run(num_steps, batch_size, learning_rate, signal_optimiser, noise_interval, progress)


class _Loop:
    def __init__(
        self,
        noise_model: nn.Module,
        signal: Tensor | nn.Module,
        observation: Tensor,
        mask: Tensor | None,
        held_out: float | Tensor,
        generator: torch.Generator | None,
    ) -> None:
        if isinstance(signal, Tensor) and signal.shape != observation.shape:
            raise ValueError(f"signal has shape {tuple(signal.shape)}, observation {tuple(observation.shape)}; they must be equal")
        self.noise_model = noise_model
        self.signal_model = KnownSignal(signal) if isinstance(signal, Tensor) else signal
        self.observation = observation.reshape(-1)
        self.generator = generator
        use = torch.ones_like(self.observation, dtype=torch.bool) if mask is None else mask.reshape(-1).bool()
        self._check(use)
        if isinstance(held_out, Tensor):
            judge = held_out.reshape(-1).bool()
        else:
            judge = torch.rand(use.shape, generator=generator) < held_out
        self.train = torch.nonzero(use & ~judge).squeeze(1)
        self.judge = torch.nonzero(use & judge).squeeze(1)
        if self.train.numel() < 2 or self.judge.numel() < 1:
            raise ValueError(f"{int(use.sum())} usable pixels are too few to fit and judge a noise model; use a larger image")

    def _check(self, use: Tensor) -> None:
        values = self.observation[use]
        bad = int((~torch.isfinite(values)).sum())
        if isinstance(self.signal_model, KnownSignal):
            bad += int((~torch.isfinite(self.signal_model.flat[use])).sum())
        if bad:
            raise ValueError(f"{bad} pixels of signal or observation are NaN or infinite; pass a mask that leaves them out")

    def standardise(self) -> None:
        with torch.no_grad():
            pixels = self.train[:: max(1, self.train.numel() // _STANDARDISE_COUNT)]
            self.noise_model.standardise(self._signal(pixels), self.observation[pixels])  # type: ignore[operator]

    def _signal(self, pixels: Tensor) -> Tensor:
        predicted: Tensor = self.signal_model(pixels)
        return predicted

    def run(
        self,
        num_steps: int,
        batch_size: int,
        learning_rate: float,
        signal_optimiser: torch.optim.Optimizer | None,
        noise_interval: int,
        progress: Progress | None,
    ) -> FitResult:
        started = time.perf_counter()
        result = FitResult()
        noise_parameters = [p for p in self.noise_model.parameters() if p.requires_grad]
        signal_parameters = [p for p in self.signal_model.parameters() if p.requires_grad]
        optimisers = []
        if noise_parameters:
            noise_optimiser = torch.optim.Adam(noise_parameters, lr=learning_rate, betas=(0.9, 0.99))
            optimisers.append(noise_optimiser)
        if signal_parameters:
            signal_optimiser = signal_optimiser or torch.optim.Adam(signal_parameters, lr=learning_rate)
            optimisers.append(signal_optimiser)
        if not optimisers:
            result.held_out_nll = self.held_out_nll()
            return result
        schedules = [torch.optim.lr_scheduler.CosineAnnealingLR(o, num_steps, eta_min=0.0) for o in optimisers]
        best = good = self._state()
        batches = self._batches(batch_size)
        check_every = max(1, num_steps // 20)
        for step in range(1, num_steps + 1):
            finite = True
            if signal_parameters and signal_optimiser is not None:
                finite &= _step(signal_optimiser, self._signal_loss(next(batches)))
            if noise_parameters and step % noise_interval == 0:
                finite &= _step(noise_optimiser, self._noise_loss(next(batches)))
            for schedule in schedules:
                schedule.step()
            if not finite:
                result.recoveries += 1
                self._recover(good, optimisers, schedules, result.recoveries)
            if step % check_every == 0 or step == num_steps:
                nll = self.held_out_nll()
                if math.isfinite(nll):
                    good = self._state()
                    if nll <= min(result.history.values(), default=math.inf):
                        best = good
                    result.history[step] = nll
                if progress is not None:
                    progress(step, f"held-out NLL {nll:.4f}")
        self.noise_model.load_state_dict(best)
        result.held_out_nll = min(result.history.values(), default=math.nan)
        result.num_steps, result.seconds = num_steps, time.perf_counter() - started
        return result

    def _state(self) -> dict[str, Any]:
        return copy.deepcopy(self.noise_model.state_dict())

    def _recover(self, good: dict[str, Any], optimisers: list[Any], schedules: list[Any], count: int) -> None:
        if count > _MAX_RECOVERIES:
            raise ValueError("the likelihood stays NaN or infinite after halving the learning rate eight times; check the data's scale")
        self.noise_model.load_state_dict(good)
        for optimiser, schedule in zip(optimisers, schedules, strict=True):
            optimiser.state.clear()
            schedule.base_lrs = [rate / 2 for rate in schedule.base_lrs]
            for group in optimiser.param_groups:
                group["lr"] /= 2

    def _batches(self, batch_size: int) -> Iterator[Tensor]:
        while True:
            order = torch.randperm(self.train.numel(), generator=self.generator)
            yield from torch.split(self.train[order], batch_size)

    def _noise_loss(self, pixels: Tensor) -> Tensor:
        with torch.no_grad():
            signal = self._signal(pixels)
        return -self._log_prob(signal, pixels).mean()

    def _signal_loss(self, pixels: Tensor) -> Tensor:
        if hasattr(self.signal_model, "signal"):
            pixels = self.train
            signal = self.signal_model.signal()[pixels]  # type: ignore[operator]
        else:
            signal = self._signal(pixels)
        loss = -self._log_prob(signal, pixels).mean()
        if hasattr(self.signal_model, "penalty"):
            loss = loss + self.signal_model.penalty()  # type: ignore[operator]
        return loss

    def _log_prob(self, signal: Tensor, pixels: Tensor) -> Tensor:
        log_prob: Tensor = self.noise_model(signal).log_prob(self.observation[pixels])
        return log_prob

    @torch.no_grad()
    def held_out_nll(self) -> float:
        """Mean negative log-likelihood of at most 10⁵ held-out pixels, nats per pixel."""
        pixels = self.judge[:: max(1, self.judge.numel() // 100_000)]
        total = sum(float(-self._log_prob(self._signal(part), part).sum()) for part in torch.split(pixels, 65536))
        return total / pixels.numel()


def _step(optimiser: torch.optim.Optimizer, loss: Tensor) -> bool:
    """One step of an optimiser; False, and no step, where loss or gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    if not torch.isfinite(loss):
        return False
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = [p.grad for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    if not all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
        return False
    optimiser.step()
    return True
