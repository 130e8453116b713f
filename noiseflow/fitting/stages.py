"""A joint fit from a cold start: the signal under simple noise, which is then exchanged for the noise at that signal.

Fitted together from a rough signal, they do not converge: the noise model describes the errors of the signal as outliers, and
pixels that could correct them lose their weight.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from noiseflow.fitting.loop import FitLoop, LoopSettings
from noiseflow.fitting.observation_table import TableKeeper
from noiseflow.fitting.pixel_split import JUDGED_LAST, FitPixels, thinned
from noiseflow.fitting.signal_models import KnownSignal, predicted
from noiseflow.fitting.steps import BestState
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.baselines import Gaussian

_DEGREES = 4.0  # of freedom; with 2.5 or 8, three scenes with outliers end −2.0 to +0.6 dB off, with ∞ −1.1 to −8.7 dB


@torch.no_grad()
def forgets_errors(loop: FitLoop, *, nearer: float = 0.75, few: float = 0.02) -> bool:
    """Whether errors of the signal as it begins cost little more than half of them would, as outliers should.

    Under Gaussian noise, the nearer half of an error costs a quarter. It costs more than three in 0.4 % of the pixels of a rough
    signal under counts with read noise (simple noise first: −1 to −6 dB), in 6 to 99 % with outliers (up to +20 dB, once −2).
    """
    costs = [-loop.log_prob(thinned(loop.pixels.train, JUDGED_LAST), widening=share) for share in (0.0, 0.5, 1.0)]
    return float(((costs[1] - costs[0]) / (costs[2] - costs[0]) > nearer).float().mean()) > few


class Student(Gaussian):
    """Student's t with the same width at all signals: no outlier pulls without limit."""

    def forward(self, signal: Tensor) -> Any:
        return torch.distributions.StudentT(_DEGREES, signal, self.log_scale.exp(), validate_args=False)

    @torch.no_grad()
    def standardise(self, signal: Tensor, observation: Tensor) -> None:
        super().standardise(signal, observation)
        self.log_scale.add_(0.5 * math.log(1 - 2 / _DEGREES))


class StagedLoop(FitLoop):
    """A joint fit under simple noise until the first turn, then under the noise model, which every turn fits to the signal.

    Args:
        learn: `noiseflow.fit` of these pixels by `noise_model`.
        noise_model, pixels: the model to learn and its pixels.
        num_steps: signal steps.
        simple: arguments of `FitLoop` for the simple noise.
    """

    def __init__(
        self, learn: Callable[..., Any], noise_model: NoiseModelBase, pixels: FitPixels, num_steps: int, *simple: Any
    ) -> None:
        super().__init__(*simple)
        self.learn, self.learnt, self.learnt_pixels = learn, noise_model, pixels
        seeds = torch.randint(2**62, (2,), generator=pixels.generator).tolist()
        # half of the steps are under simple noise, because outliers found in an unconverged signal are errors of the signal
        self.turns = {num_steps * (2**turn - 1) // 2**turn: seed for turn, seed in enumerate(seeds, 1)}

    def prepare(self, learning_rate: float, **options: Any) -> None:
        super().prepare(learning_rate, **options | {"train_noise": True})
        self.base_rates[-1] = [self.noise_model.joint_learning_rate]  # its width begins at that of the whole scene

    def _take_step(self, step: int, schedule: LoopSettings) -> bool:
        if step - 1 in self.turns:
            self._learn_noise(self.turns[step - 1])
        return super()._take_step(step, schedule)

    def _learn_noise(self, seed: int, *, num_steps: int = 100) -> None:
        # steps of noise models without a direct fit are cheap: they see a batch of pixels, not the whole signal
        signal, fitted = predicted(self.signal_model, self.pixels.observation).clone(), self.pixels.train.flatten()
        observation = self.pixels.observation[fitted]
        signal[fitted] = observation + self._measured_widening() * (signal[fitted] - observation)
        self.learn(
            signal=KnownSignal(signal),
            num_steps=None if self.learnt.fits_directly else num_steps,
            learning_rate=self.learnt.joint_learning_rate,
            generator=torch.Generator().manual_seed(seed),
        )
        self._use_learnt()
        self._tabulate()
        self.good = self._models()
        self._judge(self.done)

    def _use_learnt(self) -> None:
        if self.noise_model is not self.learnt:
            self.best = BestState()
        self.noise_model, self.pixels, self.tables = self.learnt, self.learnt_pixels, TableKeeper()
        self.noise_optimiser, self.optimisers, self.base_rates = None, self.optimisers[:1], self.base_rates[:1]

    def load_state(self, state: dict[str, Any]) -> None:
        if state["done"] > min(self.turns):
            self._use_learnt()
        super().load_state(state)
