"""Gain, offset and read noise of a detector with honest error bars: maximum likelihood, then the posterior by emcee."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.exposures import Image
from calibration.levels import Levels
from calibration.likelihood import DetectorLikelihood
from calibration.photon_transfer import fit_photon_transfer

if TYPE_CHECKING:
    from noiseflow.console import Progress

NUM_WALKERS = 16

NUM_TIMES = 50
"""Autocorrelation times that a chain must last (doi:10.1086/670067)."""

LARGEST_RHAT = 1.05
"""Potential scale reduction above which chains do not agree (doi:10.1214/20-BA1221)."""

FARTHEST = 12.0
"""Nats below the maximum beyond which a walker has gone astray."""

BURN_IN = 60
"""Steps that only find out where the posterior lies."""

NUM_RESCALINGS = 6
"""Rounds, at most, of maximising the likelihood and bringing the signals to the scale it prefers."""

READ_NOISE_RANGE = (0.1, 300.0)
"""Electrons rms: the prior, flat in the logarithm; from under the best detectors made to beyond the worst."""


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
        levels: as sampled, about the most likely scales of their signals.
    """

    samples: Image
    most_likely: Image
    autocorrelation_time: float
    rhat: float
    num_steps: int
    levels: tuple[Levels, ...] = ()

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
    """log p(parameters | levels) for rows of (log gain, offset or log variance, log read noise).

    The data fix the line of variance against signal; along it the read noise and the offset trade places. Where nothing
    else tells the offset, the second coordinate is the log variance at the mean signal, in which that ridge is straight. The
    priors are flat in log gain, in log read noise within `READ_NOISE_RANGE`, and in the offset below the brightest
    level; or the offset's is normal where it was measured.

    Args:
        levels: from `collect_levels` and `collect_cells`.
        offset: measured offset and its standard error, counts; None: unknown.
    """

    def __init__(self, levels: Sequence[Levels], offset: tuple[float, float] | None = None) -> None:
        self.levels, self.offset = list(levels), offset
        self.likelihood = DetectorLikelihood(levels)
        signal = np.concatenate([one.signal[one.dark == 0] for one in levels])
        count = np.concatenate([one.count[one.dark == 0] for one in levels])
        self.reference = float(np.average(signal, weights=count))
        self.brightest = float(signal.max())
        self.by_offset = offset is not None or any(one.common.any() for one in levels)

    def __call__(self, coordinates: Image) -> NDArray[np.float64]:
        """(W, 3) -> (W,) nats, −inf outside the prior."""
        coordinates = np.atleast_2d(coordinates)
        low, high = np.log(READ_NOISE_RANGE)
        inside = (coordinates[:, 2] > low) & (coordinates[:, 2] < high) & (np.abs(coordinates[:, 0]) < 50)
        gain, offset, read_noise = self.parameters(np.where(inside[:, None], coordinates, 0.0))
        inside &= offset < self.brightest
        result = np.full(len(coordinates), -np.inf)
        if inside.any():
            result[inside] = self.likelihood(gain[inside], offset[inside], read_noise[inside])
        if not self.by_offset:
            result += coordinates[:, 1] - coordinates[:, 0]  # |∂offset / ∂log variance|
        if self.offset is not None:
            result -= 0.5 * ((offset - self.offset[0]) / self.offset[1]) ** 2
        return np.where(np.isnan(result), -np.inf, result)

    def parameters(self, coordinates: Image) -> tuple[Image, Image, Image]:
        """Gain, offset and read noise of rows of coordinates, each (W,)."""
        log_gain, second, log_read = np.atleast_2d(coordinates).T
        gain, read_noise = np.exp(log_gain), np.exp(log_read)
        if self.by_offset:
            return gain, second, read_noise
        return gain, self.reference + gain * read_noise**2 - np.exp(second) / gain, read_noise

    def coordinates(self, gain: ArrayLike, offset: ArrayLike, read_noise: ArrayLike) -> Image:
        """The coordinates of parameter sets, (W, 3)."""
        g, o, r = (np.atleast_1d(np.asarray(value, float)) for value in (gain, offset, read_noise))
        variance = g * (self.reference - o) + (g * r) ** 2
        second = o if self.by_offset else np.log(np.maximum(variance, np.finfo(float).tiny))
        return np.stack([np.log(g), second, np.log(r)], -1)

    def rescaled(self, best: Image) -> LogPosterior | None:
        """The same posterior about the scales that are most likely at `best`; None if they are that already."""
        change = self.likelihood.rescaling(*(float(value[0]) for value in self.parameters(best)))
        moved = max((abs(factor - 1) + abs(shift) / self.brightest for factor, shift in change.values()), default=0.0)
        if moved < 1e-4:
            return None
        return LogPosterior([one.rescaled(change) for one in self.levels], self.offset)


