"""Adaptive importance sampling of the posterior, which uses every evaluation; and Markov chains, where too few weights count."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import Image
from noiseflow.progress import Progress

FREEDOM = 5.0
"""Degrees of freedom of the Student proposals, whose tails are heavier than those of the posterior."""


@dataclass(frozen=True)
class Weighted:
    """Weighted draws.

    Attributes:
        draws: (S, 3) coordinates.
        weight: (S,) weights with sum 1.
        half: (S,) 0 or 1, for two independent halves.
        value: (S,) log-density, nats.
    """

    draws: Image
    weight: Image
    half: NDArray[np.int64]
    value: Image

    @property
    def effective(self) -> float:
        """Effective number of independent samples."""
        return float(1 / np.sum(self.weight**2))

    def disagreement(self) -> float:
        """Return the scale reduction factor of the means of the two halves, the largest over the parameters; 1 if they agree."""
        halves = [(self.draws[self.half == part], self.weight[self.half == part]) for part in (0, 1)]
        means = np.array([np.average(draws, axis=0, weights=weight) for draws, weight in halves])
        spreads = [
            np.average((each[0] - mean) ** 2, axis=0, weights=each[1]) for each, mean in zip(halves, means, strict=True)
        ]
        within = np.maximum(np.mean(spreads, axis=0), np.finfo(float).tiny)
        return float(np.sqrt(1 + np.var(means, axis=0, ddof=1) / within).max())

    def resampled(self, number: int, generator: np.random.Generator) -> NDArray[np.int64]:
        """Return the indices of equally weighted draws, (number,), by systematic resampling."""
        place = (np.arange(number) + generator.random()) / number
        return np.searchsorted(np.cumsum(self.weight), place).clip(0, len(self.draws) - 1)


def importance_sample(
    log_density: Callable[[Image], Image],
    starts: Sequence[tuple[Image, Image]],
    generator: np.random.Generator,
    progress: Progress | None = None,
    *,
    number: int = 256,
    rounds: int = 40,
    enough: float = 600.0,
) -> Weighted | None:
    """Sample a density with an adaptive mixture of kernels (adaptive multiple importance sampling).

    The first rounds draw around the `starts`, the others from Student kernels around likely draws. All draws are weighted by the
    mixture of the proposals of all rounds (doi:10.1111/j.1467-9469.2011.00756.x).

    Args:
        log_density: function (W, 3) -> (W,) nats.
        starts: (3,) points, the maximum first, with (3, 3) covariances; one round each.
        number: number of draws per round; 256 suffice for a density of three parameters.
        rounds: largest number of rounds. A smooth posterior takes 3 to 6, one with single-electron peaks up to 26 in 34 trials.
        enough: required effective samples; with 600 the 5 % and 95 % quantiles have an error of 0.1 standard deviations.

    Returns:
        The weighted draws, or None if there are not `enough` effective samples after all rounds.
    """
    kernels: list[tuple[Image, Image]] = [(start[None], _factor(2.0 * covariance)) for start, covariance in starts]
    draws, values, proposal = np.empty((0, 3)), np.empty(0), np.empty(0)
    for done in range(rounds):
        centres, factor = kernels[done]
        middle = centres[generator.integers(len(centres), size=number)]
        scale = np.sqrt(FREEDOM / generator.chisquare(FREEDOM, (number, 1)))
        fresh = middle + scale * generator.standard_normal((number, 3)) @ factor.T
        earlier = np.logaddexp(proposal, _log_mixture(draws, centres, factor))
        now = np.logaddexp.reduce([_log_mixture(fresh, *one) for one in kernels[: done + 1]])
        proposal = np.concatenate([earlier, now])
        draws = np.concatenate([draws, fresh])
        values = np.concatenate([values, _in_parts(log_density, fresh)])
        log_weight = np.where(np.isfinite(values), values - proposal, -np.inf)
        if not np.isfinite(log_weight).any():
            return None
        weight = np.exp(log_weight - log_weight.max())
        found = Weighted(draws, weight / weight.sum(), np.arange(len(draws)) % 2, values)
        if progress is not None:
            note = f"{found.effective:.0f} effective samples"
            progress("Sampling the detector's posterior", len(draws), number * rounds, note)
        if done + 1 < len(kernels):
            continue
        if done > len(starts) and found.effective > enough:
            return found
        kernels.append(_next_kernels(found, generator, number, kernels[0][1]))
    return None


def _next_kernels(
    found: Weighted, generator: np.random.Generator, number: int, first: Image, *, bandwidth: float = 0.6
) -> tuple[Image, Image]:
    """Return kernels around likely draws; their width includes a small part of the first round's.

    Relative to the posterior, `bandwidth` is larger than Silverman's factor for 256 points, 0.44, to cover the tails.
    """
    tempered = found.weight ** min(1.0, 0.1 + found.effective / 100)  # tempered while a few draws dominate
    tempered = tempered / tempered.sum()
    centres = found.draws[replace(found, weight=tempered).resampled(number, generator)]
    middle = tempered @ found.draws
    spread = (found.draws - middle).T * tempered @ (found.draws - middle)
    return centres, _factor(bandwidth**2 * spread + 1e-4 * first @ first.T)


def _factor(covariance: Image) -> Image:
    return np.asarray(np.linalg.cholesky(covariance + 1e-12 * np.trace(covariance) * np.eye(3)))


def _log_mixture(draws: Image, centres: Image, factor: Image) -> Image:
    """Log-density of equally weighted Student kernels at (S, 3) draws, up to a common constant."""
    inverse = np.linalg.inv(factor)
    near, middle = draws @ inverse.T, centres @ inverse.T
    distance = (near**2).sum(1)[:, None] + (middle**2).sum(1) - 2 * near @ middle.T
    kernel = (1 + np.maximum(distance, 0.0) / FREEDOM) ** (-(FREEDOM + 3) / 2)
    return np.asarray(np.log(np.maximum(kernel.mean(1), np.finfo(float).tiny)) - np.log(np.diag(factor)).sum())


def _in_parts(log_density: Callable[[Image], Image], draws: Image, *, size: int = 32) -> Image:
    """Evaluate the density in parts of limited memory, in order of the read noise: its least determines how many frequencies."""
    order = np.argsort(draws[:, 2])
    parts = [log_density(draws[order[start : start + size]]) for start in range(0, len(draws), size)]
    return np.concatenate(parts)[np.argsort(order)]


def ensemble_sample(
    log_density: Callable[[Image], Image],
    best: Image,
    covariance: Image,
    generator: np.random.Generator,
    progress: Progress | None = None,
    *,
    walkers: int = 16,
    length: int = 50,
    steps: int = 4000,
    block: int = 200,
    farthest: float = 12.0,
) -> Weighted | None:
    """Sample a density by emcee's walkers (doi:10.1086/670067) with differential-evolution, snooker and stretch moves.

    Args:
        log_density, generator, progress: as `importance_sample`.
        best, covariance: (3,) maximum and (3, 3) covariance around it, from which the walkers start.
        walkers: number of walkers, five for each parameter.
        length: smallest length of a converged chain, in autocorrelation times.
        steps: largest number of steps: 64 000 evaluations, up to two minutes with single-electron peaks.
        block: steps of the first block, which is discarded, and between two tests of convergence.
        farthest: largest distance of a first walker below the maximum, nats; from farther away, walkers get stuck.

    Returns:
        One draw per autocorrelation time of each walker, with equal weights; None if the chain has not converged.
    """
    from emcee import EnsembleSampler, moves

    away = generator.standard_normal((6 * walkers, 3)) @ np.linalg.cholesky(covariance).T
    # nearer points, too, because the maximum may lie at an edge of the prior
    first = np.concatenate([best + away, *(best + share * away[:walkers] for share in (0.1, 0.01, 0.001))])
    first = first[log_density(first) > log_density(best[None])[0] - farthest][:walkers]
    if len(first) < walkers:
        return None
    kinds = [(moves.DEMove(), 0.7), (moves.DESnookerMove(), 0.1), (moves.StretchMove(), 0.2)]
    sampler = EnsembleSampler(walkers, 3, log_density, moves=kinds, vectorize=True)
    sampler.log_prob_fn = log_density  # without emcee's wrapper, which prints a traceback on Ctrl-C
    sampler.random_state = np.random.RandomState(int(generator.integers(2**31))).get_state()
    state = sampler.run_mcmc(first, block)
    sampler.reset()
    while sampler.iteration < steps:
        state = sampler.run_mcmc(state, max(block, sampler.iteration))
        time = float(np.max(sampler.get_autocorr_time(tol=0)))
        if progress is not None:
            note = f"{sampler.iteration / time:.0f} autocorrelation times"
            progress("Sampling the detector's posterior by a chain", sampler.iteration, steps, note)
        if sampler.iteration >= length * time:
            every = max(1, round(time))
            draws, value = sampler.get_chain()[::every], sampler.get_log_prob()[::every]
            half = np.repeat(np.arange(len(draws)) >= len(draws) / 2, walkers).astype(np.int64)
            return Weighted(draws.reshape(-1, 3), np.full(value.size, 1 / value.size), half, value.ravel())
        if length * time > steps:  # times of short chains come out too short
            break
    return None
