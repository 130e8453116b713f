"""Fits of candidate noise models for model selection: direct fits once, others briefly, fully, and further if unconverged."""

import copy
import itertools
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from noiseflow.fitting.cells import count
from noiseflow.fitting.fit import fit
from noiseflow.fitting.pixel_split import JudgedPixels
from noiseflow.metrics.evaluation import probability_integral_transform
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.digitised import Digitised
from noiseflow.progress import Progress
from noiseflow.statistics import own_random

_SCREENING_SHARE = 0.2  # of a model's steps
_HOPELESS = 0.02  # nats per pixel; about ten times the typical gain of the long fit over the short one
_WORTH_GOING_ON = 0.1  # of the gap to the best, gained in a round; at less, ten more rounds would be needed
# Steps of a direct fit, after which those far behind stop: later steps gained up to 0.02 nats. If others stop, choices suffer.
_BRIEF = 40
NEGLIGIBLE = 2e-4
"""Difference in nats per pixel that is never held against a simpler model: table interpolation and convergence errors are
this large."""
_SETTLED = 5e-4  # nats per pixel gained in the second half of a fit, where rates are small and a tenth of the path lies


class Contest:
    """Candidate models with log-likelihoods of the validation pixels (`scores`) and learning rates (`rates`)."""

    def __init__(
        self,
        models: Mapping[str, NoiseModelBase],
        pixels: JudgedPixels,
        seed: int,
        num_steps: int | None,
        progress: Progress | None,
        *,
        skip_needless: bool,
        enough: Callable[[NoiseModelBase], bool] | None = None,
        always: int = 1,
    ) -> None:
        self.models, self.pixels, self.seed, self._given = models, pixels, seed, num_steps
        self.steps = {name: model.num_steps if num_steps is None else num_steps for name, model in models.items()}
        self._short = {name: max(1, round(_SCREENING_SHARE * most)) for name, most in self.steps.items()}
        self.scores: dict[str, Tensor] = {}
        self.starts: dict[str, dict[str, Any]] = {}
        self.rates = {name: model.learning_rate for name, model in models.items()}
        self.seconds = dict.fromkeys(models, 0.0)
        self.screened_out: set[str] = set()
        self._gained = dict.fromkeys(models, 0.0)  # in the last fit, nats per pixel
        self._went_on: set[str] = set()
        self._searched: set[str] = set()  # fully, when they entered
        self._shape: tuple[Tensor, bool] | None = None  # scores of the best model, and whether it misses the shape
        self._progress, self._done, self._skips = progress, 0, skip_needless
        self._enough, self._always = enough, always
        self._asked: dict[str, bool] = {}  # whether a model is enough

    def screen(self) -> None:
        """Fit every model briefly; screen out models far behind the best that do not catch up."""
        # searches for a detector that others leave far behind are not begun
        for name, model in sorted(self.models.items(), key=lambda each: self._enough is None and _is_detector(each[1])):
            early = not model.costly or (self._enough is not None and _is_detector(model))
            if early and not self._suffices(name):
                self._enter(name)
        # detectors first, then costly models: flexible ones that cannot lead them need no full fit
        order = sorted(self.models.items(), key=lambda each: not each[1].starts_most_likely + each[1].costly)
        for name, model in order:
            needless = name in self.scores or self._suffices(name) or (self._skips and self._is_needless(name))
            if model.costly and not needless:
                self._enter(name)
            if name in self.scores:
                self._complete(name)
        for name, model in self.models.items():
            if name in self.scores and self._is_hopeless(name) and not _is_quick(model):
                self._go_on(name, self.pixels.training(model), self._short[name])
        self.screened_out |= {name for name in self.scores if self._is_hopeless(name)}
        self.screened_out.discard(self._leading())  # a model that led before may have lost in a longer fit

    def _enter(self, name: str, *, lost: float = 0.1) -> None:
        """Fit a model briefly, or only start its search for a detector, and score it. Searches gained up to 0.09 nats per pixel:
        those that start further behind the best are `lost`."""
        started, model = time.perf_counter(), self.models[name]
        pixels = self.pixels.training(model)
        if not _is_quick(model):
            self._fit(name, pixels, 0, standardise=True)
            self.starts[name] = copy.deepcopy(model.state_dict())
            if model.learns:
                self._fit(name, pixels, self._short[name])
        elif model.settles:
            searches = _is_detector(model)
            self._searched |= {name} if searches and count(**pixels) is not None else set()
            if searches and name not in self._searched:  # three parameters lose 0.0004 nats per pixel, four 0.0006
                pixels = self.pixels.training(model, most=4096)
            model.scale_to(**pixels, settle=False)
            started = self._score(name, started)
            if self._gap(name) > lost:
                self.screened_out.add(name)
            if not searches or name in self.screened_out:
                return
            _settle(model, **pixels)
        else:
            self._fit(name, pixels, min(_BRIEF, self.steps[name]), standardise=True)
        self._score(name, started)

    def _complete(self, name: str) -> None:
        """Fit a quick model fully and score it, unless it is so far behind that it cannot catch up."""
        started, model = time.perf_counter(), self.models[name]
        if not _is_quick(model) or name in self._asked:
            return
        far = self._is_hopeless(name, 5e-3 if _is_detector(model) else _HOPELESS)
        if far and (not model.costly or _is_detector(model)):
            self.screened_out.add(name)
        if name in self.screened_out | self._searched:
            return
        pixels, left = self.pixels.training(model), self.steps[name] - _BRIEF
        if model.settles:
            _settle(model, **pixels)
            if not model.starts_most_likely:
                self._fit(name, pixels, min(2 * _BRIEF, self.steps[name]))
            started = self._score(name, started)
        if not model.starts_most_likely and left > 0 and not self._is_hopeless(name):
            self._fit(name, pixels, None if self._given is None else left)
            self._score(name, started)

    def _misses_the_shape(self, *, bins: int = 16) -> bool:
        """Whether the best model loses more than 0.001 nats per pixel in the shape of the noise, and not by chance (2.8 standard
        errors): half of chi-squared of its probabilities of lower values, by signal, in bins of which the uppermost is halved
        again and again, because detectors' pulses differ in the upper tail."""
        name = self._leading()
        if self._shape is not None and self._shape[0] is self.scores[name]:
            return self._shape[1]
        model, pixels = self.models[name], self.pixels.training(self.models[name])
        kept = pixels.pop("mask", torch.ones_like(pixels["signal"], dtype=torch.bool)).cpu().numpy()
        rank = probability_integral_transform(model, **pixels, random=own_random(self.seed))[kept]
        parts = np.array_split(rank[pixels["signal"].cpu().numpy()[kept].argsort()], bins)
        # the narrowest expect four pixels
        tails = 0.5 ** np.arange(1, max(1, math.log2(len(parts[0]) / bins) - 1)) / bins
        edges = np.sort(np.append(np.linspace(0, 1, bins + 1), 1 - tails))
        counts = np.stack([np.histogram(part, edges)[0] for part in parts])
        expected = np.outer([len(part) for part in parts], np.diff(edges))
        excess = np.sum((counts - expected) ** 2 / expected) - counts.size
        self._shape = self.scores[name], bool(excess / 2 > 2 * max(_SETTLED * rank.size, math.sqrt(counts.size)))
        return self._shape[1]

    def _suffices(self, name: str) -> bool:
        """Whether a model needs no fit, because the best one before it is, when fitted fully, enough for the caller."""
        order = list(self.models)
        if self._enough is None or order.index(name) < self._always:
            return False
        if (best := self._leading()) not in self._asked:
            self._complete(best)
            self._asked[best] = self._enough(self.models[best])
        return self._asked[best] and order.index(best) < order.index(name)

    def _leading(self) -> str:
        return max(self.scores, key=lambda name: float(self.scores[name].mean()))

    def _is_needless(self, name: str) -> bool:
        """Whether a simpler model that is not costly is already as good as the best, or a simpler one that is leads and has the
        shape of the noise."""
        simpler = list(itertools.takewhile(lambda each: each != name, self.models))
        if (best := self._leading()) in simpler and self.models[best].costly and not self._misses_the_shape():
            return True
        cheap = [each for each in simpler if each in self.scores and not self.models[each].costly]
        differences = (mean_and_error(self.best() - self.scores[each], self.pixels.judging_blocks) for each in cheap)
        return any(excess <= max(min(error, _SETTLED), NEGLIGIBLE) for excess, error in differences)

    def finish(self) -> None:
        """Fit the remaining models fully, and continue for those that still improve."""
        for name, model in self.models.items():
            if name in self.screened_out or name not in self.scores or _is_quick(model) or not model.learns:
                continue
            started, pixels = time.perf_counter(), self.pixels.training(model)
            late = self._fit_anew(name, pixels)
            self._score(name, started)
            if late > max(_SETTLED, _WORTH_GOING_ON * self._gap(name)):
                self._go_on(name, pixels, self.steps[name])

    def learn_all(self, name: str, pixels: JudgedPixels) -> None:
        """Fit a model to all pixels except a few for a second validation, if its parameters are so many that these pixels can
        matter; keep the old model if it was better on the few."""
        model, judge = self.models[name], pixels.judge_again
        few, many = (int((each.use & ~out).sum()) for each, out in ((self.pixels, self.pixels.judge), (pixels, judge)))
        # each parameter costs half a nat of one pixel (Akaike 1974, doi:10.1109/TAC.1974.1100705)
        known = sum(each.numel() for each in model.parameters() if each.requires_grad)
        known += sum(each.levels.numel() for each in _converters(model))
        # stopped by 50 pixels of 500, the last fit was a quarter worse in 19 cases; by 500, better in four of five
        if int(judge.sum()) < 300 or known / 2 * (1 / few - 1 / many) < _WORTH_GOING_ON * NEGLIGIBLE:
            return
        before, kept = pixels.score(model, judge), copy.deepcopy(model)
        self._fit_anew(name, pixels.everything(model))
        loss, error = mean_and_error(before - pixels.score(model, judge))
        if not loss <= error:
            model.load_state_dict(kept.state_dict())
            for converter, old in zip(_converters(model), _converters(kept), strict=True):
                converter.levels, converter.edges = old.levels, old.edges

    def best(self) -> Tensor:
        """Log-likelihoods of the validation pixels under the best model."""
        return self.scores[self._leading()]

    def _gap(self, name: str) -> float:
        return float((self.best() - self.scores[name]).nan_to_num(nan=0.0, posinf=math.inf).mean())

    def _is_hopeless(self, name: str, least: float = _HOPELESS) -> bool:
        excess, error = mean_and_error(self.best() - self.scores[name], self.pixels.judging_blocks)
        return not excess <= max(least, 3 * error)

    def _go_on(
        self, name: str, pixels: dict[str, Any], num_steps: int, *, rounds: int = 8, faster: float = 1.5
    ) -> None:
        """Continue the fit in rounds, doubling the rate, while a round closes a tenth of the gap or gains accelerate: at twice
        the rate, a model far from convergence gains twice as much. Eight rounds end at 256 times its own rate."""
        model = self.models[name]
        for _ in range(rounds):
            started, before, rate = time.perf_counter(), self.scores[name], self.rates[name]
            least = _WORTH_GOING_ON * max(self._gap(name), _SETTLED)
            least, kept = min(least, faster * self._gained[name]), copy.deepcopy(model.state_dict())
            self.rates[name] = 2 * rate
            self._fit(name, pixels, num_steps)
            self._score(name, started)
            gained = float(self.scores[name].mean() - before.mean())
            if not gained > 0:  # the rate is too high, or there is nothing to gain
                model.load_state_dict(kept)
                self.scores[name], self.rates[name] = before, rate
                return
            self._went_on.add(name)
            if gained < least:
                return

    def _fit_anew(self, name: str, pixels: dict[str, Any]) -> float:
        """Fit a model fully from the standardised start, or from its current state if it was far from convergence. Return the
        gain of the second half of the fit, nats per pixel."""
        model = self.models[name]
        if model.settles and model.starts_most_likely:  # its detector is found, and moves little
            _settle(model, *(pixels[each][~pixels["held_out"]] for each in ("signal", "observation")))
            return 0.0
        # a direct fit goes on: 120 steps anew ended up to 0.0012 nats per pixel higher; others do not continue the short fit, as
        # first steps of a new optimiser would move away from the learnt weights
        if name in self.starts and name not in self._went_on:
            model.load_state_dict(self.starts[name])
        return self._fit(name, pixels, self._given if _is_quick(model) else self.steps[name])

    def _fit(self, name: str, pixels: dict[str, Any], num_steps: int | None, *, standardise: bool = False) -> float:
        options: dict[str, Any] = {"generator": torch.Generator().manual_seed(self.seed), "digitise": False}
        # a model that starts at its maximum likelihood is there after `standardise`
        steps = None if self.models[name].starts_most_likely and standardise else num_steps
        options |= {"num_steps": steps, "learning_rate": self.rates[name], "standardise": standardise}
        history = fit(self.models[name], **pixels, **options).history or {0: 0.0}
        middle, end = (min(history) + max(history)) / 2, min(history.values())
        halfway = min(nll for step, nll in history.items() if step <= middle)
        self._gained[name] = next(iter(history.values())) - end
        return halfway - end

    def _score(self, name: str, started: float) -> float:
        # a model without a likelihood for some pixels counts as one under which they are impossible
        self.scores[name] = torch.nan_to_num(self.pixels.score(self.models[name]), nan=-math.inf, neginf=-math.inf)
        now, self._done = time.perf_counter(), self._done + 1
        self.seconds[name] += now - started
        if self._progress is not None:
            self._progress("comparing noise models", self._done, max(self._done, len(self.models)), name)
        return now