def maximum_likelihood(
    log_posterior: LogPosterior, start: tuple[float, float, float] | None = None
) -> tuple[LogPosterior, Image]:
    """The most likely coordinates.

    Args:
        log_posterior: of the levels.
        start: gain, offset and read noise near the maximum; by default guesses along the photon-transfer line.

    Returns:
        The posterior about the most likely scales of the signals, and the (3,) coordinates of its maximum.

    Raises:
        NotMeasurable: the noise does not grow with the signal.
    """
    best = _start(log_posterior) if start is None else log_posterior.coordinates(*start)[0]
    for _ in range(NUM_RESCALINGS):
        best = _climb(log_posterior, best)
        moved = log_posterior.rescaled(best)
        if moved is None:
            break
        log_posterior = moved
    return log_posterior, best


def _climb(log_posterior: LogPosterior, start: Image) -> Image:
    from scipy.optimize import minimize

    along_offset = 0.3 * float(np.exp(start[0])) if log_posterior.by_offset else 0.03
    simplex = np.vstack([start, start + np.diag([0.03, along_offset, 0.2])])
    options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-2, "maxiter": 400}
    found = minimize(lambda p: -float(log_posterior(p)[0]), start, method="Nelder-Mead", options=options)
    return np.asarray(found.x)


def _start(log_posterior: LogPosterior) -> Image:
    """The most likely of a set of guesses along the photon-transfer line, (3,)."""
    line = fit_photon_transfer(log_posterior.levels)
    variance = max(line.gain * log_posterior.reference + line.intercept, 1e-3 * line.gain**2)
    guesses = []
    for factor in (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0):
        gain = factor * line.gain
        for fraction in (0.02, 0.1, 0.3, 0.6, 0.9):
            read_noise = np.sqrt(fraction * variance) / gain
            offset = log_posterior.reference - (1 - fraction) * variance / gain
            guesses.append((gain, offset, read_noise))
            known = [log_posterior.offset[0]] if log_posterior.offset else _common_offsets(log_posterior.levels)
            guesses += [(gain, value, read_noise) for value in known]
    coordinates = log_posterior.coordinates(*np.array(guesses).T)
    low, high = np.log(READ_NOISE_RANGE)
    coordinates[:, 2] = np.clip(coordinates[:, 2], low + 0.1, high - 0.1)
    values = np.concatenate([log_posterior(part) for part in np.array_split(coordinates, 7)])
    return np.asarray(coordinates[int(np.argmax(values))])


def _common_offsets(levels: Sequence[Levels]) -> list[float]:
    """Offsets that the scales of pairs taken with one detector setting tell."""
    found = {one.scales[index] for one in levels for index in one.scale[one.common]}
    return [scale.intercept / (1 - scale.slope) for scale in found]


