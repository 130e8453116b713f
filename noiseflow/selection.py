"""Which noise model suffices: several are fitted to the same pixels, and held-out likelihood chooses the simplest that does."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from noiseflow import baselines, flow
from noiseflow.digitisation import Digitisation, detect_digitisation
from noiseflow.digitised import Digitised
from noiseflow.fit import fit
from noiseflow.metrics import pixel_log_prob


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
    """

    name: str
    model: nn.Module
    nll: float
    excess: float
    excess_error: float
    seconds: float


@dataclass(frozen=True)
class Selection:
    """All candidates, simplest first, and the chosen one.

    Attributes:
        candidates: as given, simplest first.
        chosen: the simplest whose held-out likelihood lies within one standard error of the best.
        digitisation: rounding and rails detected, and put around every candidate.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    digitisation: Digitisation


def default_candidates() -> dict[str, nn.Module]:
    """The noise models that compete, simplest first."""
    return {
        "Gaussian": baselines.Gaussian(),
        "SignalDependentGaussian": flow.SignalDependentGaussian(),
        "RadialFlow": flow.RadialFlow(),
        "SplineFlow": flow.SplineFlow(),
    }


def select(
    signal: Tensor,
    observation: Tensor,
    *,
    candidates: Mapping[str, nn.Module] | None = None,
    held_out: float = 0.2,
    num_steps: int = 500,
    seed: int = 0,
) -> Selection:
    """Fit several noise models to the same pixels and choose the simplest that suffices.

    Rounding and clipping are detected and put around every candidate.

    Args:
        signal, observation: equal shapes, detector units.
        candidates: models by name, simplest first; they are fitted in place. `default_candidates` by default.
        held_out: fraction of the pixels kept apart to judge.
        num_steps: optimisation steps of each.
        seed: of all random choices.

    Raises:
        ValueError: as `fit`.
    """
    digitisation = detect_digitisation(observation.detach().cpu().numpy())
    signal, observation = signal.reshape(-1).float(), observation.reshape(-1).float()
    # NumPy's stream, not torch's: noise that was sampled with the same seed must not decide which pixels judge
    apart = torch.from_numpy(np.random.default_rng(seed).random(signal.shape[0]) < held_out)
    models = dict(default_candidates() if candidates is None else candidates)
    if digitisation.found:
        models = {name: Digitised(model, *digitisation) for name, model in models.items()}
    scores, seconds = [], []
    for model in models.values():
        generator = torch.Generator().manual_seed(seed)
        result = fit(
            model, signal[~apart], observation[~apart], num_steps=num_steps, digitise=False, generator=generator
        )
        seconds.append(result.seconds)
        scores.append(-pixel_log_prob(model, signal[apart], observation[apart]))
    return Selection(*_choose(list(models.items()), scores, seconds), digitisation)


def _choose(
    models: Sequence[tuple[str, nn.Module]], scores: Sequence[Tensor], seconds: Sequence[float]
) -> tuple[tuple[Candidate, ...], Candidate]:
    best = min(scores, key=lambda score: float(score.mean()))
    found = []
    for (name, model), score, time in zip(models, scores, seconds, strict=True):
        # −inf − −inf: pixels that both models call impossible do not tell them apart
        difference = torch.nan_to_num(score - best, nan=0.0, posinf=math.inf)
        excess = float(difference.mean())
        error = float(difference.std(correction=0)) / math.sqrt(score.numel()) if math.isfinite(excess) else math.inf
        found.append(Candidate(name, model, float(score.mean()), excess, error, time))
    chosen = next(item for item in found if math.isfinite(item.excess) and item.excess <= item.excess_error)
    return tuple(found), chosen
