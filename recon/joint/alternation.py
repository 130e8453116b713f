"""Signal and noise model fitted by turns, each with the other held still."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow import FitResult
from noiseflow.distributions.picked import needs_image
from noiseflow.fitting.observation_table import ObservationTable
from noiseflow.fitting.pixels import thinned
from recon.joint.candidates import learns, num_steps_of, rate_of, starts_anew
from recon.joint.half_resolution import HalfResolution
from recon.joint.signal_model import TomographySignal
from recon.projection.image_formation import Linear

Progress = Callable[[int, str], None]
# Learning rates of a second and of a late fit, relative to a rough start's: Adam's first steps are as large where little is left.
SECOND, WARM = 0.5, 0.25
# Of an offset at a rough start without vacuum: a slab that fills every image looks nearly the same with a little more of it.
_HASTE = 4.0
_WARM_UP = 0.1  # of the steps, but from a rough start
_SETTLING = (40, 80, 160, 320)  # steps
_ENOUGH = 2  # of these stages, unless there is little noise
_START = 10  # steps of noise that goes on to learn with the signal
_SETTLED = 0.03  # nats per pixel
_QUIET = 0.2  # noise relative to contrast
_SOME = 10_000  # pixels
_LATER_TURN, _NEXT_RATE = 0.4, 0.5  # share of the steps; learning rate relative to the turn before
_MOST_TURNS = 6
_TABULATED = 0.05  # nats per pixel


class Alternation:
    """A signal model with its observations, those of them to use, and a share `held_out` that judges it."""

    def __init__(
        self,
        signal_model: TomographySignal,
        observation: Tensor,
        use: Tensor | None,
        seed: int,
        run_fit: Callable[..., FitResult],
        *,
        held_out: float = 0.1,
        coarse_to_fine: bool = True,
    ) -> None:
        self.coarse_to_fine = coarse_to_fine
        self.signal_model, self.observation, self.use, self.run_fit = signal_model, observation, use, run_fit
        self.generator = torch.Generator().manual_seed(seed)
        self.calm = 1.0
        self.held_out = block_mask(observation.shape, share=held_out, generator=self.generator).to(observation.device)

    def fit(self, noise_model: nn.Module, *, known: bool = False, **options: Any) -> FitResult:
        """Fit volume and noise model; with `known`, the noise model alone on the signal as it is."""
        signal: Tensor | nn.Module = self.signal_model
        if known:
            with torch.no_grad():
                signal = self.signal_model.signal().view_as(self.observation)
        options = {"batch_size": 4096, "learning_rate": rate_of(noise_model)} | options
        options |= {"mask": self.use, "held_out": self.held_out, "generator": self.generator, "digitise": False}
        try:
            return self.run_fit(noise_model, signal, self.observation, **options)
        finally:
            self.signal_model.release()

    def fit_signal(self, noise_model: nn.Module, *, rate: float, **options: Any) -> FitResult:
        """Fit volume and noise model at so many times the usual learning rate of the volume, and calmer where there is little
        noise; from a rough start, an offset learns faster where no vacuum shows it, for it has a long way to go."""
        usual, of_response = self.signal_model.learning_rate, self.signal_model.response_rate
        self.signal_model.learning_rate = usual * rate * self.calm
        hidden = self.signal_model.occupancy is None and isinstance(self.signal_model.image_formation, Linear)
        if rate >= 1 and hidden:
            self.signal_model.response_rate = _HASTE * of_response
        try:
            return self.fit(noise_model, standardise=False, warm_up=_WARM_UP if rate < 1 else 0.0, **options)
        finally:
            self.signal_model.learning_rate, self.signal_model.response_rate = usual, of_response

    def begin_and_alternate(
        self, first: nn.Module, noise_model: nn.Module, *, num_steps: int, quiet: bool, progress: Progress | None
    ) -> FitResult:
        """A quarter of the steps with simple noise, which pulls at a rough signal steadily; the rest with the model of choice.

        Args:
            first: the simple noise, learnt.
            noise_model: the model of choice, learnt; fitted further in place.
            num_steps: of the signal, unless it takes more turns.
            quiet: whether there is little noise; the simple one then settles the signal first.
            progress: called with what is done, as a number of `num_steps`, and a note.
        """
        if progress is not None:
            more = sum(_SETTLING) - num_steps // 4 if quiet else 0
            progress = partial(_in_all, progress, num_steps, num_steps + more)
        if quiet:
            begun = num_steps // 4
            self.settle(first, final=first is noise_model, thoroughly=True, progress=progress)
        else:
            begun = self.begin(first, noise_model, num_steps=num_steps, progress=progress)
        rate, told = (WARM, sum(_SETTLING)) if quiet else (SECOND, begun)
        return self.alternate(noise_model, num_steps=num_steps - begun, rate=rate, begun=told, progress=progress)

    def begin(
        self, first: nn.Module, noise_model: nn.Module, *, num_steps: int, progress: Progress | None = None
    ) -> int:
        """The first quarter of so many steps, with simple noise as it is; and where half the resolution will do for that, another
        quarter there, with the model of choice as it is. Returns the steps taken.
        """
        begun = num_steps // 4
        if not begun:
            return 0
        with self._half_resolution(noise_model) as task, frozen(first), frozen(noise_model):
            task.fit_signal(first, num_steps=begun, rate=1.0, progress=progress)
            if task is self:
                return begun
            later = None if progress is None else partial(_continue, progress, begun)
            task.fit_signal(noise_model, num_steps=begun, rate=SECOND, progress=later)
        return 2 * begun

    @contextmanager
    def _half_resolution(self, noise_model: nn.Module, *, wanted: bool = True) -> Iterator[Alternation]:
        """The same task at half the resolution, if that is wanted and can be; else the task as it is."""
        wanted = wanted and self.coarse_to_fine and not needs_image(noise_model)
        half, task = HalfResolution.of(self.signal_model) if wanted else None, copy.copy(self)
        if half is None:
            yield self
            return
        task.signal_model, task.observation = half.signal_model, half.pixels(self.observation)
        task.held_out = half.pixels(self.held_out)
        task.use = None if self.use is None else half.pixels(self.use)
        yield task
        half.hand_over()

    def settle(
        self,
        first: nn.Module,
        *,
        final: bool,
        thoroughly: bool = False,
        known: nn.Module | None = None,
        progress: Progress | None = None,
    ) -> bool:
        """A fit with simple noise, longer and longer until held-out pixels gain little in its second half: what an unfinished
        signal misses would pass for noise, and be left as it is. Steps get smaller, as large ones may stop gaining long before
        the end. Unless the simple noise is `final`, the offset of a linear response stays where there is little noise: to least
        squares a haze over a lower offset looks as good as vacuum, and takes up what the volume cannot explain in bright places.

        Args:
            first: the simple noise; fitted in place.
            final: whether it is the model of choice, too; else the steps that follow are calmer the less noise there is.
            thoroughly: go all the way.
            known: the noise of choice, if it is known: unless it looks at whole images, the first stage is then enough.
            progress: called with the steps done and a note.

        Returns:
            Whether there is little noise: what is left is small beside the contrast of the signal.
        """
        response, self.calm = self.signal_model.image_formation, 1.0
        held = response if isinstance(response, Linear) and not final else nn.Identity()
        known = None if known is None or needs_image(known) else known
        self.refine(first, standardise=True, num_steps=_START)
        for stage, num_steps in enumerate(_SETTLING):
            holding = frozen(held if thoroughly or stage >= _ENOUGH else nn.Identity())
            later = None if progress is None else partial(_continue, progress, sum(_SETTLING[:stage]))
            with self._half_resolution(first, wanted=stage == 0) as task, holding:
                result = task.fit_signal(first, num_steps=num_steps, rate=_NEXT_RATE**stage, progress=later)
            if known is not None:
                break
            history = list(result.history.values())
            if not thoroughly and stage + 1 >= _ENOUGH and history[len(history) // 2] - min(history) < _SETTLED:
                break
        with torch.no_grad():
            signal = self.signal_model.signal().view_as(self.observation)
            if known is None:
                residual = signal - self.observation
                variance = residual.square() if self.use is None else residual[self.use].square()
            else:
                variance = getattr(known, "model", known)(thinned(signal.flatten(), _SOME)).variance
            noise = float(variance.mean().sqrt() / signal.std())
            self.calm = 1.0 if final else min(1.0, noise / _QUIET)
            return noise < _QUIET

    def alternate(
        self,
        noise_model: nn.Module,
        *,
        num_steps: int,
        rate: float,
        begun: int = 0,
        standardise: bool = False,
        progress: Progress | None = None,
    ) -> FitResult:
        """Fit the signal to the noise model as it is, and the noise model to the signal as it is, by turns: twice, and on until
        held-out pixels gain little. Where there is little noise, a change of the noise model moves the signal for long.

        Each turn ends at a small learning rate, and the next starts at a smaller one: the incident intensity would overshoot
        again, and comes back slowly. Learning both at once from a rough start lets the mean of a heavy-tailed noise
        wander with the few outliers of each batch, and drags the signal along.

        Args:
            noise_model: fitted in place.
            num_steps: of the signal in the first two turns; the second takes less than half as many as the first.
            rate: of the first turn, relative to the usual learning rate.
            begun: steps taken before.
            standardise: fit the noise model from scratch first.
            progress: called with the steps done and a note.
        """
        if standardise:
            self.refine(noise_model, standardise=True)
        done, reached = begun, math.inf
        first = math.ceil(num_steps / (1 + _LATER_TURN))
        for turn in range(_MOST_TURNS):
            steps = first if turn == 0 else max(1, num_steps - first)
            later = None if progress is None else partial(_continue, progress, done)
            with frozen(noise_model):
                result = self.fit_signal(noise_model, num_steps=steps, rate=rate * _NEXT_RATE**turn, progress=later)
            done += result.num_steps
            if turn > 0 and reached - result.held_out_nll < _SETTLED:
                break
            reached = result.held_out_nll
            self.refine(noise_model)
        return result

    @torch.no_grad()
    def can_tabulate(self, noise_model: nn.Module) -> bool:
        """Whether a table holds the likelihood of the observations; see `noiseflow.fitting.observation_table`."""
        observation = self.observation.flatten() if self.use is None else self.observation[self.use]
        ends = [float(end) for end in torch.aminmax(self.signal_model.signal())]
        return ObservationTable(noise_model, observation, *ends).error < _TABULATED

    def refine(self, noise_model: nn.Module, *, standardise: bool = False, num_steps: int = 60) -> None:
        """Fit a noise model, if it learns, to the signal as it is."""
        if learns(noise_model):
            standardise = standardise or starts_anew(noise_model)
            options: dict[str, Any] = {"num_steps": num_steps_of(noise_model, num_steps), "standardise": standardise}
            self.fit(noise_model, known=True, **options)


def _continue(progress: Progress, done: int, step: int, note: str) -> None:
    progress(done + step, note)


def _in_all(progress: Progress, total: int, expected: int, step: int, note: str) -> None:
    progress(min(total, round(step * total / expected)), note)


@contextmanager
def frozen(model: nn.Module) -> Iterator[None]:
    learning = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)


def block_mask(shape: tuple[int, ...], *, share: float = 0.1, block: int = 4, generator: torch.Generator) -> Tensor:
    """Pixels (tilt, u, y) to hold out: whole blocks in every image, so that neighbours do not give them away."""
    tilts, *sides = shape
    coarse = torch.rand((tilts, *(-(-side // block) for side in sides)), generator=generator) < share
    return coarse.repeat_interleave(block, 1).repeat_interleave(block, 2)[:, : sides[0], : sides[1]]