def sample_posterior(
    levels: Sequence[Levels],
    *,
    offset: tuple[float, float] | None = None,
    start: tuple[float, float, float] | None = None,
    num_steps: int = 200,
    largest_num_steps: int = 16000,
    seed: int = 0,
    progress: Progress | None = None,
) -> DetectorPosterior:
    """Sample the posterior of gain, offset and read noise with emcee (doi:10.1086/670067).

    Walkers start around the maximum of the posterior and move by differential evolution, its snooker variant and
    stretches; then also by independent draws from a Student distribution fitted to where they went. The chain is prolonged
    until it lasts `NUM_TIMES` autocorrelation times and its halves and walkers agree.

    Args:
        levels: from `collect_levels` and `collect_cells`.
        offset: measured offset and its standard error, counts; None: unknown.
        start: see `maximum_likelihood`.
        num_steps: steps before the first check.
        largest_num_steps: steps after which it gives up.
        seed: of the walkers and their moves.
        progress: called with the steps done, of `largest_num_steps` at most, and a note.

    Raises:
        ValueError: the chain has not converged; the message says how many steps it needs.
    """
    log_posterior, best = maximum_likelihood(LogPosterior(levels, offset), start)
    walkers = _walkers(log_posterior, best, np.random.default_rng(seed))
    first = _sampler(log_posterior, _local_moves(1.0), seed)
    state = first.run_mcmc(walkers[:NUM_WALKERS], BURN_IN)
    visited, value = (
        first.get_chain(discard=BURN_IN // 2, flat=True),
        first.get_log_prob(discard=BURN_IN // 2, flat=True),
    )
    visited = np.concatenate([visited[value > value.max() - FARTHEST], walkers])
    sampler = _sampler(log_posterior, [(_independent_move(visited), 0.5), *_local_moves(0.5)], seed)
    state = sampler.run_mcmc(state.coords, num_steps // 5)
    sampler.reset()
    while True:
        state = sampler.run_mcmc(state, max(num_steps, sampler.iteration))
        chain = sampler.get_chain()
        time, rhat = float(np.max(sampler.get_autocorr_time(tol=0))), potential_scale_reduction(chain)
        if progress is not None:
            progress(len(chain), f"{len(chain) / time:.0f} autocorrelation times")
        if len(chain) >= NUM_TIMES * time and rhat < LARGEST_RHAT:
            break
        if 2 * len(chain) > largest_num_steps:
            raise ValueError(_not_converged(len(chain), time, rhat))
    flat = chain.reshape(-1, 3)[:: max(1, int(time / 2))]
    likely = np.concatenate(log_posterior.parameters(best))
    samples = np.column_stack(log_posterior.parameters(flat))
    return DetectorPosterior(samples, likely, time, rhat, len(chain), tuple(log_posterior.levels))


def _local_moves(weight: float) -> list[Any]:
    from emcee import moves

    return [(moves.DEMove(), 0.7 * weight), (moves.DESnookerMove(), 0.1 * weight), (moves.StretchMove(), 0.2 * weight)]


def _independent_move(visited: Image, *, freedom: float = 5.0) -> Any:
    """Metropolis–Hastings proposals from a Student distribution of the mean and covariance of `visited`, (S, 3)."""
    from emcee import moves
    from scipy.stats import multivariate_t

    target = multivariate_t(visited.mean(0), 1.1 * np.cov(visited.T), df=freedom)

    def propose(coordinates: Image, random: Any) -> tuple[Image, Image]:
        proposed = np.atleast_2d(target.rvs(len(coordinates), random_state=random))
        return proposed, target.logpdf(coordinates) - target.logpdf(proposed)

    return moves.MHMove(propose)


def _sampler(log_posterior: LogPosterior, moves: list[Any], seed: int) -> Any:
    import emcee

    sampler = emcee.EnsembleSampler(NUM_WALKERS, 3, log_posterior, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()  # emcee's own generator is of this kind
    return sampler


def _not_converged(num_steps: int, time: float, rhat: float) -> str:
    needed = max(int(np.ceil(NUM_TIMES * time)), 2 * num_steps)
    return (
        f"the posterior has not converged after {num_steps} steps (autocorrelation time {time:.0f}, R-hat {rhat:.3f}); it "
        f"needs about {needed - num_steps} more: raise largest_num_steps to {2 * needed}, or give dark frames, which fix "
        "the offset"
    )


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
    """Points where the posterior is high, (W, 3): drawn from the Gaussian of its curvature at the maximum where it has one,
    else along the coordinates."""
    highest = log_posterior(best)[0]
    scale = np.empty(3)
    for axis, unit in enumerate(np.eye(3)):
        steps = 100 * 0.5 ** np.arange(30)
        around = np.stack([log_posterior(best + sign * steps[:, None] * unit) for sign in (1, -1)])
        scale[axis] = steps[np.argmax(around.max(axis=0) > highest - 1.0)]
    spread: Image = np.diag(scale**2)
    for factor in (0.5, 1.0):  # the second time with steps along the axes of the first's ellipsoid
        axes = factor * np.linalg.cholesky(spread).T
        spread = _covariance(log_posterior, best, np.asarray(axes, float), spread)
    found = best + generator.standard_normal((6 * NUM_WALKERS, 3)) @ np.linalg.cholesky(spread).T
    found = np.concatenate([found, best + 0.1 * (found[:NUM_WALKERS] - best)])
    return np.asarray(found[log_posterior(found) > highest - FARTHEST])


def _covariance(log_posterior: LogPosterior, best: Image, axes: Image, fallback: Image) -> Image:
    """Inverse curvature at the maximum by differences along the rows of `axes`; `fallback` where it is no ellipsoid."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    steps = np.concatenate([np.zeros((1, 3)), axes, -axes, [axes[i] + axes[j] for i, j in pairs]])
    value = log_posterior(best + steps)
    curvature = np.diag(value[1:4] + value[4:7] - 2 * value[0])
    for (i, j), both in zip(pairs, value[7:], strict=True):
        curvature[i, j] = curvature[j, i] = both - value[1 + i] - value[1 + j] + value[0]
    if not np.isfinite(curvature).all() or np.linalg.eigvalsh(curvature).max() > -1e-3:
        return fallback
    return np.asarray(axes.T @ np.linalg.inv(-curvature) @ axes)


def _interval(values: Image) -> Interval:
    q05, median, q95 = (float(q) for q in np.percentile(values, (5, 50, 95)))
    return Interval(median, q05, q95)
