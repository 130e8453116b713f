"""Posterior of gain, offset and read noise: maximum likelihood, then importance sampling or emcee."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.detector.importance import DRAWS, ROUNDS, importance_sample
from calibration.detector.levels import Levels
from calibration.detector.log_posterior import LogPosterior, maximum_likelihood
from calibration.detector.photon_transfer import fit_photon_transfer
from calibration.exposures.frames import Image
from noiseflow.described import described

if TYPE_CHECKING:
    from noiseflow.progress import Progress

NINETY = 1.645
"""Half-width of a 90 % interval, in standard deviations of a normal distribution."""

NUM_WALKERS = 16

NUM_TIMES = 50
"""Smallest length of a chain, in autocorrelation times (doi:10.1086/670067)."""

LARGEST_RHAT = 1.05
"""Largest potential scale reduction factor of converged chains (doi:10.1214/20-BA1221)."""

FARTHEST = 12.0
"""Largest distance of a walker below the maximum of the log-posterior, nats."""

LEAST_STEPS = DRAWS * ROUNDS // NUM_WALKERS
"""Number of chain steps with the cost of importance sampling; if fewer are allowed, only the chain is used."""

LARGEST_NUM_STEPS = 4000
"""Largest number of chain steps: 64 000 evaluations, up to two minutes with single-electron peaks. Sampling fails earlier if the
autocorrelation time requires more."""

NUM_SAMPLES = 2000
"""Number of equally weighted samples that are kept."""

SMOOTH_SPREAD = 0.5
"""Standard deviation of the log read noise in draws around the photon-transfer line, which hardly constrains it."""

BURN_IN = 60
"""Number of burn-in steps, which locate the posterior."""


@described()
@dataclass(frozen=True)
class Interval:
    """Median, 5 % quantile and 95 % quantile of a parameter."""

    median: float
    q05: float
    q95: float

    @classmethod
    def normal(cls, middle: float, error: float) -> Interval:
        """Return the interval of a normal distribution with a standard deviation `error`."""
        return cls(float(middle), float(middle - NINETY * error), float(middle + NINETY * error))

    def times(self, factor: float) -> Interval:
        """Return the interval of a multiple of the parameter."""
        return Interval(*(float(factor * one) for one in (self.median, self.q05, self.q95)))


@described(samples="gain (counts per electron), offset (counts), read noise (electrons)", autocorrelation_time="steps")
@dataclass(frozen=True)
class DetectorPosterior:
    """The posterior of a detector's parameters.

    Attributes:
        samples: (S, 3) gain (counts/electron), offset (counts), read noise (electrons rms).
        most_likely: (3,) maximum of the posterior.
        autocorrelation_time: steps per independent sample; for a chain, the largest of the three parameters.
        rhat: potential scale reduction factor of the walkers, or of the two halves of independent draws; the largest of the
            three parameters.
        num_steps: number of chain steps kept, or of draws.
        levels: sampled levels, at the most likely scalings of their signals.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> dark = camera(torch.full((6, 64, 64), 100.0)).sample(generator=torch.Generator().manual_seed(1)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> detector = calibration.measure_detector(pairs, dark=calibration.Burst(dark, calibration=True))
        >>> gain = detector.posterior.gain
        >>> gain.q05 < 2.0 < gain.q95
        True
    """

    samples: Image
    most_likely: Image
    autocorrelation_time: float
    rhat: float
    num_steps: int
    levels: tuple[Levels, ...] = ()

    @property
    def gain(self) -> Interval:
        """Gain, counts per electron, times the excess-noise factor if the detector has one.

        The interval covers both priors of `read_noise`. The third moment of the noise is that of the shot noise, so a prior that
        favours low read noise biases the gain by −0.2 standard errors if nothing else determines the read noise.
        """
        return self._by_both_priors(0)

    @property
    def offset(self) -> Interval:
        """Offset, counts; the interval covers both priors, as for `read_noise`."""
        return self._by_both_priors(1)

    @property
    def read_noise(self) -> Interval:
        """Read noise, electrons rms.

        Exposures without dark frames hardly distinguish read noise from offset, so the prior matters. A prior that is flat in the
        log read noise favours low values; a prior that is flat in its variance (Jeffreys' prior along the line of constant total
        variance, whose third moment is linear in it) favours high values. The interval extends from the smaller lower to the
        larger upper quantile of the two, and the median is that of the second. If the exposures determine both parameters, the
        priors agree.
        """
        return self._by_both_priors(2)

    def _by_both_priors(self, column: int) -> Interval:
        if not self.levels:
            return _interval(self.samples[:, column])
        gain, offset, read_noise = self.samples.T
        values, read = self.samples[:, column], (gain * read_noise) ** 2
        shot = gain * np.maximum(self._reference() - offset, 0.0)
        flat, by_variance = _interval(values), _interval(values, read / (shot + read))
        return Interval(by_variance.median, min(flat.q05, by_variance.q05), max(flat.q95, by_variance.q95))

    def _reference(self) -> float:
        """Return the mean signal, counts."""
        signal = np.concatenate([one.signal[one.dark == 0] for one in self.levels])
        return float(np.average(signal, weights=np.concatenate([one.count[one.dark == 0] for one in self.levels])))


def sample_posterior(
    levels: Sequence[Levels],
    *,
    offset: tuple[float, float] | None = None,
    start: tuple[float, float, float] | None = None,
    num_steps: int = 200,
    largest_num_steps: int = LARGEST_NUM_STEPS,
    seed: int = 0,
    progress: Progress | None = None,
) -> DetectorPosterior:
    """Sample the posterior of gain, offset and read noise.

    Adaptive importance sampling is tried first. If it yields too few effective samples, emcee is used (doi:10.1086/670067). The
    walkers start around the maximum and use differential-evolution, snooker and stretch moves, later also independent proposals
    from a Student distribution fitted to their positions. The chain is extended until it is `NUM_TIMES` autocorrelation times
    long and its halves and walkers agree.

    Args:
        levels: from `collect_levels` and `collect_cells`.
        offset: measured offset and its standard error, counts; None if unknown.
        start: see `maximum_likelihood`.
        num_steps: number of steps before the first convergence check.
        largest_num_steps: largest number of steps.
        seed: random seed.
        progress: called with a task, steps done, at most how many, and a note.

    Raises:
        ValueError: the chain has not converged; the message states how many steps are required.

    Example:
        >>> import calibration, numpy as np
        >>> from calibration.detector.levels import Readings
        >>> rng = np.random.default_rng(0)
        >>> electrons = np.linspace(20, 400, 20_000)
        >>> counts = 100 + 2 * rng.poisson(electrons) + 2 * rng.normal(size=20_000)
        >>> levels = calibration.collect_levels([Readings(counts, 100 + 2 * electrons, electrons, step=0.0)])
        >>> posterior = calibration.sample_posterior([levels], offset=(100.0, 0.1))
        >>> round(posterior.gain.median, 1), posterior.samples.shape[1]
        (2.0, 3)
    """
    log_posterior, best = maximum_likelihood(LogPosterior(levels, offset), start)
    likely, kept = np.concatenate(log_posterior.parameters(best)), tuple(log_posterior.levels)
    generator = np.random.default_rng(seed)
    walkers = _walkers(log_posterior, best, generator)
    if len(walkers) > 3 and largest_num_steps > LEAST_STEPS:
        starts = [(best, np.cov(walkers.T)), *_smooth_start(log_posterior)]
        drawn = importance_sample(log_posterior, starts, generator, progress)
        if drawn is not None:
            highest = int(np.argmax(drawn.value))
            if drawn.value[highest] > log_posterior(best)[0] + 1.0:  # a nat: that maximum was a local one
                start = tuple(float(value[0]) for value in log_posterior.parameters(drawn.draws[highest]))  # type: ignore[assignment]
                kwargs: Any = {"num_steps": num_steps, "largest_num_steps": largest_num_steps}
                return sample_posterior(levels, offset=offset, start=start, seed=seed, progress=progress, **kwargs)
        if drawn is not None and drawn.disagreement() < LARGEST_RHAT:
            number, rhat = len(drawn.draws), drawn.disagreement()
            samples = np.column_stack(log_posterior.parameters(drawn.resampled(NUM_SAMPLES, generator)))
            return DetectorPosterior(samples, likely, number / drawn.effective, rhat, number, kept)
    sampler, time, rhat = _chain(log_posterior, walkers, num_steps, largest_num_steps, seed, progress)
    flat = sampler.get_chain().reshape(-1, 3)[:: max(1, int(time / 2))]
    samples = np.column_stack(log_posterior.parameters(flat))
    return DetectorPosterior(samples, likely, time, rhat, sampler.iteration, kept)


def _chain(
    log_posterior: LogPosterior,
    walkers: Image,
    num_steps: int,
    largest_num_steps: int,
    seed: int,
    progress: Progress | None,
) -> tuple[Any, float, float]:
    """Run a chain until it converges; return it with its autocorrelation time and potential scale reduction factor."""
    if len(walkers) < NUM_WALKERS:
        raise ValueError(
            "the posterior is too narrow to sample: the pixel values do not fit a Poisson-Gaussian detector; "
            "use raw frames, neither gamma-encoded nor rescaled"
        )
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
            progress(
                "Sampling the detector's posterior",
                len(chain),
                largest_num_steps,
                f"{len(chain) / time:.0f} autocorrelation times",
            )
        if len(chain) >= NUM_TIMES * time and rhat < LARGEST_RHAT:
            return sampler, time, rhat
        if max(2 * len(chain), NUM_TIMES * time) > largest_num_steps:  # short chains underestimate it
            raise ValueError(_not_converged(len(chain), time, rhat))


def _local_moves(weight: float) -> list[Any]:
    from emcee import moves

    return [(moves.DEMove(), 0.7 * weight), (moves.DESnookerMove(), 0.1 * weight), (moves.StretchMove(), 0.2 * weight)]


def _independent_move(visited: Image, *, freedom: float = 5.0) -> Any:
    """Create Metropolis–Hastings proposals from a Student distribution with the mean and covariance of `visited`, (S, 3)."""
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
    sampler.log_prob_fn = log_posterior  # without emcee's wrapper, which prints a traceback on Ctrl-C
    sampler.random_state = np.random.RandomState(seed).get_state()  # emcee requires this type of generator
    return sampler


def _not_converged(num_steps: int, time: float, rhat: float) -> str:
    needed = max(int(np.ceil(NUM_TIMES * time)), 2 * num_steps)
    return (
        f"the posterior has not converged after {num_steps} steps (autocorrelation time {time:.0f}, R-hat {rhat:.3f}); it "
        f"needs about {needed - num_steps} more: raise largest_num_steps to {2 * needed}, or add dark frames, which determine "
        "the offset; gamma-encoded or rescaled pixel values never converge: use raw frames"
    )


def potential_scale_reduction(chain: Image) -> float:
    """Return the rank-normalised split R̂ (doi:10.1214/20-BA1221), the largest over the parameters.

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


def _smooth_start(log_posterior: LogPosterior) -> list[tuple[Image, Image]]:
    """Return the best of several points on the photon-transfer line with its covariance, if nothing else determines the offset.

    In that case the maximum may be a narrow peak, where single-electron peaks fit the pixel values by chance.
    """
    if log_posterior.by_offset:
        return []
    line = fit_photon_transfer(log_posterior.levels)
    variance = max(line.gain * log_posterior.reference + line.intercept, 1e-3 * line.gain**2)
    fraction = np.array([0.02, 0.1, 0.3, 0.6, 0.9])
    read_noise = np.sqrt(fraction * variance) / line.gain
    gain = np.full_like(fraction, line.gain)
    points = log_posterior.coordinates(gain, log_posterior.reference - (1 - fraction) * variance / gain, read_noise)
    point = points[int(np.argmax(log_posterior(points)))]
    relative = float(np.sqrt(2 / sum(one.count.sum() for one in log_posterior.levels)))  # error of the variance
    return [(point, np.diag(np.square([line.gain_error / line.gain, relative, SMOOTH_SPREAD])))]


def _walkers(log_posterior: LogPosterior, best: Image, generator: np.random.Generator) -> Image:
    """Draw (W, 3) points of high posterior density from a Gaussian with its curvature at the maximum.

    If the curvature is not positive definite, the scales along the coordinates are used.
    """
    highest = log_posterior(best)[0]
    scale = np.empty(3)
    for axis, unit in enumerate(np.eye(3)):
        steps = 100 * 0.5 ** np.arange(30)
        around = np.stack([log_posterior(best + sign * steps[:, None] * unit) for sign in (1, -1)])
        scale[axis] = steps[np.argmax(around.max(axis=0) > highest - 1.0)]
    spread: Image = np.diag(scale**2)
    for factor in (0.5, 1.0):  # the second pass uses steps along the axes of the first ellipsoid
        axes = factor * np.linalg.cholesky(spread).T
        spread = _covariance(log_posterior, best, np.asarray(axes, float), spread)
    found = best + generator.standard_normal((6 * NUM_WALKERS, 3)) @ np.linalg.cholesky(spread).T
    # the maximum may lie at an edge of the prior
    nearer = [best + share * (found[:NUM_WALKERS] - best) for share in (0.1, 0.01, 0.001)]
    found = np.concatenate([found, *nearer])
    return np.asarray(found[log_posterior(found) > highest - FARTHEST])


def _covariance(log_posterior: LogPosterior, best: Image, axes: Image, fallback: Image) -> Image:
    """Inverse curvature at the maximum, by finite differences along the rows of `axes`; `fallback` if it is not an ellipsoid."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    steps = np.concatenate([np.zeros((1, 3)), axes, -axes, [axes[i] + axes[j] for i, j in pairs]])
    value = log_posterior(best + steps)
    if not np.isfinite(value).all():
        return fallback
    curvature = np.diag(value[1:4] + value[4:7] - 2 * value[0])
    for (i, j), both in zip(pairs, value[7:], strict=True):
        curvature[i, j] = curvature[j, i] = both - value[1 + i] - value[1 + j] + value[0]
    if np.linalg.eigvalsh(curvature).max() > -1e-3:
        return fallback
    return np.asarray(axes.T @ np.linalg.inv(-curvature) @ axes)


def _interval(values: Image, weight: Image | None = None) -> Interval:
    share = (0.05, 0.5, 0.95)
    if weight is None:
        q05, median, q95 = (float(q) for q in np.quantile(values, share))
    else:
        q05, median, q95 = (float(q) for q in np.quantile(values, share, weights=weight, method="inverted_cdf"))
    return Interval(median, q05, q95)