def _converters(noise_model: NoiseModelBase) -> list[Digitised]:
    return [part for part in noise_model.modules() if isinstance(part, Digitised)]


def _settle(noise_model: NoiseModelBase, signal: Tensor, observation: Tensor) -> None:
    noise_model.settle(signal, observation)
    noise_model.fitted_range = float(signal.min()), float(signal.max())


def _is_detector(noise_model: NoiseModelBase) -> bool:
    """Whether a search for few parameters is the whole fit."""
    return noise_model.settles and (noise_model.starts_most_likely or not noise_model.costly)


def _is_quick(noise_model: NoiseModelBase) -> bool:
    """Whether a full fit takes about a second."""
    return (noise_model.fits_directly or noise_model.starts_most_likely) and not noise_model.needs_image


def mean_and_error(difference: Tensor, blocks: Tensor | None = None) -> tuple[float, float]:
    """Mean of (N,) differences and its standard error, from the scatter of whole blocks if blocks are given."""
    # −inf − −inf: pixels that are impossible under both models do not distinguish them
    difference = torch.nan_to_num(difference, nan=0.0, posinf=math.inf)
    mean = float(difference.mean())
    if not math.isfinite(mean):
        return mean, math.inf
    if blocks is None:
        return mean, float(difference.std(correction=0)) / math.sqrt(difference.numel())
    _, number = torch.unique(blocks, return_inverse=True)
    departure = difference.new_zeros(int(number.max()) + 1).index_add_(0, number, difference - mean)
    return mean, float(departure.square().sum().sqrt()) / difference.numel()
