"""The optimisation loop: steps of noise and signal model, evaluation of the held-out pixels, and recovery."""

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions.numerics.tables import TOLERANCE
from noiseflow.distributions.pixels import Signal, needs_image, pick, values_of, window_size
from noiseflow.fitting.observation_table import ObservationTable, TableKeeper
from noiseflow.fitting.pixel_split import JUDGED_LAST, FitPixels, thinned
from noiseflow.fitting.steps import BestState, adam, snapshot, take_step
from noiseflow.fitting.steps import FitResult as FitResult
from noiseflow.models.base import NoiseModelBase
from noiseflow.progress import Progress
from noiseflow.resources import few_threads
from noiseflow.statistics import ENOUGH

Checkpoint = Callable[[dict[str, Any]], None]
_TABLE_COUNT = 30_000
_LOOK_COUNT, _FROZEN_LOOK_COUNT = 20_000, 40_000
_LAST_RATE = 0.01
_DECAY = 0.3  # of a joint fit, multiplied by a linear decrease to zero
_LEAST_BETWEEN_LOOKS, _OF_SIGNALS = 8, 4  # steps; signals must not move far from their table between two evaluations


@dataclass(frozen=True)
class LoopSettings:
    """Settings of a fit; see `noiseflow.fit`."""

    num_steps: int
    batch_size: int
    warm_up: float
    noise_interval: int
    noise_steps: int
    tabulate: bool
    keep_last: bool
    checkpoint_interval: float | None


