"""Which noise model suffices: several are fitted to the same pixels, and held-out likelihood chooses the simplest that does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arrays import as_tensor, unmasked
from noiseflow.described import described
from noiseflow.fitting.contest import Contest, Progress, mean_and_error
from noiseflow.fitting.judged_pixels import JudgedPixels
from noiseflow.models import baselines, flow, mixture, physical, physics_flow
from noiseflow.models.around import ForeignModel, as_noise_model
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.digitisation import Digitisation, detect_digitisation
from noiseflow.models.digitised import Digitised

NEGLIGIBLE = 2e-4
"""nats per pixel that never speak against a simpler model: the interpolation of tables and the end of a fit differ by as much."""
MOST_FOR_SIMPLICITY = 5e-4
"""nats per pixel above which a simpler model is never taken, however uncertain: a million pixels would lose 500 nats."""
LEAST_PIXEL_COST = 8.0
"""nats over all judging pixels that may be lost to simplicity where these are few: what chance gives a model (χ²/2) whose
parameters, of which the judging pixels tell about sixteen apart, describe nothing."""


class _Scored(Protocol):
    """A candidate with its held-out figures."""

    @property
    def excess(self) -> float: ...
    @property
    def excess_error(self) -> float: ...


_Item = TypeVar("_Item", bound=_Scored)


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
        screened_out: whether the short first fit showed that it cannot be chosen, so that it was not fitted further.
        learning_rate: starting rate of its last fit: its own, or more where it had not converged.
    """

    name: str
    model: nn.Module
    nll: float
    excess: float
    excess_error: float
    seconds: float
    screened_out: bool = False
    learning_rate: float = 0.0


