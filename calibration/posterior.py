"""Gain, offset and read noise of a detector with honest error bars: maximum likelihood, then the posterior by emcee."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.exposures import Image
from calibration.likelihood import DetectorLikelihood
from calibration.photon_transfer import Levels, fit_photon_transfer

if TYPE_CHECKING:
    from noiseflow.console import Progress

NUM_WALKERS = 24

NUM_TIMES = 50
"""Autocorrelation times that a chain must last (doi:10.1086/670067)."""

LARGEST_RHAT = 1.05
"""Potential scale reduction above which chains do not agree (doi:10.1214/20-BA1221)."""

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
    """log p(parameters | levels) for rows of (log gain, offset or log variance, log read noise).

    The data fix the line of variance against signal; along it the read noise and the offset trade places. Where the
    offset is unknown, the second coordinate is the log variance at the mean signal, in which that ridge is straight. The
    priors are flat in log gain, in log read noise within `READ_NOISE_RANGE`, and in the offset below the brightest
    level; or the offset's is normal where it was measured.

    Args:
        levels: from `collect_levels`.
        offset: measured offset and its standard error, counts; None: unknown.
    """

    def __init__(self, levels: Levels, offset: tuple[float, float] | None = None) -> None:
        self.levels, self.offset = levels, offset
        self.likelihood = DetectorLikelihood(levels)
        lit = levels.dark == 0
        self.reference = float(np.average(levels.signal[lit], weights=levels.count[lit]))
        self.brightest = float(levels.signal[lit].max())

    def __call__(self, coordinates: Image) -> NDArray[np.float64]:
        """(W, 3) -> (W,) nats, −inf outside the prior."""
        coordinates = np.atleast_2d(coordinates)
        low, high = np.log(READ_NOISE_RANGE)
        gain, offset, read_noise = self.parameters(coordinates)
        inside = (coordinates[:, 2] > low) & (coordinates[:, 2] < high) & (offset < self.brightest)
        inside &= np.abs(coordinates[:, 0]) < 50
        result = np.full(len(coordinates), -np.inf)
        if inside.any():
            result[inside] = self.likelihood(gain[inside], offset[inside], read_noise[inside])
        if self.offset is None:
            result += coordinates[:, 1] - coordinates[:, 0]  # |∂offset / ∂log variance|
        else:
            result -= 0.5 * ((offset - self.offset[0]) / self.offset[1]) ** 2
        return result

    def parameters(self, coordinates: Image) -> tuple[Image, Image, Image]:
        """Gain, offset and read noise of rows of coordinates, each (W,)."""
        log_gain, second, log_read = np.atleast_2d(coordinates).T
        gain, read_noise = np.exp(log_gain), np.exp(log_read)
        if self.offset is not None:
            return gain, second, read_noise
        return gain, self.reference + gain * read_noise**2 - np.exp(second) / gain, read_noise

    def coordinates(self, gain: float, offset: float, read_noise: float) -> Image:
        """The coordinates of one parameter set, (3,)."""
        variance = gain * (self.reference - offset) + (gain * read_noise) ** 2
        second = np.log(variance) if self.offset is None else offset
        return np.array([np.log(gain), second, np.log(read_noise)])

    def focus(self, coordinates: Image) -> None:
        """Compute from now on only the frequencies that matter near these coordinates, and at lower read noise."""
        around = np.array([[a, 0, b] for a in (-0.3, 0.3) for b in (0, -0.7, -1.4)]) + coordinates
        around[:, 1] = coordinates[1]
        full = DetectorLikelihood(self.levels)
        self.likelihood = DetectorLikelihood(
            self.levels, num_frequencies=full.needed_frequencies(*self.parameters(around))
        )


def maximum_likelihood(log_posterior: LogPosterior) -> Image:
    """The most likely coordinates of a `LogPosterior`, starting from the photon-transfer line.

    Raises:
        NotMeasurable: the noise does not grow with the signal.
    """
    from scipy.optimize import minimize

    levels = log_posterior.levels
    line = fit_photon_transfer(levels)
    variance = max(line.gain * log_posterior.reference + line.intercept, 1e-3 * line.gain**2)
    electrons = variance / line.gain**2
    if log_posterior.offset is not None:
        read_variance = [(line.intercept + line.gain * log_posterior.offset[0]) / line.gain**2]
    else:
        read_variance = [fraction * electrons for fraction in (0.02, 0.3)]
    best = None
    for read in read_variance:
        read_noise = float(np.sqrt(np.clip(read, 1e-3, 0.98 * electrons)))
        known = log_posterior.offset
        offset = known[0] if known else log_posterior.reference + line.gain * read_noise**2 - variance / line.gain
        start = log_posterior.coordinates(line.gain, offset, read_noise)
        simplex = np.vstack([start, start + np.diag([0.03, known[1] if known else 0.03, 0.2])])
        options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-2, "maxiter": 400}
        log_posterior.focus(start)
        found = minimize(lambda p: -float(log_posterior(p)[0]), start, method="Nelder-Mead", options=options)
        if best is None or found.fun < best.fun:
            best = found
    log_posterior.focus(best.x)  # type: ignore[union-attr]
    return np.asarray(best.x)  # type: ignore[union-attr]


def sample_posterior(
    levels: Levels,
    *,
    offset: tuple[float, float] | None = None,
    num_steps: int = 800,
    largest_num_steps: int = 16000,
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
    log_posterior = LogPosterior(levels, offset)
    best = maximum_likelihood(log_posterior)
    sampler = _sampler(log_posterior, seed)
    state = sampler.run_mcmc(_walkers(log_posterior, best, np.random.default_rng(seed)), num_steps // 4)
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
    return DetectorPosterior(np.column_stack(log_posterior.parameters(flat)), likely, time, rhat, len(chain))


def _sampler(log_posterior: LogPosterior, seed: int) -> Any:
    import emcee

    moves = [(emcee.moves.DEMove(), 0.7), (emcee.moves.DESnookerMove(), 0.1), (emcee.moves.StretchMove(), 0.2)]
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
    """Starting points around the maximum, spread along each coordinate to where the posterior has fallen by a nat."""
    highest = log_posterior(best)[0]
    scale = np.empty(3)
    for axis, unit in enumerate(np.eye(3)):
        steps = 100 * 0.6 ** np.arange(40)
        around = np.stack([log_posterior(best + sign * steps[:, None] * unit) for sign in (1, -1)])
        scale[axis] = steps[np.argmax(around.max(axis=0) > highest - 1.0)]
    found = best + scale * generator.standard_normal((20 * NUM_WALKERS, 3))
    good = found[log_posterior(found) > highest - 12]
    if len(good) < NUM_WALKERS:
        good = best + 0.05 * scale * generator.standard_normal((NUM_WALKERS, 3))
    return np.asarray(good[:NUM_WALKERS])


def _interval(values: Image) -> Interval:
    q05, median, q95 = (float(q) for q in np.percentile(values, (5, 50, 95)))
    return Interval(median, q05, q95)
