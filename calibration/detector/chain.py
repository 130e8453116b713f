"""Markov chains by emcee (doi:10.1086/670067), for a posterior that importance samples do not represent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calibration.detector.importance import Weighted
from calibration.exposures.frames import Image
from noiseflow.progress import Progress


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
    """Sample a density by walkers with differential-evolution, snooker and stretch moves.

    Args:
        log_density: function (W, 3) -> (W,) nats.
        best: (3,) its maximum.
        covariance: (3, 3) around the maximum, from which the walkers start.
        generator: random generator.
        progress: called with a task, steps done, at most how many, and a note.
        walkers: number of walkers, five for each parameter.
        length: smallest length of a converged chain, in autocorrelation times (doi:10.1086/670067).
        steps: largest number of steps: 64 000 evaluations, up to two minutes with single-electron peaks.
        block: steps of the first block, which finds the posterior and is discarded, and between two tests of convergence.
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
    # emcee requires this type of generator
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
    return None
