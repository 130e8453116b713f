"""Gain, offset and read noise of a detector with honest error bars: maximum likelihood, then the posterior by emcee."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.exposures import Image
from calibration.likelihood import DetectorLikelihood
from calibration.photon_transfer import Levels, fit_photon_transfer

if TYPE_CHECKING:
    from noiseflow.console import Progress

NUM_WALKERS = 32

NUM_TIMES = 50
"""Autocorrelation times that a chain must last (doi:10.1086/670067)."""

LARGEST_RHAT = 1.02
"""Potential scale reduction above which chains do not agree (doi:10.1214/20-BA1221)."""

READ_NOISE_RANGE = (0.01, 1000.0)
"""Electrons rms: the prior, flat in the logarithm."""


@dataclass(frozen=True)
class Interval:
    """Median and 5 % and 95 % quantiles of a parameter."""

    median: float
    q05: float
    q95: float


@dataclass(frozen=True)
class DetectorPosterior:
    """The posterior of a detector's parameters.

    Attributes:
        samples: (S, 3) gain (counts/electron), offset (counts), read noise (electrons rms).
        most_likely: (3,) maximum of the posterior.
        autocorrelation_time: steps, the longest of the three.
        rhat: potential scale reduction, the largest of the three.
        num_steps: steps kept.
    """

    samples: Image
    most_likely: Image
    autocorrelation_time: float
    rhat: float
    num_steps: int

    @property
    def gain(self) -> Interval:
        """Counts per electron; on a detector with excess noise, gain times the excess-noise factor."""
        return _interval(self.samples[:, 0])

    @property
    def offset(self) -> Interval:
        """Counts without light."""
        return _interval(self.samples[:, 1])

    @property
    def read_noise(self) -> Interval:
        """Electrons rms."""
        return _interval(self.samples[:, 2])


class LogPosterior:
    """log p(parameters | levels) for rows of (log gain, log read noise, offset).

    Flat priors in log gain, in log read noise within `READ_NOISE_RANGE`, and in the offset below the brightest level;
    or a normal prior of the offset where it was measured.

    Args:
        levels: from `collect_levels`.
        offset: measured offset and its standard error, counts; None: unknown.
    """

    def __init__(self, levels: Levels, offset: tuple[float, float] | None = None) -> None:
        self.likelihood = DetectorLikelihood(levels)
        self.offset = offset
        lit = levels.dark == 0
        self._brightest = float(levels.signal[lit].max()) if lit.any() else np.inf

    def __call__(self, parameters: Image) -> NDArray[np.float64]:
        """(W, 3) -> (W,) nats, −inf outside the prior."""
        log_gain, log_read, offset = np.atleast_2d(parameters).T
        low, high = np.log(READ_NOISE_RANGE)
        inside = (log_read > low) & (log_read < high) & (offset < self._brightest) & (np.abs(log_gain) < 20)
        result = np.full(len(offset), -np.inf)
        if inside.any():
            gain, read = np.exp(log_gain[inside]), np.exp(log_read[inside])
            result[inside] = self.likelihood(gain, offset[inside], read)
        if self.offset is not None:
            result -= 0.5 * ((offset - self.offset[0]) / self.offset[1]) ** 2
        return result


def maximum_likelihood(log_posterior: LogPosterior, levels: Levels) -> Image:
    """The most likely (log gain, log read noise, offset), from the photon-transfer line.

    Raises:
        ValueError: the noise does not grow with the signal.
    """
    from scipy.optimize import minimize

    line = fit_photon_transfer(levels)
    lowest, highest = float(levels.signal.min()), float(levels.signal.max())
    least = -line.intercept / line.gain  # the offset at which the read noise vanishes
    starts = (
        [log_posterior.offset[0]] if log_posterior.offset else [least + f * (lowest - least) for f in (0.2, 0.5, 0.9)]
    )
    best = None
    for offset in starts:
        read_variance = max(line.intercept + line.gain * offset, (0.05 * line.gain) ** 2)
        start = np.array([np.log(line.gain), 0.5 * np.log(read_variance) - np.log(line.gain), offset])
        start[1] = np.clip(start[1], *(np.log(READ_NOISE_RANGE) + np.array([0.1, -0.1])))
        steps = np.array([0.02, 0.1, max(0.02 * (highest - lowest), 1e-3)])
        simplex = np.vstack([start, start + np.diag(steps)])
        options = {"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-3, "maxiter": 600}
        found = minimize(lambda p: -float(log_posterior(p)[0]), start, method="Nelder-Mead", options=options)
        if best is None or found.fun < best.fun:
            best = found
    assert best is not None
    return np.asarray(best.x, float)


def sample_posterior(
    levels: Levels,
    *,
    offset: tuple[float, float] | None = None,
    num_steps: int = 1500,
    largest_num_steps: int = 12000,
    seed: int = 0,
    progress: Progress | None = None,
) -> DetectorPosterior:
    """Sample the posterior of gain, offset and read noise with emcee (doi:10.1086/670067).

    Walkers start around the maximum of the posterior and move by differential evolution, its snooker variant and
    stretches. The chain is prolonged until it lasts `NUM_TIMES` autocorrelation times and its halves and walkers
    agree.

    Args:
        levels: from `collect_levels`.
        offset: measured offset and its standard error, counts; None: unknown.
        num_steps: steps before the first check.
        largest_num_steps: steps after which it gives up.
        seed: of the walkers and their moves.
        progress: called with the steps done, of `largest_num_steps` at most, and a note.

    Raises:
        ValueError: the chain has not converged; the message says how many steps it needs.
    """
    import emcee

    log_posterior = LogPosterior(levels, offset)
    best = maximum_likelihood(log_posterior, levels)
    moves = [(emcee.moves.DEMove(), 0.6), (emcee.moves.DESnookerMove(), 0.1), (emcee.moves.StretchMove(), 0.3)]
    sampler = emcee.EnsembleSampler(NUM_WALKERS, 3, log_posterior, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()
    state = _walkers(log_posterior, best, np.random.default_rng(seed))
    state = sampler.run_mcmc(state, num_steps // 5)
    sampler.reset()
    while True:
        state = sampler.run_mcmc(state, num_steps if sampler.iteration == 0 else sampler.iteration)
        chain = sampler.get_chain()
        time, rhat = float(np.max(sampler.get_autocorr_time(tol=0))), potential_scale_reduction(chain)
        if progress is not None:
            progress(len(chain), f"{len(chain) / time:.0f} autocorrelation times")
        if len(chain) >= NUM_TIMES * time and rhat < LARGEST_RHAT:
            break
        if 2 * len(chain) > largest_num_steps:
            needed = int(np.ceil(NUM_TIMES * max(time, 1.0))) if len(chain) < NUM_TIMES * time else 2 * len(chain)
            raise ValueError(
                f"the posterior has not converged after {len(chain)} steps (autocorrelation time {time:.0f}, R-hat "
                f"{rhat:.3f}); it needs about {max(needed - len(chain), len(chain))} more: raise largest_num_steps to "
                f"{max(needed, 2 * len(chain))}"
            )
    flat = chain.reshape(-1, 3)[:: max(1, int(time / 2))]
    samples = np.column_stack([np.exp(flat[:, 0]), flat[:, 2], np.exp(flat[:, 1])])
    likely = np.array([np.exp(best[0]), best[2], np.exp(best[1])])
    return DetectorPosterior(samples, likely, time, rhat, len(chain))


def potential_scale_reduction(chain: Image) -> float:
    """Rank-normalised split R̂ (doi:10.1214/20-BA1221), the largest over the parameters.

    Args:
        chain: (step, walker, parameter).
    """
    from scipy.stats import norm, rankdata

    half = len(chain) // 2
    parts = np.concatenate([chain[:half], chain[half : 2 * half]], axis=1)
    found = []
    for values in np.moveaxis(parts, -1, 0):
        z = norm.ppf((rankdata(values).reshape(values.shape) - 0.375) / (values.size + 0.25))
        within = z.var(axis=0, ddof=1).mean()
        between = z.mean(axis=0).var(ddof=1)
        found.append(np.sqrt((half - 1) / half + between / within))
    return float(max(found))


def _walkers(log_posterior: LogPosterior, best: Image, generator: np.random.Generator) -> Image:
    """Starting points around the maximum, spread over a tenth of a nat to some nats below it in each direction."""
    highest = log_posterior(best)[0]
    scale = np.empty(3)
    for axis, start in enumerate((0.5, 1.0, 0.2 * abs(best[2]) + 10.0)):
        step = start
        unit = np.eye(3)[axis]
        for _ in range(40):
            if min(log_posterior(best + step * unit)[0], log_posterior(best - step * unit)[0]) > highest - 1.0:
                break
            step /= 1.7
        scale[axis] = step
    found = best + scale * generator.standard_normal((20 * NUM_WALKERS, 3))
    good = found[np.isfinite(log_posterior(found)) & (log_posterior(found) > highest - 15)]
    if len(good) < NUM_WALKERS:
        good = best + 0.1 * scale * generator.standard_normal((NUM_WALKERS, 3))
    return np.asarray(good[:NUM_WALKERS])


def _interval(values: Image) -> Interval:
    q05, median, q95 = (float(q) for q in np.percentile(values, (5, 50, 95)))
    return Interval(median, q05, q95)
