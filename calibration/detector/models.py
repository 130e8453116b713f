"""Which noise model suffices: fitted by the library's one selector on some blocks of pixels, judged on the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import rails, rounding_step
from calibration.registration.aligned import AlignedPair, block_split
from noiseflow.described import described

if TYPE_CHECKING:
    from torch import Tensor, nn

    from noiseflow.commands.console import Progress
    from noiseflow.metrics.evaluation import Evaluation

KINDS: dict[str, str] = {
    "gaussian": "Gaussian",
    "poisson": "Poisson",
    "counting": "DeadTimeCounter",
    "poisson-gaussian": "PoissonGaussian",
    "excess-noise": "ExcessNoise",
    "signal-gaussian": "SignalDependentGaussian",
    "mixture": "Mixture",
    "flow": "RadialFlow",
    "spline": "SplineFlow",
    "physics-flow": "PhysicsFlow",
}
"""Names of the noise models that compete, simplest first, and their classes in noiseflow."""

BLOCK = 8
"""Side, in pixels, of the blocks kept apart."""

SIMPLE = ("gaussian", "poisson", "poisson-gaussian", "signal-gaussian")
"""Those that are fitted always; the flexible ones only where these leave something to gain."""

MOST_COUNTS = 1e4
"""Mean counts above which values are no counts of single events: dead times of counters end there at exposures of a frame."""

FLEXIBLE = ("mixture", "flow", "spline", "physics-flow")
"""Those of some thousand parameters."""

NUM_STEPS = 200
"""Optimisation steps of each model."""

MOST_PIXELS = 32_768
"""Pixels that models are fitted to, as many as the selector screens them by."""

MOST_BLOCKS = 8192
"""Blocks, half of them kept apart to judge: 262 000 pixels tell two models apart to 0.0003 nats, a tenth of `WORTH_FITTING`, and
finite samples add 1e-5 to a divergence. More would take most of the time of a large exposure and change no choice."""

WORTH_FITTING = 2.5e-3
"""Nats per pixel that a simple model must leave before flexible ones are fitted: half of what the choice may lose, 0.005."""

GROUPS = 16
"""Signal levels, and cells of the probability integral transform in each, that the test for flexible models compares."""


@described(signal="counts", observation="counts")
@dataclass(frozen=True)
class Pixels:
    """Pixels of all pairs in one row, ready to fit and to judge.

    Attributes:
        signal: (N,) counts.
        observation: (N,) counts; whole numbers where the detector rounds.
        held_out: (N,) those that judge.
        block: (N,) number of the block each belongs to.
    """

    signal: NDArray[np.float64]
    observation: NDArray[np.float64]
    held_out: NDArray[np.bool_]
    block: NDArray[np.int64]


@described(nll="nats per pixel", nll_error="nats per pixel", excess="nats per pixel", excess_error="nats per pixel")
@dataclass(frozen=True)
class ModelScore:
    """A fitted noise model and its figures on the pixels kept apart.

    Attributes:
        name: one of `KINDS`.
        model: the fitted model.
        nll: mean negative log-likelihood, nats per pixel.
        nll_error: its standard error, from the scatter between blocks.
        excess: nll above the best model's, nats per pixel.
        excess_error: its standard error, paired block by block.
        evaluation: divergences of the residuals' histogram from the model's own bin masses, each with its floor; PIT.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> (score,) = calibration.fit_models(calibration.collect_pixels(pairs), kinds=["gaussian"])
        >>> score.name, score.excess
        ('gaussian', 0.0)
    """

    name: str
    model: nn.Module
    nll: float
    nll_error: float
    excess: float
    excess_error: float
    evaluation: Evaluation


def collect_pixels(pairs: Sequence[AlignedPair], *, seed: int = 0, fraction: float = 0.5) -> Pixels:
    """Gather the trusted pixels of all pairs, with whole blocks kept apart for judging.

    Blocks lie at the same places in every pair, so that a pixel's scene never sits on both sides.

    Args:
        pairs: aligned pairs.
        seed: of the choice of blocks.
        fraction: of the blocks kept apart.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> pixels = calibration.collect_pixels(pairs, fraction=0.25)
        >>> pixels.observation.shape, float(pixels.held_out.mean())
        ((24576,), 0.25)
    """
    parts = []
    for number, pair in enumerate(pairs):
        apart = block_split(pair.mask.shape, np.random.default_rng(seed), block=BLOCK, fraction=fraction)
        rows, columns = np.indices(pair.mask.shape) // BLOCK
        block = rows * (columns.max() + 1) + columns + number * (rows.max() + 1) * (columns.max() + 1)
        parts.append([image[pair.mask] for image in (pair.signal, whole_observation(pair), apart, block)])
    return _thinned(Pixels(*(np.concatenate(column) for column in zip(*parts, strict=True))), seed)


def _thinned(pixels: Pixels, seed: int) -> Pixels:
    """`MOST_BLOCKS` random blocks of the pixels, or all where there are fewer."""
    blocks = np.unique(pixels.block)
    if len(blocks) <= MOST_BLOCKS:
        return pixels
    generator = np.random.default_rng([seed, 1])  # not the one that chose the blocks kept apart
    kept = np.isin(pixels.block, generator.permutation(blocks)[:MOST_BLOCKS])
    return Pixels(pixels.signal[kept], pixels.observation[kept], pixels.held_out[kept], pixels.block[kept])


def whole_observation(pair: AlignedPair) -> NDArray[np.float64]:
    """(y, x) the observation of a pair, as whole numbers if the exposure's are.

    Taking the signal's own noise out moves observations off the converter's steps. They are rounded again, and shrunk a little
    more for the twelfth of a squared step that this adds; clipped pixel values stay at their limit. Where the noise is as fine
    as the rounding, they stay as recorded.
    """
    step = rounding_step(pair.short)
    if not step:
        return pair.observation
    own = (1 - pair.share) * pair.total_variance(pair.signal)
    kept = np.sqrt(np.maximum(own - step**2 / 12, 0.0) / np.maximum(pair.total_variance(pair.signal), step**2 / 12))
    observation = np.round((pair.signal + kept * (pair.short - pair.signal)) / step) * step
    low, high = rails(pair.short)
    recorded = (own < step**2) | (pair.share < 1e-3) | (pair.short <= low) | (pair.short >= high)
    return np.where(recorded, pair.short, observation.clip(low, high))


def fit_models(
    pixels: Pixels,
    *,
    kinds: Sequence[str] | None = None,
    detector: tuple[float, float, float] | None = None,
    seed: int = 0,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> list[ModelScore]:
    """Fit noise models and judge them on the pixels kept apart.

    Args:
        pixels: from `collect_pixels`.
        kinds: names in `KINDS`; by default the simple ones, and the flexible ones where the best of these leaves more than
            `WORTH_FITTING` nats per pixel to gain.
        detector: gain, offset and read noise as measured, for the Poisson-Gaussian model; None: fitted.
        seed: of every random choice.
        device: torch device to fit on.
        progress: called with the models done, and a note.

    Returns:
        One score per kind, simplest first; models on the CPU.

    Raises:
        ValueError: an unknown kind, or a model that cannot be fitted.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> pixels = calibration.collect_pixels(pairs)
        >>> scores = calibration.fit_models(pixels, kinds=["gaussian", "poisson-gaussian"])
        >>> [score.name for score in scores if score.excess < 0.02]
        ['poisson-gaussian']
    """
    models = _fitted(sorted(kinds or SIMPLE, key=_rank), pixels, detector, seed, device)
    if progress is not None:
        progress(len(models), "simple models")
    losses = {name: _losses(model, pixels) for name, model in models.items()}
    best = min(losses, key=lambda name: float(losses[name].mean()))
    for more in (_special(pixels), FLEXIBLE):
        if kinds is None and attainable(models[best], pixels) > WORTH_FITTING:
            models |= _fitted(more, pixels, detector, seed, device)
            losses |= {name: _losses(models[name], pixels) for name in more}
            best = min(losses, key=lambda name: float(losses[name].mean()))
    if progress is not None:
        progress(len(KINDS), "all models")
    return [_score(name, models[name], losses[name], losses[best], pixels, seed) for name in sorted(models, key=_rank)]


def _special(pixels: Pixels) -> tuple[str, ...]:
    """Models of other detectors: one that multiplies electrons; and a counter with dead time, for whole numbers that scatter less
    than Poisson counts, as such a counter's do."""
    whole = pixels.observation.min() >= 0 and np.array_equal(pixels.observation, np.round(pixels.observation))
    return ("counting", "excess-noise") if whole and _scatters_as_counts(pixels) else ("excess-noise",)


