"""A joint fit from a cold start: the signal under simple noise, which is then exchanged for the noise at that signal.

Fitted together from a rough signal, they do not converge: the noise model describes the errors of the signal as outliers, and
pixels that could correct them lose their weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from noiseflow.fitting.loop import FitLoop, FitResult, LoopSettings
from noiseflow.fitting.observation_table import TableKeeper
from noiseflow.fitting.pixel_split import FitPixels
from noiseflow.fitting.signal_models import KnownSignal, predicted
from noiseflow.models.base import NoiseModelBase

# Shares of the steps after which the noise is learnt. Half of them are under simple noise, because outliers found in an
# unconverged signal are errors of the signal.
_TURNS = 1 / 2, 3 / 4
# Of noise models without a direct fit. Noise steps are cheap: they see a batch of pixels, not the whole signal.
_NOISE_STEPS = 100


class Logistic(NoiseModelBase):
    """Logistic noise with the same width at all signals: as log-concave as Gaussian noise, and no outlier pulls without limit."""

    def __init__(self) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.zeros(()))

    def forward(self, signal: Tensor) -> LogisticDistribution:
        return LogisticDistribution(signal, self.log_scale)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        """Set the standard deviation to the root-mean-square residual of (N,) signals and observations."""
        square = (observation.double() - signal.double()).square().mean()
        self.log_scale.copy_(torch.log(torch.sqrt(3 * square) / math.pi))


class LogisticDistribution(torch.distributions.Distribution):
    """The distribution that `Logistic` returns."""

    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = torch.distributions.constraints.real

    def __init__(self, signal: Tensor, log_scale: Tensor) -> None:
        super().__init__(signal.shape, validate_args=False)
        self.signal, self.log_scale = signal, log_scale

    def log_prob(self, value: Tensor) -> Tensor:
        z = ((value - self.signal) * torch.exp(-self.log_scale)).abs()
        return -z - 2 * nn.functional.softplus(-z) - self.log_scale

    @property
    def mean(self) -> Tensor:
        return self.signal

    @property
    def variance(self) -> Tensor:
        return (torch.exp(2 * self.log_scale) * math.pi**2 / 3).expand(self.batch_shape)


class StagedLoop(FitLoop):
    """A joint fit under simple noise until the first turn, then under the noise model, which every turn fits to the signal.

    Args:
        fit: `noiseflow.fit`.
        noise_model, signal_model, observation: as for `fit`.
        pixels: pixels of the noise model.
        result: filled in.
        num_steps: signal steps.
        shared: arguments of the fits of the noise model: ``mask``, ``held_out``, ``digitise``.
    """

    def __init__(
        self,
        fit: Callable[..., FitResult],
        noise_model: NoiseModelBase,
        signal_model: nn.Module,
        observation: Tensor,
        pixels: FitPixels,
        result: FitResult,
        num_steps: int,
        shared: dict[str, Any],
    ) -> None:
        seen = observation if observation.is_floating_point() else observation.to(torch.get_default_dtype())
        first = FitPixels.choose(seen, shared["mask"].reshape(-1), shared["held_out"], pixels.generator)
        super().__init__(Logistic().to(observation.device), signal_model, first, result)
        self.learnt, self.learnt_pixels, self.observation = noise_model, pixels, observation
        self.fit, self.shared = fit, shared
        seeds = torch.randint(2**62, (len(_TURNS),), generator=pixels.generator).tolist()
        self.turns = dict(zip((max(1, round(share * num_steps)) for share in _TURNS), seeds, strict=True))

    def _take_step(self, step: int, schedule: LoopSettings) -> bool:
        if step - 1 in self.turns:
            self._learn_noise(self.turns[step - 1])
        return super()._take_step(step, schedule)

    def _learn_noise(self, seed: int) -> None:
        model = self.learnt
        self.fit(
            model,
            KnownSignal(predicted(self.signal_model, self.observation)),
            self.observation,
            num_steps=None if model.fits_directly else _NOISE_STEPS,
            learning_rate=model.joint_learning_rate,
            generator=torch.Generator().manual_seed(seed),
            **self.shared,
        )
        self._use_learnt()
        self._tabulate()
        self.good = self._models()
        self._judge(self.done, "joint")

    def _use_learnt(self) -> None:
        if self.noise_model is not self.learnt:
            self.best.forget()
        self.noise_model, self.pixels, self.tables = self.learnt, self.learnt_pixels, TableKeeper()
        self.noise_optimiser, self.optimisers, self.base_rates = None, self.optimisers[:1], self.base_rates[:1]

    def load_state(self, state: dict[str, Any]) -> None:
        if state["done"] > min(self.turns):
            self._use_learnt()
        super().load_state(state)