class FitLoop:
    """Maximum-likelihood fit of a noise model and a signal model to pixels.

    Attributes:
        widens: whether noise is learnt from residuals as wide as those of held-out pixels. A signal model with about as many
            parameters as pixels follows these, and leaves residuals that are too small.
        widening: the present factor.
    """

    def __init__(
        self,
        noise_model: NoiseModelBase,
        signal_model: nn.Module,
        pixels: FitPixels,
        result: FitResult,
        tables: TableKeeper | None = None,
    ) -> None:
        self.noise_model, self.signal_model, self.pixels, self.result = noise_model, signal_model, pixels, result
        self.tables = TableKeeper() if tables is None else tables
        self.best = BestState()
        self.done = 0
        self.table: ObservationTable | None = None
        self.widens, self.widening = False, 1.0

    def prepare(
        self,
        learning_rate: float,
        *,
        standardise: bool,
        train_noise: bool = True,
        parameter_groups: Sequence[dict[str, Any]] | None = None,
    ) -> None:
        """Scale the noise model to the data and set up the optimisers.

        Args:
            learning_rate: learning rate of the noise model, and of a signal model without parameter groups.
            standardise: measure the scaling of the data first.
            parameter_groups: parameter groups of the signal model, instead of its own.
        """
        if standardise:
            pixels = thinned(self.pixels.train, ENOUGH)
            with torch.no_grad():
                self.noise_model.scale_to(self._signal(pixels), self.pixels.observation[pixels])
        noise = [p for p in self.noise_model.parameters() if p.requires_grad and train_noise]
        self.noise_optimiser = adam([{"params": noise, "lr": learning_rate}]) if noise else None
        self.signal_optimiser = None
        if any(p.requires_grad for p in self.signal_model.parameters()):
            everything = [{"params": list(self.signal_model.parameters()), "lr": learning_rate}]
            own = getattr(self.signal_model, "parameter_groups", lambda: everything)
            groups = own() if parameter_groups is None else parameter_groups
            self.signal_optimiser = adam({"lr": learning_rate} | group for group in groups)
        self.optimisers = [o for o in (self.signal_optimiser, self.noise_optimiser) if o is not None]
        self.base_rates = [[group["lr"] for group in o.param_groups] for o in self.optimisers]

    def run(self, schedule: LoopSettings, progress: Progress | None, checkpoint: Checkpoint | None) -> FitResult:
        """Take all remaining steps, and restore the best held-out state."""
        started = saved = time.perf_counter()
        joint = self.signal_optimiser is not None
        num_steps = schedule.num_steps if self.optimisers else 0  # else there is nothing to learn
        self.tabulates = joint and schedule.tabulate
        self._tabulate()
        check_every = max(_OF_SIGNALS if joint else _LEAST_BETWEEN_LOOKS, num_steps // 20)
        self.good = self._models()
        self.kind = "last" if joint and schedule.keep_last else "joint" if joint else "noise"
        if self.done == 0:
            self._judge(0)  # a good initial state must not be lost
        try:
            for step in range(self.done + 1, num_steps + 1):
                past = (step - 1) / num_steps
                rate = (1 - past) * _DECAY**past if joint else _LAST_RATE**past
                if joint and step < schedule.warm_up * num_steps:
                    rate *= step / (schedule.warm_up * num_steps)
                for optimiser, own in zip(self.optimisers, self.base_rates, strict=True):
                    for group, base in zip(optimiser.param_groups, own, strict=True):
                        group["lr"] = base * rate / 2**self.result.recoveries
                if not self._take_step(step, schedule):
                    self._recover(self.good)
                self.done = step
                look = step % check_every == 0 or step == num_steps
                if look:
                    self.good = self._judge(step) or self.good
                    self._check_table(rarely=step < num_steps)
                interval = schedule.checkpoint_interval
                due = look if interval is None else time.perf_counter() - saved >= interval
                if checkpoint is not None and due:
                    checkpoint(self.state())
                    saved = time.perf_counter()
                history = self.result.history
                late = not joint and step >= 0.4 * num_steps and len(history) > 1
                if late and history.get(0, math.inf) <= min(history.values()):  # the initial state is still the best
                    break
                if progress is not None:
                    progress("fit", step, num_steps, f"held-out NLL {self.result.held_out_nll:.4f}")
        except KeyboardInterrupt:
            if checkpoint is not None:
                checkpoint(self.state())
            raise
        if self.best.state is not None:
            self._load_models(self.best.state)
            scores, count = self._look(JUDGED_LAST)
            self.result.held_out_nll = -float(scores.sum()) / count
        self.result.num_steps, self.result.seconds = self.done, time.perf_counter() - started
        return self.result

    def _take_step(self, step: int, schedule: LoopSettings) -> bool:
        """Take one step of all trainable models. Return False if loss or gradient was not finite."""
        joint = self.signal_optimiser is not None
        finite = self._signal_step(schedule.batch_size)
        if self.noise_optimiser is not None and (not joint or step % schedule.noise_interval == 0):
            with few_threads(schedule.batch_size):
                for _ in range(schedule.noise_steps if joint else 1):
                    finite &= take_step(
                        self.noise_optimiser, lambda: self._loss(self.pixels.batch(schedule.batch_size))
                    )
            if self.table is not None:
                self.table.rebuild(self.noise_model)
        return finite

    def _tabulate(self) -> None:
        large = self.pixels.train.numel() >= _TABLE_COUNT and not needs_image(self.noise_model)
        self.table = self.tables.get(self._make_table) if self.tabulates and large else None

    def _judge(self, step: int) -> dict[str, Any] | None:
        """Evaluate the held-out pixels. Return the state to recover to, or None if it is not finite."""
        if self.widens and self.noise_optimiser is not None:
            self.widening = self._measured_widening()
        scores, count = self._look()
        nll = -float(scores.sum()) / count
        if not math.isfinite(nll):
            return None
        models = self._models()
        if self.best.judge(models, scores, start=step == 0, kind=self.kind):
            self.result.held_out_nll = nll
        self.result.history[step] = nll
        return models

    def _look(self, most: int | None = None) -> tuple[Tensor, int]:
        """Log-likelihoods of some held-out pixels, from the table if it is accurate and the noise model is frozen."""
        if most is None:
            most = _LOOK_COUNT if self.noise_optimiser is not None else _FROZEN_LOOK_COUNT
        if self.table is None or self.noise_optimiser is not None or self.table.error > 2 * TOLERANCE:
            return self.held_out_log_prob(most)
        pixels = thinned(self.pixels.judge, most)
        with torch.no_grad():
            return self.table.log_prob(values_of(self._signal(pixels)), pixels).double(), pixels.numel()

    def _check_table(self, *, rarely: bool) -> None:
        """Update the table: signals may leave it, and a trained noise model slowly changes (checked every fifth time)."""
        table = self.table
        if table is None:
            return
        table.cover(self.noise_model, self._some_signals())
        if self.noise_optimiser is not None and (not rarely or len(self.result.history) % 5 == 0):
            table.check(self.noise_model)
        self.result.table_error = table.error

    def _make_table(self, resume: dict[str, Any] | None) -> ObservationTable:
        signal = self._some_signals()
        observed = self.pixels.observation[self.pixels.train]
        low = float(torch.minimum(signal.min(), observed.min()))
        high = float(torch.maximum(signal.max(), observed.max()))
        return ObservationTable(self.noise_model, self.pixels.observation, low, high, resume=resume)

    @torch.no_grad()
    def _some_signals(self) -> Tensor:
        return values_of(self._signal(thinned(self.pixels.train, JUDGED_LAST)))

    def _signal_step(self, batch_size: int) -> bool:
        def loss() -> Tensor:
            whole = hasattr(self.signal_model, "signal") and self.pixels.train.ndim == 1
            value = self._full_batch_loss() if whole else self._loss(self.pixels.batch(batch_size), learn_signal=True)
            return value + self.signal_model.penalty() if hasattr(self.signal_model, "penalty") else value  # type: ignore[operator]

        return self.signal_optimiser is None or take_step(self.signal_optimiser, loss)

    def _full_batch_loss(self) -> Tensor:
        signal: Tensor = self.signal_model.signal()  # type: ignore[operator]
        observation, weight = self.pixels.observation, self.pixels.weight
        if self.table is not None:  # a step needs only the gradient, which the tangent shares
            return -torch.dot(self.table.slope(signal).mul_(weight), signal)
        shape = self.pixels.shape if needs_image(self.noise_model) else observation.shape
        log_prob = self.noise_model(signal.reshape(shape)).log_prob(observation.reshape(shape)).reshape(-1)
        return -torch.dot(log_prob, weight.to(log_prob.dtype))

    def _loss(self, pixels: Tensor, *, learn_signal: bool = False) -> Tensor:
        """Mean negative log-likelihood of training pixels (P,) or of lines of them (P, L), nats per pixel."""
        log_prob = self.log_prob(pixels, learn_signal=learn_signal, widening=1.0 if learn_signal else self.widening)
        return -log_prob.mean() if pixels.ndim == 1 else -log_prob.sum() / self._count(pixels)

    def log_prob(self, pixels: Tensor, *, learn_signal: bool = False, widening: float = 1.0) -> Tensor:
        """Log-likelihood of each pixel, or of each line, (P,), with residuals so many times as wide."""
        observation = self.pixels.observation[pixels]
        with torch.set_grad_enabled(learn_signal):
            signal = self._signal(pixels)
            if widening != 1:
                wide = observation + widening * (values_of(signal) - observation)
                signal = wide if isinstance(signal, Tensor) else replace(signal, values=wide)
        distribution = self.noise_model(signal)
        ask = distribution.log_prob if pixels.ndim == 1 else distribution.line_log_prob
        found: Tensor = ask(observation)
        return found

    @torch.no_grad()
    def _measured_widening(self, *, quantile: float = 0.7) -> float:
        """How much wider residuals of held-out pixels are than those of training pixels, at least 1, by a quantile of their
        absolute values: outliers in a third of the pixels do not matter, nor do zeros in two thirds."""
        widths = []
        for pixels in (self.pixels.judge, self.pixels.train):
            some = thinned(pixels, _LOOK_COUNT)
            residual = self.pixels.observation[some] - values_of(self._signal(some))
            if not bool((finite := residual.isfinite()).any()):
                raise ValueError("the signal model predicts no finite signal; check its starting values")
            widths.append(float(residual[finite].abs().double().quantile(quantile)))
        return max(1.0, widths[0] / widths[1]) if widths[1] > 0 else 1.0

    def _count(self, pixels: Tensor) -> int:
        return int(torch.isfinite(self.pixels.observation[pixels]).sum())

    def _signal(self, pixels: Tensor) -> Signal:
        if needs_image(self.noise_model):
            return pick(self.signal_model, pixels, self.pixels.image, window_size(self.noise_model))
        predicted: Tensor = self.signal_model(pixels)
        return predicted

    @torch.no_grad()
    def held_out_log_prob(self, most: int) -> tuple[Tensor, int]:
        """Log-likelihoods of at most `most` held-out pixels, or of lines with as many pixels, and the number of pixels."""
        pixels = thinned(self.pixels.judge, most)
        parts = torch.split(pixels, max(1, 32768 // pixels[0].numel()))
        return torch.cat([self.log_prob(part).double() for part in parts]), self._count(pixels)

    def _models(self) -> dict[str, Any]:
        models = {"noise_model": snapshot(self.noise_model)}
        if self.signal_optimiser is not None:
            models["signal_model"] = snapshot(self.signal_model)
        return models

    def _load_models(self, state: dict[str, Any]) -> None:
        self.noise_model.load_state_dict(state["noise_model"])
        if "signal_model" in state:
            self.signal_model.load_state_dict(state["signal_model"])

    def _recover(self, good: dict[str, Any], *, most: int = 8) -> None:
        self.result.recoveries += 1
        if self.result.recoveries > most:
            raise ValueError("the likelihood stays NaN or infinite even at lower learning rates; check the data scale")
        self._load_models(good)
        for optimiser in self.optimisers:
            optimiser.state.clear()

    def state(self) -> dict[str, Any]:
        """Everything needed to resume from this point."""
        return {
            **self._models(),
            "best": self.best.saved(),
            "optimisers": copy.deepcopy([o.state_dict() for o in self.optimisers]),
            "generator": self.pixels.generator.get_state(),
            "history": dict(self.result.history),
            "held_out_nll": self.result.held_out_nll,
            "recoveries": self.result.recoveries,
            "done": self.done,
            "cold": self.widens,
            "widening": self.widening,
            "table": None if self.table is None else self.table.state(),
            "between_steps": getattr(self.signal_model, "between_steps", dict)(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state that `state` returned."""
        self._load_models(state)
        for optimiser, saved in zip(self.optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        self.pixels.generator.set_state(state["generator"])
        self.best.load(state["best"])
        self.done = state["done"]
        self.result.history, self.result.held_out_nll = dict(state["history"]), state["held_out_nll"]
        self.result.recoveries = state["recoveries"]
        self.tables.resume, self.widening = state["table"], state["widening"]
        getattr(self.signal_model, "go_on_from", dict)(state["between_steps"])
