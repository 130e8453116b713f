"""Which noise model suffices: several are fitted to the same pixels, and held-out likelihood chooses the simplest that does."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arrays import as_tensor
from noiseflow.described import described
from noiseflow.fitting.fit import fit
from noiseflow.metrics.evaluation import pixel_log_prob
from noiseflow.models import baselines, flow, mixture, physical, physics_flow
from noiseflow.models.digitisation import Digitisation, detect_digitisation
from noiseflow.models.digitised import Digitised

_SCREENING_PIXELS = 32768
_SCREENING_SHARE = 0.2
_HOPELESS = 0.02
_SHARE_FROM_MAXIMUM = 0.1
_NEGLIGIBLE, _MOST_FOR_SIMPLICITY, _LEAST_PIXEL_COST = 2e-4, 5e-4, 8.0


@described(nll="nats per pixel", excess="nats per pixel", excess_error="nats per pixel", seconds="s")
@dataclass(frozen=True)
class Candidate:
    """A fitted noise model and its held-out likelihood.

    Attributes:
        name: of the candidate.
        model: the fitted model.
        nll: mean negative log-likelihood of the held-out pixels, nats per pixel.
        excess: `nll` above the best candidate's.
        excess_error: standard error of `excess`, from the same pixels under both models.
        seconds: time to fit.
        screened_out: whether the short first fit told that it cannot be chosen, so that it was not fitted further.
    """

    name: str
    model: nn.Module
    nll: float
    excess: float
    excess_error: float
    seconds: float
    screened_out: bool = False


@described()
@dataclass(frozen=True)
class Selection:
    """All candidates, simplest first, and the chosen one.

    Attributes:
        candidates: as given, simplest first.
        chosen: the simplest whose held-out likelihood lies within one standard error of the best, and within 5e-4 nats (8 nats
            over the number of judging pixels, where those are few); 2e-4 nats always pass. Its `nll` and `excess` are those of
            the contest; its model has since learnt from the judging pixels too.
        digitisation: rounding and rails detected, and put around every candidate.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    digitisation: Digitisation


def default_candidates() -> dict[str, nn.Module]:
    """The noise models that compete, simplest first."""
    return {
        "Gaussian": baselines.Gaussian(),
        "PoissonGaussian": physical.PoissonGaussian(),
        "SignalDependentGaussian": flow.SignalDependentGaussian(),
        "Mixture": mixture.Mixture(),
        "RadialFlow": flow.RadialFlow(),
        "SplineFlow": flow.SplineFlow(),
        "PhysicsFlow": physics_flow.PhysicsFlow(),
    }


def select(
    signal: Tensor | NDArray[Any],
    observation: Tensor | NDArray[Any],
    *,
    candidates: Mapping[str, nn.Module] | None = None,
    held_out: float = 0.2,
    num_steps: int = 500,
    seed: int = 0,
) -> Selection:
    """Fit several noise models to the same pixels and choose the simplest that suffices.

    Rounding and clipping are detected and put around every candidate. All candidates get a short fit to some of the pixels;
    those whose held-out likelihood is then hopelessly behind (0.02 nats, and three standard errors) get no long one. The chosen
    one is fitted again to all pixels but a tenth, which tells when to stop.

    Args:
        signal, observation: tensors or arrays of equal shapes, detector units.
        candidates: models by name, simplest first; they are fitted in place. `default_candidates` by default.
        held_out: fraction of the pixels kept apart to judge.
        num_steps: optimisation steps of each; a tenth of them for one that starts at its most likely parameters.
        seed: of all random choices.

    Raises:
        ValueError: as `fit`.
    """
    signal, observation = as_tensor(signal), as_tensor(observation)
    digitisation = detect_digitisation(observation.detach().cpu().numpy())
    signal, observation = signal.reshape(-1).float(), observation.reshape(-1).float()
    # NumPy's stream, not torch's: noise that was sampled with the same seed must not decide which pixels judge
    draw = torch.from_numpy(np.random.default_rng(seed).random(signal.shape[0]))
    apart, last_apart = draw < held_out, draw < min(held_out, 0.1)
    models = dict(default_candidates() if candidates is None else candidates)
    if digitisation.found:
        models = {name: Digitised(model, *digitisation) for name, model in models.items()}
    contest = _Contest(models, signal[~apart], observation[~apart], signal[apart], observation[apart], seed)
    contest.screen(max(1, round(_SCREENING_SHARE * num_steps)))
    contest.finish(num_steps)
    candidates_judged, chosen = contest.judge()
    contest.learn_all(chosen.name, signal, observation, last_apart, num_steps)
    return Selection(candidates_judged, chosen, digitisation)


