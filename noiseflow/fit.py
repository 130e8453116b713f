"""The one optimisation loop: a noise model alone on known signals, or jointly with any model of the signal."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.observation_table import ObservationTable
from noiseflow.signal_models import KnownSignal

Progress = Callable[[int, str], None]
Checkpoint = Callable[[dict[str, Any]], None]
_STANDARDISE_COUNT = 1_000_000
_TABLE_COUNT = 30_000
_LOOK_COUNT = 20_000
_MAX_RECOVERIES = 8
_LAST_RATE = 0.01


@dataclass
class FitResult:
    """What a fit reached.

    Attributes:
        held_out_nll: mean negative log-likelihood of the held-out pixels, nats per pixel.
        num_steps: steps taken.
        seconds: wall time.
        recoveries: how often a non-finite step was undone with half the learning rate.
        history: step → held-out NLL, in the order measured.
        table_error: interpolation error of the tabulated likelihood, nats per pixel; None where none was used.
    """

    held_out_nll: float = math.nan
    num_steps: int = 0
    seconds: float = 0.0
    recoveries: int = 0
    history: dict[int, float] = field(default_factory=dict)
    table_error: float | None = None


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
    noise_interval: int = 10,
    noise_steps: int = 10,
    standardise: bool = True,
    tabulate: bool = True,
    generator: torch.Generator | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    checkpoint_interval: float | None = None,
    resume: dict[str, Any] | None = None,
) -> FitResult:
    """Fit a noise model in place by maximum likelihood; with a trainable signal model, fit both jointly.

    The loss is the mean negative log-likelihood of the training pixels, plus the signal model's ``penalty()`` where it has one.
    Learning rates fall geometrically to 1 %.

    Args:
        noise_model: the model to fit; one without trainable parameters stays as it is.
        signal: clean signals shaped like `observation`, or a `SignalModel`. A trainable one may offer ``parameter_groups()``,
            parameter groups with their learning rates for Adam.
        observation: noisy readings, any shape, detector units.
        mask: pixels to use, shaped like `observation`; all by default.
        held_out: fraction of the pixels, or a boolean tensor of those, that judge the fit and never train it.
        num_steps: optimisation steps.
        batch_size: pixels per noise-model step.
        learning_rate: starting rate of the noise model, and of a signal model without ``parameter_groups()``.
        noise_interval, noise_steps: in a joint fit, this many noise-model steps after every so many signal steps.
        standardise: measure the data's scaling first and store it in the noise model.
        tabulate: in a joint fit of many pixels, look the likelihood up in a table.
        generator: source of the random choices.
        progress: called with the steps done and a note.
        checkpoint: called at every look at the held-out pixels, and on Ctrl-C, with all that `resume` needs.
        checkpoint_interval: call it after a step every so many seconds instead.
        resume: a state that `checkpoint` was given; the fit goes on from there.

    Returns:
        The held-out likelihood and its history. Both models end at their best held-out state.

    Raises:
        ValueError: shapes differ, pixels are not finite, too few pixels, or no finite step could be made.
    """
    loop = _Loop(noise_model, signal, observation, mask, held_out, generator)
    loop.prepare(num_steps, learning_rate, standardise and resume is None)
    if resume is not None:
        loop.load_state(resume)
    return loop.run(
        num_steps, batch_size, noise_interval, noise_steps, tabulate, progress, checkpoint, checkpoint_interval
    )


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
            raise ValueError(
                f"signal has shape {tuple(signal.shape)}, observation {tuple(observation.shape)}; they must be equal"
            )
        self.noise_model = noise_model
        self.signal_model = KnownSignal(signal) if isinstance(signal, Tensor) else signal
        self.observation = observation.reshape(-1)
        self.generator = _own_generator(generator)
        use = torch.ones_like(self.observation, dtype=torch.bool) if mask is None else mask.reshape(-1).bool()
        self._check(use)
        if isinstance(held_out, Tensor):
            judge = held_out.reshape(-1).bool()
        else:
            judge = (torch.rand(use.shape, generator=self.generator) < held_out).to(use.device)
        self.train = torch.nonzero(use & ~judge).squeeze(1)
        self.judge = torch.nonzero(use & judge).squeeze(1)
        if self.train.numel() < 2 or self.judge.numel() < 1:
            raise ValueError(
                f"{int(use.sum())} usable pixels are too few to fit and judge a noise model; use a larger image"
            )
        self.weight = (use & ~judge).to(self.observation.dtype) / self.train.numel()
        self.result = FitResult()
        self.best: dict[str, Any] | None = None
        self.done = 0
        self.table: ObservationTable | None = None
        self.resumed_table: dict[str, Any] | None = None

    def _check(self, use: Tensor) -> None:
        bad = ~torch.isfinite(self.observation)
        if isinstance(self.signal_model, KnownSignal):
            bad |= ~torch.isfinite(self.signal_model.flat)
        count = int((bad & use).sum())
        if count:
            raise ValueError(
                f"{count} pixels of signal or observation are NaN or infinite; pass a mask that leaves them out"
            )
        if bool(bad.any()):  # masked pixels get weight 0, and 0·NaN must not reach the sum
            self.observation = torch.where(bad, self.observation[use].mean(), self.observation)

    def prepare(self, num_steps: int, learning_rate: float, standardise: bool) -> None:
        """Scale the noise model to the data and set up the optimisers."""
        if standardise and hasattr(self.noise_model, "standardise"):
            with torch.no_grad():
                pixels = self.train[:: max(1, self.train.numel() // _STANDARDISE_COUNT)]
                self.noise_model.standardise(self._signal(pixels), self.observation[pixels])  # type: ignore[operator]
        noise = [p for p in self.noise_model.parameters() if p.requires_grad]
        self.noise_optimiser = _adam([{"params": noise, "lr": learning_rate}]) if noise else None
        self.signal_optimiser = None
        if any(p.requires_grad for p in self.signal_model.parameters()):
            everything = [{"params": list(self.signal_model.parameters()), "lr": learning_rate}]
            own = getattr(self.signal_model, "parameter_groups", None)
            self.signal_optimiser = _adam(own() if own is not None else everything)
        self.optimisers = [o for o in (self.signal_optimiser, self.noise_optimiser) if o is not None]
        self.base_rates = [[group["lr"] for group in o.param_groups] for o in self.optimisers]

    def run(
        self,
        num_steps: int,
        batch_size: int,
        noise_interval: int,
        noise_steps: int,
        tabulate: bool,
        progress: Progress | None,
        checkpoint: Checkpoint | None,
        checkpoint_interval: float | None,
    ) -> FitResult:
        started = saved = time.perf_counter()
        joint = self.signal_optimiser is not None
        table = self.table = self._table() if joint and tabulate and self.train.numel() >= _TABLE_COUNT else None
        check_every = max(1, num_steps // 20)
        good = self._models()
        if self.done == 0:
            self._judge(0)  # a good start must not be lost to worse steps
        try:
            for step in range(self.done + 1, num_steps + 1):
                self._set_rates(_LAST_RATE ** ((step - 1) / num_steps) / 2**self.result.recoveries)
                finite = self._signal_step(table, batch_size) if joint else True
                if self.noise_optimiser is not None and (not joint or step % noise_interval == 0):
                    for _ in range(noise_steps if joint else 1):
                        finite &= _step(self.noise_optimiser, lambda: self._noise_loss(batch_size))
                    if table is not None:
                        table.rebuild(self.noise_model)
                if not finite:
                    self._recover(good)
                self.done = step
                look = step % check_every == 0 or step == num_steps
                if look:
                    good = self._judge(step) or good
                    if table is not None:
                        self._check_table(table, rarely=step < num_steps)
                due = look if checkpoint_interval is None else time.perf_counter() - saved >= checkpoint_interval
                if checkpoint is not None and due:
                    checkpoint(self.state())
                    saved = time.perf_counter()
                if progress is not None:
                    progress(step, f"held-out NLL {self.result.held_out_nll:.4f}")
        except KeyboardInterrupt:
            if checkpoint is not None:
                checkpoint(self.state())
            raise
        if self.best is not None:
            self._load_models(self.best)
            self.result.held_out_nll = self.held_out_nll()
        self.result.num_steps, self.result.seconds = num_steps, time.perf_counter() - started
        return self.result

    def _judge(self, step: int) -> dict[str, Any] | None:
        nll = self.held_out_nll(_LOOK_COUNT)
        if not math.isfinite(nll):
            return None
        state = self._models()
        if nll <= min(self.result.history.values(), default=math.inf):
            self.best, self.result.held_out_nll = state, nll
        self.result.history[step] = nll
        return state

    def _check_table(self, table: ObservationTable, *, rarely: bool) -> None:
        """A model that learns may outgrow its table; that is slow, and seen in every fifth look."""
        if self.noise_optimiser is not None and (not rarely or len(self.result.history) % 5 == 0):
            table.check(self.noise_model)
        self.result.table_error = table.error

    def _table(self) -> ObservationTable:
        with torch.no_grad():
            signal = self._signal(self.train[:: max(1, self.train.numel() // 100_000)])
        observed = self.observation[self.train]
        low = float(torch.minimum(signal.min(), observed.min()))
        high = float(torch.maximum(signal.max(), observed.max()))
        return ObservationTable(self.noise_model, self.observation, low, high, resume=self.resumed_table)

    def _signal_step(self, table: ObservationTable | None, batch_size: int) -> bool:
        def loss() -> Tensor:
            if hasattr(self.signal_model, "signal"):
                signal: Tensor = self.signal_model.signal()  # type: ignore[operator]
                log_prob = (
                    table.log_prob(signal) if table is not None else self.noise_model(signal).log_prob(self.observation)
                )
                value = -torch.dot(log_prob, self.weight.to(log_prob.dtype))
            else:
                pixels = self._batch(batch_size)
                value = -self.noise_model(self._signal(pixels)).log_prob(self.observation[pixels]).mean()
            return value + self.signal_model.penalty() if hasattr(self.signal_model, "penalty") else value  # type: ignore[operator]

        return self.signal_optimiser is None or _step(self.signal_optimiser, loss)

    def _noise_loss(self, batch_size: int) -> Tensor:
        pixels = self._batch(batch_size)
        with torch.no_grad():
            signal = self._signal(pixels)
        return -self.noise_model(signal).log_prob(self.observation[pixels]).mean()  # type: ignore[no-any-return]

    def _signal(self, pixels: Tensor) -> Tensor:
        predicted: Tensor = self.signal_model(pixels)
        return predicted

    def _batch(self, batch_size: int) -> Tensor:
        draw = torch.randint(self.train.numel(), (min(batch_size, self.train.numel()),), generator=self.generator)
        return self.train[draw.to(self.train.device)]

    @torch.no_grad()
    def held_out_nll(self, most: int = 100_000) -> float:
        """Mean negative log-likelihood of at most so many held-out pixels, nats per pixel."""
        pixels = self.judge[:: max(1, self.judge.numel() // most)]
        total = 0.0
        for part in torch.split(pixels, 32768):
            total -= float(self.noise_model(self._signal(part)).log_prob(self.observation[part]).double().sum())
        return total / pixels.numel()

    def _models(self) -> dict[str, Any]:
        models = {"noise_model": self.noise_model.state_dict()}
        if self.signal_optimiser is not None:
            models["signal_model"] = self.signal_model.state_dict()
        return copy.deepcopy(models)

    def _load_models(self, state: dict[str, Any]) -> None:
        self.noise_model.load_state_dict(state["noise_model"])
        if "signal_model" in state:
            self.signal_model.load_state_dict(state["signal_model"])

    def _recover(self, good: dict[str, Any]) -> None:
        self.result.recoveries += 1
        if self.result.recoveries > _MAX_RECOVERIES:
            raise ValueError(
                "the likelihood stays NaN or infinite after halving the learning rate eight times; check the data's scale"
            )
        self._load_models(good)
        for optimiser in self.optimisers:
            optimiser.state.clear()

    def _set_rates(self, factor: float) -> None:
        for optimiser, rates in zip(self.optimisers, self.base_rates, strict=True):
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * factor

    def state(self) -> dict[str, Any]:
        """All that is needed to go on from here."""
        return {
            **self._models(),
            "best": self.best,
            "optimisers": copy.deepcopy([o.state_dict() for o in self.optimisers]),
            "generator": self.generator.get_state(),
            "history": dict(self.result.history),
            "held_out_nll": self.result.held_out_nll,
            "recoveries": self.result.recoveries,
            "done": self.done,
            "table": None if self.table is None else self.table.state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go back to a state that `state` returned."""
        self._load_models(state)
        for optimiser, saved in zip(self.optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        self.generator.set_state(state["generator"])
        self.best, self.done = state["best"], state["done"]
        self.result.history, self.result.held_out_nll = dict(state["history"]), state["held_out_nll"]
        self.result.recoveries, self.resumed_table = state["recoveries"], state["table"]


def _own_generator(generator: torch.Generator | None) -> torch.Generator:
    """A stream of its own: data sampled with the same seed must not share its random numbers with the choice of pixels."""
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    return torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))


def _adam(groups: Iterable[dict[str, Any]]) -> torch.optim.Optimizer:
    return torch.optim.Adam(list(groups), betas=(0.9, 0.99), fused=True)


def _step(optimiser: torch.optim.Optimizer, loss: Callable[[], Tensor]) -> bool:
    """One step of an optimiser; False, and no step, where loss or gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    value = loss()
    if not bool(torch.isfinite(value)):
        return False
    value.backward()  # type: ignore[no-untyped-call]
    gradients = [p.grad for group in optimiser.param_groups for p in group["params"] if p.grad is not None]
    if not all(bool(torch.isfinite(gradient.sum())) for gradient in gradients):
        return False
    optimiser.step()
    return True