@described()
@dataclass(frozen=True)
class Selection:
    """All candidates, simplest first, and the chosen one.

    Attributes:
        candidates: as given, simplest first.
        chosen: the `simplest_sufficient` one. Its `nll` and `excess` are those of the comparison; its model has since learnt
            from the judging pixels too, unless it was not to be fitted again.
        digitisation: rounding and clipping detected, and put around every candidate.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    digitisation: Digitisation


def default_candidates() -> dict[str, nn.Module]:
    """The noise models that compete, simplest (fewest parameters) first."""
    return {
        "Gaussian": baselines.Gaussian(),
        "PoissonGaussian": physical.PoissonGaussian(),
        "SignalDependentGaussian": flow.SignalDependentGaussian(),
        "Mixture": mixture.Mixture(),
        "RadialFlow": flow.RadialFlow(),
        "Mixture8": mixture.Mixture(8),
        "SplineFlow": flow.SplineFlow(),
        "PhysicsFlow": physics_flow.PhysicsFlow(),
    }


def simplest_sufficient(candidates: Sequence[_Item], num_judging: int, *, negligible: float = NEGLIGIBLE) -> _Item:
    """The simplest model whose held-out likelihood lies within one standard error of the best: the one rule of the library.

    One standard error counts as at least `negligible` and at most `MOST_FOR_SIMPLICITY` nats per pixel, or `LEAST_PIXEL_COST`
    nats over all judging pixels where that is more.

    Args:
        candidates: simplest first, with their excess over the best and its standard error, nats per pixel.
        num_judging: number of judging pixels.
        negligible: nats per pixel that never speak against a simpler model; more where the signal is an estimate, whose
            errors a richer model may describe.

    Raises:
        ValueError: every candidate calls some judging pixel impossible.
    """
    most = max(MOST_FOR_SIMPLICITY, LEAST_PIXEL_COST / num_judging)
    for item in candidates:
        if item.excess <= max(min(item.excess_error, most), negligible):
            return item
    raise ValueError(
        "every candidate calls some of the judging pixels impossible; add a candidate such as SplineFlow()"
    )


def select(
    signal: Tensor | NDArray[Any],
    observation: Tensor | NDArray[Any],
    *,
    candidates: Mapping[str, nn.Module] | None = None,
    mask: Tensor | NDArray[np.bool_] | None = None,
    held_out: float | Tensor | NDArray[np.bool_] = 0.2,
    blocks: Tensor | NDArray[np.integer[Any]] | None = None,
    num_steps: int | None = None,
    digitise: bool = True,
    refit: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> Selection:
    """Fit several noise models to the same pixels and choose the simplest that suffices: see `simplest_sufficient`.

    Rounding and clipping are detected and put around every candidate. All candidates get a short fit to some of the pixels;
    those whose held-out likelihood is then hopelessly behind (0.02 nats, and three standard errors) get no long one. Rates and
    steps are the models' own (``learning_rate``, ``num_steps``); a model that is behind and still gaining on the best goes on
    from where it is, at twice the rate, for as long as that closes a tenth of the gap. The chosen one is fitted again to all
    pixels but a tenth, which says when to stop.

    Args:
        signal, observation: tensors or arrays of equal shapes, detector units; images (..., y, x) where a candidate looks beyond
            single pixels.
        candidates: models by name, simplest first; they are fitted in place. `default_candidates` by default.
        mask: pixels to use, shaped like `observation`; all by default.
        held_out: fraction of the pixels kept apart to judge, or those, boolean, shaped like `observation`.
        blocks: number of the block that each pixel belongs to, shaped like `observation`: pixels of one block may err alike.
            Whole blocks are kept apart, and standard errors come from their scatter.
        num_steps: optimisation steps of each, in place of the models' own; a tenth of them for one that starts at its most
            likely parameters.
        digitise: look for rounding and clipping; without, candidates are fitted as they are.
        refit: fit the chosen one again to the judging pixels too.
        seed: of all random choices.
        progress: called with the fits done and the name of the candidate.

    Raises:
        ValueError: as `fit`; no candidates; or all of them call some pixel impossible.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(10.0, 100.0, 5000)
        >>> observation = signal + 3 * torch.randn(5000, generator=torch.Generator().manual_seed(0))
        >>> candidates = {"Gaussian": noiseflow.Gaussian(), "SignalDependentGaussian": noiseflow.SignalDependentGaussian()}
        >>> noiseflow.select(signal, observation, candidates=candidates, num_steps=60).chosen.name
        'Gaussian'
    """
    models = dict(default_candidates() if candidates is None else candidates)
    if not models:
        raise ValueError("there are no candidates; give noise models by name, simplest first")
    wrapped = {name: as_noise_model(model) for name, model in models.items()}
    (signal, observation), kept = unmasked(signal, observation)
    mask = kept if mask is None else mask if kept is None else as_tensor(mask).reshape(-1).bool().cpu() & kept
    pixels = JudgedPixels.of(
        as_tensor(signal), as_tensor(observation), list(wrapped.values()), mask, held_out, blocks, seed
    )
    found = Digitisation()
    if digitise:
        found = detect_digitisation(as_tensor(observation).detach().reshape(-1)[pixels.use].cpu().numpy())
    if found.found:
        wrapped = {
            name: model.behind(lambda inner: Digitised(inner, *found)) if _needs_converter(model) else model
            for name, model in wrapped.items()
        }
    contest = Contest(wrapped, pixels, seed, num_steps, progress)
    contest.screen()
    contest.finish()
    judged = _judged(contest)
    chosen = simplest_sufficient([item for item in judged if not item.screened_out], pixels.num_judging)
    if refit:
        contest.learn_all(chosen.name)
    return Selection(judged, chosen, found)


def _needs_converter(model: NoiseModelBase) -> bool:
    """Whether rounding and clipping are put around a candidate: the grid of a `Poisson` model is its own, not the converter's."""
    return isinstance(model, baselines.Poisson) or not model.describes_single_readings


def _judged(contest: Contest) -> tuple[Candidate, ...]:
    """All candidates with their held-out figures."""
    best, found = contest.best(), []
    for name, score in contest.scores.items():
        model = contest.models[name]
        excess, error = mean_and_error(best - score, contest.pixels.judging_blocks)
        out = name in contest.screened_out
        shown = model.module if isinstance(model, ForeignModel) else model
        nll, seconds = -float(score.mean()), contest.seconds[name]
        found.append(Candidate(name, shown, nll, excess, error, seconds, out, contest.rates[name]))
    return tuple(found)
