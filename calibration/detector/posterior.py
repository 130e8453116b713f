"""Posterior of gain, offset and read noise: its maximum, and samples around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.detector.importance import Weighted, ensemble_sample, importance_sample
from calibration.detector.levels import Levels
from calibration.detector.likelihood import misfit
from calibration.detector.log_posterior import LogPosterior, along_line, maximum_likelihood
from calibration.detector.photon_transfer import fit_photon_transfer
from calibration.exposures.frames import Image
from calibration.tolerances import CLEAR, MISFIT
from noiseflow.described import described
from noiseflow.progress import Progress

NINETY = 1.645
"""Half-width of a 90 % interval, in standard deviations of a normal distribution."""
NUM_SAMPLES = 2000  # equally weighted samples that are kept


@described()
@dataclass(frozen=True)
class Interval:
    """Median, 5 % quantile and 95 % quantile of a parameter."""

    median: float
    q05: float
    q95: float

    @classmethod
    def of(cls, values: Image, weight: Image | None = None) -> Interval:
        """Return the interval of (S,) samples, weighted if weights are given."""
        return cls(*np.quantile(values, (0.5, 0.05, 0.95), weights=weight, method="inverted_cdf").tolist())

    @classmethod
    def normal(cls, middle: float, error: float) -> Interval:
        """Return the interval of a normal distribution with a standard deviation `error`."""
        return cls(float(middle), float(middle - NINETY * error), float(middle + NINETY * error))

    def times(self, factor: float) -> Interval:
        """Return the interval of a multiple of the parameter."""
        return Interval(*(float(factor * one) for one in (self.median, self.q05, self.q95)))

    def covering(self, other: Interval) -> Interval:
        """Return the interval that contains another one, too."""
        return Interval(self.median, min(self.q05, other.q05), max(self.q95, other.q95))

    def widened(self, factor: float) -> Interval:
        """Return the interval of so many times the width, about the median."""
        return Interval(self.median, *(self.median + factor * (one - self.median) for one in (self.q05, self.q95)))


@described(samples="gain (counts per electron), offset (counts), read noise (electrons)")
@dataclass(frozen=True)
class DetectorPosterior:
    """The posterior of a detector's parameters.

    Attributes:
        samples: (S, 3) gain (counts/electron), offset (counts), read noise (electrons rms).
        most_likely: (3,) maximum of the posterior.
        effective: effective number of independent samples.
        rhat: scale reduction factor of two halves of the samples, the largest of the three parameters.
        num_draws: number of evaluations.
        levels: sampled levels, at the most likely scalings of their signals.
    """

    samples: Image
    most_likely: Image
    effective: float
    rhat: float
    num_draws: int
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
        """Offset, counts; the interval covers both priors, as for `read_noise`, and where samples reach the darkest signal, at
        which the density ends and the offset of a black background lies, the highest one that is no longer."""
        found, ordered = self._by_both_priors(1), np.sort(self.samples[:, 1])
        outside = int(np.sum((ordered <= found.q05) | (ordered >= found.q95)))
        reached = ordered[-1] >= min((one.darkest.min() for one in self.levels), default=np.inf)
        ends = ordered[-outside:][reached & (ordered[-outside:] - ordered[:outside] <= found.q95 - found.q05)]
        return Interval(found.median, found.q05, float(ends.max(initial=found.q95)))

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
            return Interval.of(self.samples[:, column])
        gain, offset, read_noise = self.samples.T
        values, read = self.samples[:, column], (gain * read_noise) ** 2
        signal, count = (np.concatenate([getattr(one, name) for one in self.levels]) for name in ("signal", "count"))
        shot = gain * np.maximum(np.average(signal, weights=count) - offset, 0.0)
        flat, by_variance = Interval.of(values), Interval.of(values, read / (shot + read))
        return Interval(by_variance.median, min(flat.q05, by_variance.q05), max(flat.q95, by_variance.q95))


def sample_posterior(
    levels: Sequence[Levels],
    *,
    offset: tuple[float, ...] | None = None,
    start: tuple[float, float, float] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> DetectorPosterior:
    """Sample the posterior of gain, offset and read noise by adaptive importance sampling from its Laplace approximation, or by
    Markov chains where too few weights count.

    If samples are likelier than the maximum and far from it, it was a local one, and sampling starts again from the likeliest
    sample. A likelier draw alone may be a narrow peak without mass, where electrons and codes coincide.

    Args:
        offset: measured offset and its standard error, counts, and what else `LogPosterior` takes; None if unknown.
        start: gain, offset and read noise near the maximum; by default guesses along the photon-transfer line.

    Raises:
        ValueError: the samples do not represent the posterior.
    """
    generator = np.random.default_rng(seed)
    log_posterior, best, drawn = _drawn(levels, offset, start, generator, progress)
    chosen = drawn.resampled(NUM_SAMPLES, generator)
    middle, spread = drawn.draws[chosen].mean(axis=0), drawn.draws[chosen].std(axis=0)
    highest = chosen[np.argmax(drawn.value[chosen])]
    likelier = drawn.value[highest] > log_posterior(best)[0]
    if likelier and np.any(np.abs(best - middle) > CLEAR * spread):
        start = log_posterior.point(drawn.draws[highest])
        log_posterior, best, drawn = _drawn(levels, offset, start, generator, progress)
        chosen = drawn.resampled(NUM_SAMPLES, generator)
    samples = np.column_stack(log_posterior.parameters(drawn.draws[chosen]))
    likely, number = np.array(log_posterior.point(best)), len(drawn.draws)
    return DetectorPosterior(
        samples, likely, drawn.effective, drawn.disagreement(), number, tuple(log_posterior.levels)
    )


def _drawn(
    levels: Sequence[Levels],
    offset: tuple[float, ...] | None,
    start: tuple[float, float, float] | None,
    generator: np.random.Generator,
    progress: Progress | None,
    *,
    largest: float = 1.05,
) -> tuple[LogPosterior, Image, Weighted]:
    """Return the posterior, its maximum near `start`, and weighted draws around it.

    The scale reduction factor of two halves of the draws must not exceed the `largest` (doi:10.1214/20-BA1221). If the histograms
    miss the model by `CLEAR` times `MISFIT`, and rounds find no other maximum, draws are of the Laplace approximation.
    """
    log_posterior, best, spread = maximum_likelihood(LogPosterior(levels, offset), start)
    starts = [(best, spread), *_smooth_start(log_posterior)]
    drawn = importance_sample(log_posterior, starts, generator, progress)
    likely = np.array(log_posterior.point(best))
    if drawn is None and misfit(log_posterior.levels, likely, merged=True) > 1 + CLEAR * MISFIT:
        draws = best + generator.standard_normal((NUM_SAMPLES, 3)) @ np.linalg.cholesky(spread).T
        equal = np.full(len(draws), 1 / len(draws))
        return log_posterior, best, Weighted(draws, equal, np.arange(len(draws)) % 2, -np.inf * equal)
    if drawn is None or drawn.disagreement() > largest:
        drawn = ensemble_sample(log_posterior, best, spread, generator, progress)
    if drawn is None or drawn.disagreement() > largest:
        why = "add dark frames, which determine the offset; encoded or rescaled pixel values never converge: use raw frames"
        raise ValueError(f"the posterior has not converged: {why}")
    return log_posterior, best, drawn


def _smooth_start(log_posterior: LogPosterior) -> list[tuple[Image, Image]]:
    """Return the best of several points on the photon-transfer line with its covariance, if nothing else determines the offset.

    In that case the maximum may be a narrow peak, where single-electron peaks fit the pixel values by chance.
    """
    if log_posterior.by_offset:
        return []
    line = fit_photon_transfer(log_posterior.levels)
    points = log_posterior.coordinates(*along_line(log_posterior, [1.0]))
    point = points[int(np.argmax(log_posterior(points)))]
    relative = float(np.sqrt(2 / sum(one.count.sum() for one in log_posterior.levels)))  # error of the variance
    # the line hardly constrains the logarithm of the read noise
    return [(point, np.diag(np.square([line.gain_error / line.gain, relative, 0.5])))]
