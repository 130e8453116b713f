"""Model selection: fit several noise models to the same pixels and choose the simplest sufficient one."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arguments import as_mask, check, real
from noiseflow.arrays import unmasked
from noiseflow.described import described
from noiseflow.distributions.pixels import needs_image
from noiseflow.fitting.contest import NEGLIGIBLE, Contest, mean_and_error
from noiseflow.fitting.fit import fit
from noiseflow.fitting.pixel_split import JudgedPixels
from noiseflow.fitting.stream import bounded
from noiseflow.models import baselines, excess_noise, flow, mixture, physical, physics_flow
from noiseflow.models.at_level import at_level, without_level
from noiseflow.models.conditioned import flat_conditions, grid_of
from noiseflow.models.digitisation import Digitisation, detect_digitisation
from noiseflow.models.digitised import Digitised
from noiseflow.models.edged import Edged, ends_sharply
from noiseflow.models.stuck_pixels import stuck_at, with_stuck_pixels
from noiseflow.models.wrapped import Wrapped, wrapping
from noiseflow.models.wrapper import ForeignModel, as_noise_model
from noiseflow.progress import Progress
from noiseflow.statistics import ENOUGH

MOST_FOR_SIMPLICITY = 3e-4
"""Loss in nats per pixel above which a simpler model is never chosen, whatever its standard error: a million pixels would lose
300 nats."""
LEAST_PIXEL_COST = 2.0
"""Total loss in nats over all validation pixels that is accepted for a simpler model if these are few. After 500 pixels, 28 fits
of noises of no candidate lose 0.008 nats per pixel to the best, with 3 0.011; 12 of simple noises 0.004, with 1 or less 0.007."""

_Item = TypeVar("_Item", bound=Any)


@described(**dict.fromkeys(("nll", "nll_error", "excess", "excess_error"), "nats per pixel"), seconds="s")
@dataclass(frozen=True)
class Candidate:
    """A fitted noise model and its held-out likelihood.

    Attributes:
        model: the fitted model.
        nll, nll_error: mean negative log-likelihood of the held-out pixels, and its standard error from the scatter of blocks,
            nats per pixel.
        excess, excess_error: `nll` minus that of the best candidate, and its standard error, from the same pixels under both.
        seconds: fitting time.
        screened_out: whether the model was excluded after the short first fit.
        learning_rate: initial learning rate of its last fit; larger than its default if it had not converged.
    """

    name: str
    model: nn.Module
    nll: float
    nll_error: float
    excess: float
    excess_error: float
    seconds: float
    screened_out: bool
    learning_rate: float


@described()
@dataclass(frozen=True)
class Selection:
    """All candidates, simplest first, and the chosen one.

    Attributes:
        candidates: the candidates that were fitted, in the given order, simplest first.
        chosen: the `simplest_sufficient` candidate. Its `nll` and `excess` are those of the comparison; its model was then
            fitted to the validation pixels too, unless `refit` was False.
        digitisation: detected rounding and clipping, included in every candidate.

    Where single precision does not resolve the noise, models are fitted above a constant level and put into `AtLevel`.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    digitisation: Digitisation


def default_candidates() -> dict[str, nn.Module]:
    """The default candidates for model selection, simplest (fewest parameters) first."""
    return {
        "Gaussian": baselines.Gaussian(),
        "PoissonGaussian": physical.PoissonGaussian(),
        "SignalDependentGaussian": flow.SignalDependentGaussian(),
        "ExcessNoise": excess_noise.ExcessNoise(),
        "GaussianWithOutliers": mixture.GaussianWithOutliers(),
        "SharedMixture8": mixture.Mixture(8, shared_shape=True),
        "RadialFlow": flow.RadialFlow(),
        "Mixture4": mixture.Mixture(4),
        "PhysicsFlow": physics_flow.PhysicsFlow(),
        "Mixture8": mixture.Mixture(8),
    }


def simplest_sufficient(candidates: Sequence[_Item], num_judging: int) -> _Item:
    """The simplest model whose held-out likelihood is within one standard error of the best.

    The standard error is limited to the range from `NEGLIGIBLE` to `MOST_FOR_SIMPLICITY` nats per pixel, or to `LEAST_PIXEL_COST`
    nats over all validation pixels if that is more.

    Args:
        candidates: candidates, simplest first, with their excess over the best and its standard error, nats per pixel.
        num_judging: number of validation pixels.

    Raises:
        ValueError: some validation pixels are impossible under every candidate.
    """
    most = max(MOST_FOR_SIMPLICITY, LEAST_PIXEL_COST / num_judging)
    for item in candidates:
        if item.excess <= max(min(item.excess_error, most), NEGLIGIBLE):
            return item
    raise ValueError("some validation pixels are impossible under every candidate: mask them, or add wider tails")