class _Contest:
    """Models on their way to be chosen from; `scores` are their log-likelihoods of the judging pixels."""

    def __init__(
        self,
        models: Mapping[str, nn.Module],
        signal: Tensor,
        observation: Tensor,
        judging_signal: Tensor,
        judging_observation: Tensor,
        seed: int,
    ) -> None:
        self.models, self.seed = models, seed
        self.signal, self.observation = signal, observation
        self.judging = judging_signal, judging_observation
        self.scores: dict[str, Tensor] = {}
        self.starts: dict[str, dict[str, Any]] = {}
        self.seconds = dict.fromkeys(models, 0.0)
        self.screened_out: set[str] = set()

    def screen(self, num_steps: int) -> None:
        """A short fit of every model to some of the pixels; those far behind the best are screened out."""
        part = slice(None, None, max(1, self.signal.numel() // _SCREENING_PIXELS))
        for name, model in self.models.items():
            started = time.perf_counter()
            self._fit(name, self.signal[part], self.observation[part], 0, standardise=True)
            self.starts[name] = copy.deepcopy(model.state_dict())
            if not self._starts_most_likely(name):
                self._fit(name, self.signal[part], self.observation[part], num_steps)
            self._score(name, started)
        best = self._best()
        for name, score in self.scores.items():
            excess, error = _mean_and_error(best - score)
            if not excess <= max(_HOPELESS, 3 * error):
                self.screened_out.add(name)

    def finish(self, num_steps: int) -> None:
        """The long fit of those that are left."""
        for name in self.models:
            if name not in self.screened_out:
                started = time.perf_counter()
                self._fit_anew(name, self.signal, self.observation, num_steps)
                self._score(name, started)

    def learn_all(self, name: str, signal: Tensor, observation: Tensor, judging: Tensor, num_steps: int) -> None:
        """Fit the model of that name to all pixels but the `judging` (N,) ones; where these like it less, it stays as it was."""
        model, pixels = self.models[name], (signal[judging], observation[judging])
        before, kept = pixel_log_prob(model, *pixels), copy.deepcopy(model.state_dict())
        self._fit_anew(name, signal, observation, num_steps, held_out=judging)
        loss, error = _mean_and_error(before - pixel_log_prob(model, *pixels))
        if not loss <= error:
            model.load_state_dict(kept)

    def _fit_anew(self, name: str, signal: Tensor, observation: Tensor, num_steps: int, **options: Any) -> None:
        """A fit from the standardised start; a few steps more where that is nearly the end."""
        if self._starts_most_likely(name):
            num_steps = max(1, round(_SHARE_FROM_MAXIMUM * num_steps))
        else:  # not on from the short fit: fresh steps of the optimiser leave what weights have learnt
            self.models[name].load_state_dict(self.starts[name])
        self._fit(name, signal, observation, num_steps, **options)

    def _fit(
        self,
        name: str,
        signal: Tensor,
        observation: Tensor,
        num_steps: int,
        *,
        standardise: bool = False,
        **options: Any,
    ) -> None:
        generator = torch.Generator().manual_seed(self.seed)
        options |= {"num_steps": num_steps, "digitise": False, "standardise": standardise, "generator": generator}
        fit(self.models[name], signal, observation, **options)

    def _score(self, name: str, started: float) -> None:
        self.scores[name] = pixel_log_prob(self.models[name], *self.judging)
        self.seconds[name] += time.perf_counter() - started

    def _starts_most_likely(self, name: str) -> bool:
        return getattr(getattr(self.models[name], "model", self.models[name]), "starts_most_likely", False)

    def _best(self) -> Tensor:
        return max(self.scores.values(), key=lambda score: float(score.mean()))

    def judge(self) -> tuple[tuple[Candidate, ...], Candidate]:
        """All candidates and the chosen one."""
        best, found = self._best(), []
        for name, score in self.scores.items():
            excess, error = _mean_and_error(best - score)
            out = name in self.screened_out
            found.append(
                Candidate(name, self.models[name], -float(score.mean()), excess, error, self.seconds[name], out)
            )
        able = [item for item in found if math.isfinite(item.excess) and not item.screened_out]
        most = max(_MOST_FOR_SIMPLICITY, _LEAST_PIXEL_COST / best.numel())
        return tuple(found), next(
            item for item in able if item.excess <= max(min(item.excess_error, most), _NEGLIGIBLE)
        )


def _mean_and_error(difference: Tensor) -> tuple[float, float]:
    # −inf − −inf: pixels that both models call impossible do not tell them apart
    difference = torch.nan_to_num(difference, nan=0.0, posinf=math.inf)
    mean = float(difference.mean())
    return mean, float(difference.std(correction=0)) / math.sqrt(difference.numel()) if math.isfinite(
        mean
    ) else math.inf