def _scatters_as_counts(pixels: Pixels) -> bool:
    """Whether variances at `GROUPS` levels of the signal are those of a counter with dead time, signal·(1 − signal·dead time)²,
    so nearly that a model of such counts may be the best: variances that are off by a factor of 1 + δ cost δ²/4 nats, and N
    values seem off by half a nat over N."""
    order = np.argsort(pixels.signal)
    signal, squares = (
        np.array([values[group].mean() for group in np.array_split(order, GROUPS)])
        for values in (pixels.signal, (pixels.observation - pixels.signal) ** 2)
    )
    lost = float(np.mean(1 - squares / np.maximum(signal, np.finfo(float).tiny)))  # 2·signal·dead time, to first order
    if not (signal[0] > 0 and 0 < lost < 1 and signal.mean() < MOST_COUNTS):
        return False
    dead_time = np.sum(signal - np.sqrt(signal * squares)) / np.sum(signal**2)
    expected = signal * (1 - signal * dead_time) ** 2
    return bool(np.mean((squares / expected - 1) ** 2) / 4 < WORTH_FITTING + GROUPS / len(order))


def attainable(model: nn.Module, pixels: Pixels) -> float:
    """Nats per pixel that another model could gain; 0 where that is within two standard errors of nothing.

    The divergence of the model's probability integral transform from uniform, in `GROUPS` levels of the signal.
    """
    from noiseflow.metrics.evaluation import probability_integral_transform

    signal, observation = _tensors(pixels, np.ones_like(pixels.held_out))
    transform = probability_integral_transform(model, signal, observation, np.random.default_rng(0))
    cell = np.clip(np.asarray(transform) * GROUPS, 0, GROUPS - 1).astype(int)
    total, freedom = 0.0, 0
    for group in np.array_split(np.argsort(pixels.signal), GROUPS):
        counts = np.bincount(cell[group], minlength=GROUPS)
        seen = counts[counts > 0]
        total += 2 * float(np.sum(seen * np.log(seen * GROUPS / len(group))))
        freedom += GROUPS - 1
    excess = total - freedom
    return excess / (2 * len(cell)) if excess > 2 * np.sqrt(2 * freedom) else 0.0