def select(
    signal: Tensor | NDArray[Any],
    observation: Tensor | NDArray[Any],
    *,
    condition: Mapping[str, Any] | None = None,
    candidates: Mapping[str, nn.Module] | None = None,
    mask: Tensor | NDArray[np.bool_] | None = None,
    held_out: float | Tensor | NDArray[np.bool_] = 0.2,
    blocks: Tensor | NDArray[np.integer[Any]] | None = None,
    num_steps: int | None = None,
    digitise: bool = True,
    refit: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
    enough: Callable[[nn.Module], bool] | None = None,
    always: int = 1,
) -> Selection:
    """Fit several noise models to the same pixels and choose the simplest sufficient one (see `simplest_sufficient`).

    If rounding or clipping is detected, every candidate is wrapped in `Digitised`; values at which pixels are stuck are detected
    too (`StuckPixels`). Of the default candidates, those that are no detectors are put into `Wrapped` if values start again at
    the end of a period; or `Edged` is one more of them if the noise ends at edges. Models with a direct fit are fitted for 40
    steps, and then fully unless far behind (0.02 nats and three standard errors); detectors are searched for unless 0.1 nats
    behind, on few pixels first. Of the default candidates, `costly` ones are tried only if no simpler model suffices. Others are
    first fitted briefly, and screened out if far behind; the rest are fitted fully, and further, at twice the rate, as long as
    each round closes a tenth of the gap. A million pixels, drawn at random, suffice to compare, and ten million to fit. The
    chosen model is then fitted again to all but a tenth of these, used for early stopping, if its parameters are so many that
    more pixels can matter.

    Args:
        signal, observation: tensors or arrays of equal shape, detector units; images (..., y, x) if a candidate depends on
            neighbouring pixels.
        condition: what the noise depends on beyond the signal, as for `fit`. Models are compared at up to three places of the
            grid of conditions, together; the chosen one is then a `Conditioned` model of all.
        candidates: models by name, simplest first; without a condition, they are fitted in place. `default_candidates` by
            default.
        mask: pixels to use, shaped like `observation`; all by default.
        held_out: fraction of the pixels to hold out for validation, or a boolean mask shaped like `observation`.
        blocks: block number of each pixel, shaped like `observation`, if errors within a block are correlated. Whole blocks are
            held out, and standard errors are computed from the scatter of blocks.
        num_steps: optimisation steps of each model, instead of its own number; a tenth for models that start at their
            maximum-likelihood parameters.
        digitise: detect rounding and clipping; if False, candidates are not wrapped.
        refit: fit the chosen model again with the validation pixels included.
        progress: called with a task, the completed and expected fits, and the name of the candidate.
        enough: called with the best model so far: whether candidates after it need no fit. By default all are fitted.
        always: number of candidates that are fitted even so.

    Raises:
        ValueError: as `fit`; there are no candidates; or some pixels are impossible under all of them.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(10.0, 100.0, 5000)
        >>> observation = signal + 3 * torch.randn(5000, generator=torch.Generator().manual_seed(0))
        >>> candidates = {"Gaussian": noiseflow.Gaussian(), "SignalDependentGaussian": noiseflow.SignalDependentGaussian()}
        >>> noiseflow.select(signal, observation, candidates=candidates, num_steps=60).chosen.name
        'Gaussian'
    """
    check(held_out=held_out, num_steps=num_steps, seed=seed)
    models = default_candidates() if candidates is None else candidates
    if not models or not isinstance(models, Mapping):
        raise ValueError(
            f'candidates is {models!r}; give noise models by name, simplest first, such as {{"Gaussian": …}}'
        )
    everything = nn.ModuleList(map(as_noise_model, models.values()))
    if condition is None:
        signal, observation, mask, held_out, blocks = bounded(everything, signal, observation, mask, held_out, blocks)
    elif needs_image(everything):
        raise ValueError("conditions need models of single pixels; leave candidates that depend on neighbours out")
    (signal, observation), kept = unmasked(signal, observation)
    signal, observation = real(signal, "signal"), real(observation, "observation")
    wrapped = {name: as_noise_model(model).to(observation.device) for name, model in models.items()}
    use = as_mask(mask, observation)
    use = use if kept is None else use & kept.to(use.device)
    whole = JudgedPixels.of(signal, observation, list(wrapped.values()), use, held_out, blocks, seed)
    if whole.level:
        wrapped = {name: without_level(model) for name, model in wrapped.items()}
    found, pixels = Digitisation(), whole.at_most(ENOUGH, list(wrapped.values()), seed + 1)
    known, seen = (each.reshape(-1)[pixels.use] for each in (pixels.signal, pixels.observation))
    if digitise:
        seen_by_all = whole.observation if whole.level else observation
        found = detect_digitisation(seen_by_all, whole.signal, use=whole.use.reshape(observation.shape))
    stuck = stuck_at(known, seen, found) if digitise else []
    free = ~torch.isin(seen, seen.new_tensor([level for level, _ in stuck]))
    ends = wrapping(known[free], seen[free], found.step) if candidates is None else None
    if ends is not None:
        wrapped = {name: Wrapped(model, *ends) for name, model in wrapped.items() if not model.settles}
    elif candidates is None and not found.found and ends_sharply(known[free], seen[free]):
        wrapped["Edged"] = Edged(default_candidates()["SharedMixture8"]).to(observation.device)
    if found.found:
        for name, model in wrapped.items():
            # a Poisson model has its own grid of values, which need not be that of the converter
            if isinstance(model, baselines.Poisson) or not model.describes_single_readings:
                wrapped[name] = model.behind(lambda inner: Digitised(inner, *found))
    wrapped = with_stuck_pixels(wrapped, known, stuck, found)
    raised = partial(at_level, level=whole.level)
    decides = None if enough is None else lambda model: enough(raised(model))
    skips: dict[str, Any] = {"skip_needless": candidates is None, "enough": decides, "always": always}
    parts = [pixels] if condition is None else _at_places(pixels, flat_conditions(condition, observation))
    own = [wrapped if condition is None else copy.deepcopy(wrapped) for _ in parts]
    contests = [Contest(*each, seed, num_steps, progress, **skips) for each in zip(own, parts, strict=True)]
    for contest in contests:
        contest.screen()
        contest.finish()
    judged = _judged(contests)
    num_judging = sum(int(part.judge.sum()) for part in parts)
    chosen = simplest_sufficient([item for item in judged if not item.screened_out], num_judging)
    if condition is not None:
        used = whole.use if refit else whole.use & ~whole.judge
        options: dict[str, Any] = {"digitise": False, "generator": torch.Generator().manual_seed(seed)}
        options |= {"condition": condition, "mask": used.reshape(observation.shape), "num_steps": num_steps}
        conditioned = fit(wrapped[chosen.name], whole.signal, whole.observation, **options).noise_model
        judged = tuple(replace(item, model=conditioned) if item is chosen else item for item in judged)
    elif refit:
        contests[0].learn_all(chosen.name, whole)
    if whole.level:
        judged = tuple(replace(item, model=raised(as_noise_model(item.model))) for item in judged)
    chosen = next(item for item in judged if item.name == chosen.name)
    return Selection(judged, chosen, found.raised(whole.level))


