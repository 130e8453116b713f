"""Which noise model suffices: each is fitted on some blocks of pixels and judged on the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.registration.aligned import AlignedPair, block_split
from noiseflow.described import described

if TYPE_CHECKING:
    from torch import Tensor, nn

    from noiseflow.commands.console import Progress
    from noiseflow.metrics.evaluation import Evaluation

KINDS: dict[str, str] = {
    "gaussian": "Gaussian",
    "poisson": "Poisson",
    "poisson-gaussian": "PoissonGaussian",
    "signal-gaussian": "SignalDependentGaussian",
    "mixture": "Mixture",
    "flow": "RadialFlow",
    "spline": "SplineFlow",
}
"""Names of the noise models that compete, simplest first, and their classes in noiseflow."""

BLOCK = 8
"""Side, in pixels, of the blocks kept apart."""

NUM_STEPS = 500
"""Optimisation steps of each model."""


@described(signal="counts", observation="counts")
@dataclass(frozen=True)
class Pixels:
    """Pixels of all pairs in one row, ready to fit and to judge.

    Attributes:
        signal: (N,) counts.
        observation: (N,) counts.
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
    """
    parts = []
    for number, pair in enumerate(pairs):
        apart = block_split(pair.mask.shape, np.random.default_rng(seed), block=BLOCK, fraction=fraction)
        rows, columns = np.indices(pair.mask.shape) // BLOCK
        block = rows * (columns.max() + 1) + columns + number * (rows.max() + 1) * (columns.max() + 1)
        parts.append([image[pair.mask] for image in (pair.signal, pair.observation, apart, block)])
    return Pixels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fit_models(
    pixels: Pixels,
    *,
    kinds: Sequence[str] = tuple(KINDS),
    seed: int = 0,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> list[ModelScore]:
    """Fit noise models and judge them on the pixels kept apart.

    Args:
        pixels: from `collect_pixels`.
        kinds: names in `KINDS`.
        seed: of every random choice.
        device: torch device to fit on.
        progress: called with the steps done of ``NUM_STEPS * len(kinds)``, and a note.

    Returns:
        One score per kind, simplest first; models on the CPU.

    Raises:
        ValueError: an unknown kind, or a model that cannot be fitted.
    """
    models, losses = {}, {}
    for index, name in enumerate(sorted(kinds, key=_rank)):
        told = None if progress is None else _shifted(progress, index * NUM_STEPS, name)
        models[name] = _fitted(name, pixels, seed, device, told)
        losses[name] = _losses(models[name], pixels)
    best = min(losses, key=lambda name: float(losses[name].mean()))
    return [_score(name, models[name], losses[name], losses[best], pixels, seed) for name in models]


def simplest_sufficient(scores: Sequence[ModelScore]) -> ModelScore:
    """The simplest model whose held-out likelihood lies within one standard error of the best one's."""
    return next(score for score in sorted(scores, key=lambda s: _rank(s.name)) if score.excess <= score.excess_error)


def require_kind(name: str) -> None:
    """Refuse, before long work, a kind of model that does not exist."""
    if name != "auto":
        _rank(name)


def _rank(name: str) -> int:
    if name not in KINDS:
        raise ValueError(f"unknown kind of noise model '{name}'; choose auto, {', '.join(KINDS)}")
    return list(KINDS).index(name)


def _shifted(progress: Progress, start: int, name: str) -> Progress:
    return lambda done, note: progress(start + done, f"{name}: {note}")


def _fitted(name: str, pixels: Pixels, seed: int, device: Any, progress: Progress | None) -> nn.Module:
    import torch

    import noiseflow

    torch.manual_seed(seed)
    options = {"mean_preserving": True} if name in ("mixture", "flow", "spline") else {}
    model: nn.Module = getattr(noiseflow, KINDS[name])(**options).to(device)
    signal, observation = (values.to(device) for values in _tensors(pixels, ~pixels.held_out))
    stopping = torch.from_numpy(pixels.block[~pixels.held_out] % 10 == 0).to(device)
    generator = torch.Generator().manual_seed(seed)
    noiseflow.fit(
        model,
        signal,
        observation,
        held_out=stopping,
        num_steps=NUM_STEPS,
        digitise=False,
        generator=generator,
        progress=progress,
    )
    return model.cpu().eval()


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
    if not np.isfinite(mean):  # a reading that the model holds impossible
        return mean, float("nan")
    _, index = np.unique(block, return_inverse=True)
    departure = np.bincount(index, values - mean)
    return mean, float(np.sqrt(np.sum(departure**2)) / len(values))
