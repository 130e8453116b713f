"""Selection of a noise model: models are fitted to some blocks of pixels and evaluated on the others."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import noiseflow
from calibration.detector.levels import NUM_LEVELS
from calibration.exposures.frames import blurred_step, rails, rounding_step
from calibration.exposures.scaling import blocks_of
from calibration.registration.aligned import AlignedPair, block_split
from calibration.tolerances import CLEAR
from noiseflow.described import described
from noiseflow.fitting import selection
from noiseflow.fitting.selection import Candidate
from noiseflow.metrics.distances import Tails, tails_of_bins
from noiseflow.metrics.evaluation import Evaluation, evaluate, probability_integral_transform
from noiseflow.progress import Progress
from noiseflow.statistics import uniform_variance


class CandidateKind(NamedTuple):
    """A candidate: its class in noiseflow, its name in reports, and arguments of the class."""

    cls: str
    label: str
    options: dict[str, Any] = {}  # noqa: RUF012


KINDS = {
    "gaussian": CandidateKind("Gaussian", "Gaussian, one width"),
    "poisson": CandidateKind("Poisson", "Poisson"),
    "counting": CandidateKind("DeadTimeCounter", "counter with dead time"),
    "poisson-gaussian": CandidateKind("PoissonGaussian", "Poisson-Gaussian"),
    "excess-noise": CandidateKind("ExcessNoise", "Poisson-Gaussian with excess noise"),
    "signal-gaussian": CandidateKind("SignalDependentGaussian", "Gaussian, width by signal"),
    "mixture": CandidateKind("Mixture", "mixture of Gaussians", {"num_components": 8, "mean_preserving": True}),
    "flow": CandidateKind("RadialFlow", "radial flow", {"mean_preserving": True}),
    "spline": CandidateKind("SplineFlow", "spline flow", {"mean_preserving": True}),
    "physics-flow": CandidateKind("PhysicsFlow", "Poisson-Gaussian corrected by a flow"),
}
"""Candidate noise models, simplest first."""

KEPT = ("standardise", "settle")
"""Searches for a detector, which a measured one does without."""

SIMPLE = ("gaussian", "poisson", "poisson-gaussian")
"""Models that are always fitted, also beside one that is asked for; others, simplest first, until one is enough."""

NUM_STEPS = 200
"""Number of optimisation steps per flexible model."""

MOST_BLOCKS = 2048
"""Largest number of blocks, half of which are held out. 65 000 held-out pixels resolve 0.0006 nats between two models, a quarter
of `WORTH_FITTING`, with a finite-sample bias of 4e-5 in a divergence. More would take time without changing the selection."""

WORTH_FITTING = 2.5e-3
"""Attainable improvement, nats per pixel, above which more flexible models are fitted: half the tolerated loss of 0.005."""


@described(signal="counts", observation="counts", level="counts")
@dataclass(frozen=True)
class Pixels:
    """Pixels of all pairs, for fitting and evaluating noise models.

    Attributes:
        signal: (N,) counts.
        observation: (N,) counts; whole numbers where the detector rounds.
        held_out: (N,) whether a pixel is used for evaluation.
        block: (N,) number of the block of each pixel.
        level: (N,) signal of the neighbours, whose noise is independent of that of `signal`, counts.
    """

    signal: NDArray[np.float64]
    observation: NDArray[np.float64]
    held_out: NDArray[np.bool_]
    block: NDArray[np.int64]
    level: NDArray[np.float64]


@described(**dict.fromkeys(("nll", "nll_error", "excess", "excess_error"), "nats per pixel"), seconds="s")
@dataclass(frozen=True)
class ModelScore(Candidate):
    """A candidate, named by one of `KINDS`, and how it compares with the held-out pixels.

    Attributes:
        held_out: (N,) signals and observations of these pixels, counts.
        seed: of the samples that are drawn for the comparison.
    """

    held_out: tuple[Tensor, Tensor] = field(repr=False, compare=False)
    seed: int

    @property
    def label(self) -> str:
        """Name of the model in reports."""
        return KINDS[self.name].label

    @cached_property
    def evaluation(self) -> Evaluation:
        """Divergences between the histogram of the residuals and the model, with their finite-sample floors; PIT; tails."""
        return evaluate(self.model, *self.held_out, seed=self.seed)


def collect_pixels(pairs: Sequence[AlignedPair], *, seed: int = 0, fraction: float = 0.5) -> Pixels:
    """Collect the valid pixels of all pairs, and hold out whole blocks for the evaluation.

    The held-out `fraction` of the blocks has the same positions in every pair, so no part of the scene is in both sets.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> calibration.collect_pixels(calibration.align_burst(calibration.Burst(frames))[0]).observation.shape
        (24576,)
    """
    parts = []
    blurred = blurred_step(pairs[0].short)
    generator = np.random.default_rng([seed, 1])  # independent of the selection of held-out blocks
    for number, pair in enumerate(pairs):
        kept, blocks = pair.mask, blocks_of(pair.mask.shape)
        apart = block_split(blocks, np.random.default_rng(seed), fraction=fraction)
        count = int(blocks.max()) + 1
        if count * len(pairs) > MOST_BLOCKS:
            kept = kept & block_split(blocks, generator, fraction=MOST_BLOCKS / (count * len(pairs)))
        block = (number * count + blocks)[kept]
        parts.append(
            [pair.signal[kept], whole_observation(pair, kept, blurred=blurred), apart[kept], block, pair.level[kept]]
        )
    return Pixels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def whole_observation(pair: AlignedPair, chosen: NDArray[np.bool_], *, blurred: float = 0.0) -> NDArray[np.float64]:
    """Return the (N,) observations of chosen pixels of a pair, as integers if the exposure has integers.

    The correction for the noise of the signal moves observations off the converter's codes. They are rounded again, up or down
    by chance: to the nearest code, the same residuals would move together, and others would occur twice as often. The correction
    is increased to compensate the added variance, step²/6. Clipped pixel values keep their limit. If the noise is as small as
    the rounding step, pixel values stay as recorded.
    """
    step, signal, short = rounding_step(pair.short) or blurred, pair.signal[chosen], pair.short[chosen]
    total, share = pair.total_variance(signal), pair.share(signal)
    if blurred:  # no model knows the gain reference, and flexible ones would learn its codes
        short = step * np.round(short / step)
    if not step:
        return signal + np.sqrt(1 - share) * (short - signal)
    own = (1 - share) * total
    added = 2 * uniform_variance(step)
    kept = np.sqrt(np.maximum(own - added, 0.0) / np.maximum(total, added))
    chance = np.random.default_rng(0).random(own.shape)
    observation = short[0] + np.floor((signal - short[0] + kept * (short - signal)) / step + chance) * step
    low, high = rails(pair.short)
    recorded = (own < step**2) | (share < 1e-3) | (short <= low) | (short >= high)
    return np.where(recorded, short, observation.clip(low, high))


def fit_models(
    pixels: Pixels,
    *,
    kinds: Sequence[str] | str | None = None,
    detector: tuple[float, float, float] | None = None,
    seed: int = 0,
    device: Any = "cpu",
    progress: Progress | None = None,
    most: int = 32_768,
) -> list[ModelScore]:
    """Fit noise models and evaluate them on the held-out pixels.

    Args:
        pixels: from `collect_pixels`.
        kinds: names in `KINDS`, or one of them; by default the simplest ones, and others as long as the best can be improved by
            more than `WORTH_FITTING` nats per pixel.
        detector: measured gain, offset and read noise for the Poisson-Gaussian model; None to fit them.
        seed, device, progress: as `calibrate_exposures`.
        most: largest number of pixels to fit to, as many as the selector takes.

    Returns:
        One score per kind, simplest first, with the models on the CPU.

    Raises:
        ValueError: a kind is unknown, or a model cannot be fitted.

    Example:
        >>> import calibration, numpy as np
        >>> frames = np.random.default_rng(0).poisson(np.linspace(20, 400, 64), (6, 64, 64))
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> scores = calibration.fit_models(calibration.collect_pixels(pairs), kinds=["gaussian", "poisson-gaussian"])
        >>> [score.name for score in scores if score.excess < 0.02]
        ['poisson-gaussian']
    """
    torch.manual_seed(seed)
    candidates: dict[str, Any] = {}
    enough = partial(_enough, pixels=pixels) if kinds is None else None
    kinds = [name for name in KINDS if name != "counting" or _counting(pixels)] if kinds is None else kinds
    kinds = [kinds] if isinstance(kinds, str) else kinds
    for name in sorted(kinds, key=lambda name: (name not in SIMPLE, _rank(name))):
        model = getattr(noiseflow, KINDS[name].cls)(**KINDS[name].options)
        if detector is not None and name == "poisson-gaussian":
            model = noiseflow.PoissonGaussian(*detector).requires_grad_(False)
            vars(model).update(dict.fromkeys(KEPT, lambda *_, **__: None))
        candidates[name] = model.to(device)
    train = np.random.default_rng(seed).permutation(np.flatnonzero(~pixels.held_out))[:most]
    used = np.sort(np.concatenate([train, np.flatnonzero(pixels.held_out)]))
    signal, observation = _tensors(pixels, used)
    options: dict[str, Any] = {"held_out": pixels.held_out[used], "blocks": pixels.block[used], "seed": seed}
    options |= {"num_steps": NUM_STEPS, "refit": False, "progress": progress, "enough": enough, "always": len(SIMPLE)}
    fitted = noiseflow.select(signal.to(device), observation.to(device), candidates=candidates, **options)
    for model in candidates.values():
        for name in KEPT:
            vars(model).pop(name, None)
    own: dict[str, Any] = {"held_out": _tensors(pixels, pixels.held_out), "seed": seed}
    found = sorted(fitted.candidates, key=lambda one: _rank(one.name))
    return [ModelScore(**vars(one) | {"model": one.model.cpu().eval()} | own) for one in found]


def _enough(model: nn.Module, pixels: Pixels) -> bool:
    """Whether a model leaves too little to gain for others, and its tails are not too light."""
    here = copy.deepcopy(model).cpu()
    return attainable(here, pixels) <= WORTH_FITTING and not heavy_tailed(here, pixels)


def _counting(pixels: Pixels) -> bool:
    """Whether pixel values may be those of a counter with dead time: integers with sub-Poisson variance.

    The variances at `NUM_LEVELS` signal levels must agree with those of such a counter. Their expected value is
    signal·(1 − signal·dead time)². A relative error δ of the variance costs δ²/4 nats per pixel, and the scatter of each level's
    variance 0.5 nats over its number of pixels.
    """
    if pixels.observation.min() < 0 or not np.array_equal(pixels.observation, np.round(pixels.observation)):
        return False
    order = np.argsort(pixels.signal)
    signal, squares = (
        np.array([values[group].mean() for group in np.array_split(order, NUM_LEVELS)])
        for values in (pixels.signal, (pixels.observation - pixels.signal) ** 2)
    )
    lost = float(np.mean(1 - squares / np.maximum(signal, np.finfo(float).tiny)))  # 2·signal·dead time, to first order
    if not (signal[0] > 0 and 0 < lost < 1):
        return False
    dead_time = np.sum(signal - np.sqrt(signal * squares)) / np.sum(signal**2)
    expected = signal * (1 - signal * dead_time) ** 2
    return bool(np.mean((squares / expected - 1) ** 2) / 4 < WORTH_FITTING + NUM_LEVELS / len(order))


def attainable(model: nn.Module, pixels: Pixels) -> float:
    """Return the attainable improvement over a model, nats per pixel; 0 if it is within two standard errors of zero.

    It is the divergence of the model's probability integral transform from uniform, in as many cells, at `NUM_LEVELS` levels of
    the neighbours: pixels sorted by noisy signals lie below these where they are high, and above where they are low, under the
    true model too.
    """
    signal, observation = _tensors(pixels, np.ones_like(pixels.held_out))
    transform = probability_integral_transform(model, signal, observation, np.random.default_rng(0))
    cell = np.clip(np.asarray(transform) * NUM_LEVELS, 0, NUM_LEVELS - 1).astype(int)
    total, freedom = 0.0, 0
    for group in np.array_split(np.argsort(pixels.level), NUM_LEVELS):
        counts = np.bincount(cell[group], minlength=NUM_LEVELS)
        seen = counts[counts > 0]
        total += 2 * float(np.sum(seen * np.log(seen * NUM_LEVELS / len(group))))
        freedom += NUM_LEVELS - 1
    excess = total - freedom
    return excess / (2 * len(cell)) if excess > 2 * np.sqrt(2 * freedom) else 0.0


def simplest_sufficient(scores: Sequence[ModelScore]) -> ModelScore:
    """Return the simplest model whose held-out likelihood is within one standard error of the best.

    Example:
        >>> import calibration, numpy as np
        >>> rng, light = np.random.default_rng(0), np.linspace(20, 400, 64)
        >>> frames = rng.normal(100 + 2 * rng.poisson(light, (6, 64, 64)), 2).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> scores = calibration.fit_models(calibration.collect_pixels(pairs), kinds=["gaussian", "poisson-gaussian"])
        >>> calibration.simplest_sufficient(scores).name
        'poisson-gaussian'
    """
    ordered = sorted(scores, key=lambda one: _rank(one.name))
    return selection.simplest_sufficient(ordered, len(ordered[0].held_out[0]))


def foremost(scores: Sequence[ModelScore]) -> list[ModelScore]:
    """Return the models whose histograms are compared: the simplest sufficient one, the likeliest one, the Poisson-Gaussian."""
    chosen = simplest_sufficient(scores)
    return [score for score in scores if score is chosen or score.excess == 0 or score.name == "poisson-gaussian"]


def heavy_tailed(model: nn.Module, pixels: Pixels) -> bool:
    """Whether the tails of a model are `too_light` for the held-out pixels."""
    given = _tensors(pixels, pixels.held_out)
    return too_light(*tails_of_bins(model, *given, [given[0].argsort()]))


def too_light(tails: Tails, *, heavier: float = 3.0) -> bool:
    """Whether clearly more pixels than a model's, and so many times as many, lie beyond four standard deviations.

    Random telegraph noise in 5 % of the pixels gives 30 times as many; the signals' own errors less than 2.
    """
    chance = math.erfc(CLEAR / math.sqrt(2))
    return tails.observed[1] > heavier * tails.expected[1] and tails.p_value[1] < chance


def require_kind(name: str) -> None:
    """Raise ValueError if a kind of model does not exist, before any computation starts."""
    if name != "auto":
        _rank(name)


def _rank(name: str) -> int:
    if name not in KINDS:
        raise ValueError(f"unknown kind of noise model '{name}'; choose auto, {', '.join(KINDS)}")
    return list(KINDS).index(name)


def _tensors(pixels: Pixels, chosen: NDArray[Any]) -> tuple[Tensor, Tensor]:
    signal, observation = (torch.from_numpy(values[chosen]).float() for values in (pixels.signal, pixels.observation))
    return signal, observation