def _at_places(pixels: JudgedPixels, condition: Mapping[str, Tensor], *, most: int = 3) -> list[JudgedPixels]:
    """The pixels at up to so many places, evenly spaced in the grid of (N,) conditions: the ends and the middle."""
    number = torch.full_like(pixels.use, -1, dtype=torch.long)
    number[pixels.use] = grid_of({name: each[pixels.use] for name, each in condition.items()})[2]
    places = np.unique(np.linspace(0, int(number.max()), most).round()).tolist()
    masks = ("use", "judge", "judge_again")
    return [replace(pixels, **{name: getattr(pixels, name) & (number == place) for name in masks}) for place in places]


def _judged(contests: Sequence[Contest]) -> tuple[Candidate, ...]:
    """The candidates of contests for separate pixels; where one was not tried, a simpler one is as good as the best."""
    names = [name for name in contests[0].models if any(name in each.scores for each in contests)]
    total, figures = sum(each.best().numel() for each in contests), dict[str, list[float]]()
    for name in names:
        mean, square = np.zeros(2), np.zeros(2)
        for each in contests:
            best, share, blocks = each.best(), each.best().numel() / total, each.pixels.judging_blocks
            score = each.scores.get(name, best)
            found = np.array([mean_and_error(-score, blocks), mean_and_error(best - score, blocks)])
            mean, square = mean + share * found[:, 0], square + (share * found[:, 1]) ** 2
        figures[name] = [mean[0], math.sqrt(square[0]), mean[1], math.sqrt(square[1])]
    least, judged = min(each[2] for each in figures.values()), []
    for name, (nll, nll_error, excess, error) in figures.items():
        tried = [each for each in contests if name in each.scores]
        model, rate = tried[0].models[name], tried[0].rates[name]
        shown = model.module if isinstance(model, ForeignModel) else model
        out = all(name in each.screened_out for each in tried)
        seconds = sum(each.seconds[name] for each in tried)
        judged.append(Candidate(name, shown, nll, nll_error, excess - least, error, seconds, out, rate))
    return tuple(judged)