def simplest_sufficient(scores: Sequence[ModelScore]) -> ModelScore:
    """The simplest model whose held-out likelihood lies within one standard error of the best one's.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> scores = calibration.fit_models(calibration.collect_pixels(pairs), kinds=["gaussian", "poisson-gaussian"])
        >>> calibration.simplest_sufficient(scores).name
        'poisson-gaussian'
    """
    return next(score for score in sorted(scores, key=lambda s: _rank(s.name)) if score.excess <= score.excess_error)


def require_kind(name: str) -> None:
    """Refuse, before long work, a kind of model that does not exist."""
    if name != "auto":
        _rank(name)


def _rank(name: str) -> int:
    if name not in KINDS:
        raise ValueError(f"unknown kind of noise model '{name}'; choose auto, {', '.join(KINDS)}")
    return list(KINDS).index(name)


def _fitted(
    names: Sequence[str], pixels: Pixels, detector: tuple[float, float, float] | None, seed: int, device: Any
) -> dict[str, nn.Module]:
    """Models by name, fitted by the selector to pixels not kept apart; the Poisson-Gaussian one as measured, if it is."""
    import torch

    import noiseflow
    from noiseflow.fitting.selection import select

    torch.manual_seed(seed)
    chosen = np.flatnonzero(~pixels.held_out)
    chosen = np.random.default_rng(seed).permutation(chosen)[:MOST_PIXELS]
    signal, observation = (
        torch.from_numpy(values[chosen]).float().to(device) for values in (pixels.signal, pixels.observation)
    )
    found: dict[str, nn.Module] = {}
    digitisation = noiseflow.detect_digitisation(pixels.observation)
    if detector is not None and "poisson-gaussian" in names:
        model: nn.Module = noiseflow.PoissonGaussian(*detector)
        found["poisson-gaussian"] = noiseflow.Digitised(model, *digitisation) if digitisation.found else model
    options = {name: {"mean_preserving": True} if name in ("mixture", "flow", "spline") else {} for name in names}
    candidates = {
        name: getattr(noiseflow, KINDS[name])(**options[name]).to(device) for name in names if name not in found
    }
    if candidates:
        selection = select(signal, observation, candidates=candidates, num_steps=NUM_STEPS, seed=seed)
        found |= {one.name: one.model for one in selection.candidates}
    return {name: found[name].cpu().eval() for name in names}


def _score(
    name: str,
    model: nn.Module,
    losses: NDArray[np.float64],
    best: NDArray[np.float64],
    pixels: Pixels,
    seed: int,
) -> ModelScore:
    from noiseflow.metrics.evaluation import evaluate

    block = pixels.block[pixels.held_out]
    excess = (0.0, 0.0) if losses is best else _mean_and_error(losses - best, block)
    evaluation = evaluate(model, *_tensors(pixels, pixels.held_out), seed=seed)
    return ModelScore(name, model, *_mean_and_error(losses, block), *excess, evaluation)


def _losses(model: nn.Module, pixels: Pixels) -> NDArray[np.float64]:
    """Negative log-likelihood of each pixel kept apart, nats."""
    from noiseflow.metrics.evaluation import pixel_log_prob

    return -np.asarray(pixel_log_prob(model, *_tensors(pixels, pixels.held_out)).numpy())


def _tensors(pixels: Pixels, chosen: NDArray[np.bool_]) -> tuple[Tensor, Tensor]:
    import torch

    signal, observation = (torch.from_numpy(values[chosen]).float() for values in (pixels.signal, pixels.observation))
    return signal, observation


def _mean_and_error(values: NDArray[np.float64], block: NDArray[np.int64]) -> tuple[float, float]:
    """Mean, and its standard error from the scatter of whole blocks (pixels of one block may err alike)."""
    mean = float(values.mean())
    if not np.isfinite(mean):  # a pixel value that the model holds impossible
        return mean, float("nan")
    _, index = np.unique(block, return_inverse=True)
    departure = np.bincount(index, values - mean)
    return mean, float(np.sqrt(np.sum(departure**2)) / len(values))
