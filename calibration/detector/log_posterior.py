"""The posterior density of a detector's parameters, and its maximum."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.detector.levels import Levels, NotMeasurable
from calibration.detector.likelihood import DetectorLikelihood
from calibration.detector.photon_transfer import fit_photon_transfer
from calibration.exposures.frames import Image
from calibration.tolerances import LIKELY

READ_NOISE_RANGE = (0.1, 300.0)
"""Support of the log-uniform prior of the read noise, electrons rms; it includes all existing detectors."""

UNRESOLVED = 0.1, 0.4
"""Lower limit of the read noise in the prior: the smaller of the first value in rounding steps and the second in electrons rms,
above which no single-electron peaks are visible. Below the limit, rounding hides the read noise, and the likelihood has many
narrow peaks where electrons and codes coincide."""

SHARE_OF_DEVIATION = 0.5
"""Steps of finite differences, in standard deviations of the posterior: small enough for its skewness, and the change of 0.1 nats
is far above the numerical noise of the likelihood."""


class LogPosterior:
    """log p(parameters | levels) for rows of (log gain, offset or log variance, log read noise).

    The data determine the line of variance against signal, along which read noise and offset are degenerate. If nothing else
    determines the offset, the second coordinate is the log variance at the mean signal, in which this ridge is straight. The
    priors are flat in log gain, in log read noise within `READ_NOISE_RANGE` and above `UNRESOLVED`, and in the offset below the
    brightest level; what is known, such as from dark frames, has a normal prior: the `offset` and its standard error, counts, and
    the variance of the read noise and its standard error, counts².
    The mass of offsets without lower limit, whose noise does not grow with the signal, is infinite. If the line of variance does
    grow, the gain is at least a twentieth of its slope, where the density is smallest.
    """

    def __init__(self, levels: Sequence[Levels], offset: tuple[float, ...] | None = None) -> None:
        self.levels, self.offset = list(levels), offset
        self.likelihood = DetectorLikelihood(levels)
        signal, count = (np.concatenate([getattr(one, name) for one in levels]) for name in ("signal", "count"))
        self.reference = float(np.average(signal, weights=count))
        self.brightest = float(signal.max())
        self.step = float(max(one.step.max() for one in levels))
        self.by_offset = offset is not None or any(one.common.any() for one in levels)
        self.least = 0.0
        if not self.by_offset:
            with suppress(NotMeasurable):
                line = fit_photon_transfer(levels)
                self.least = 0.05 * line.gain * (line.gain > LIKELY * line.gain_error)

    def __call__(self, coordinates: Image) -> NDArray[np.float64]:
        """Return the log-posterior of (W, 3) coordinates, (W,) nats; −inf outside the prior."""
        coordinates = np.atleast_2d(coordinates)
        low, high = np.log(READ_NOISE_RANGE)
        inside = (coordinates[:, 2] > low) & (coordinates[:, 2] < high) & (np.abs(coordinates[:, 0]) < 50)
        with np.errstate(over="ignore"):  # variances that overflow are rejected in the next line
            gain, offset, read_noise = self.parameters(np.where(inside[:, None], coordinates, 0.0))
        # the square of the electrons remains finite. If the noise does not depend on the signal, the posterior extends to the
        # smallest gains of its prior, by which this case is detected
        inside &= (offset < self.brightest) & (self.brightest - offset < np.sqrt(np.sqrt(np.finfo(float).max)) * gain)
        inside &= (gain >= self.least) & (read_noise > np.minimum(UNRESOLVED[0] * self.step / gain, UNRESOLVED[1]))
        result = np.full(len(coordinates), -np.inf)
        if inside.any():
            result[inside] = self.likelihood(gain[inside], offset[inside], read_noise[inside])
        if not self.by_offset:
            result += coordinates[:, 1] - coordinates[:, 0]  # |∂offset / ∂log variance|
        known = self.offset or ()
        for value, middle, error in zip((offset, (gain * read_noise) ** 2), known[::2], known[1::2], strict=False):
            result -= 0.5 * ((value - middle) / error) ** 2
        return np.where(np.isnan(result), -np.inf, result)

    def parameters(self, coordinates: Image) -> tuple[Image, Image, Image]:
        """Convert (W, 3) coordinates to gain, offset and read noise, each (W,)."""
        log_gain, second, log_read = np.atleast_2d(coordinates).T
        gain, read_noise = np.exp(log_gain), np.exp(log_read)
        if self.by_offset:
            return gain, second, read_noise
        return gain, self.reference + gain * read_noise**2 - np.exp(second) / gain, read_noise

    def point(self, coordinates: Image) -> tuple[float, float, float]:
        """Convert (3,) coordinates to gain, offset and read noise."""
        gain, offset, read_noise = (value.item() for value in self.parameters(coordinates))
        return gain, offset, read_noise

    def coordinates(self, gain: ArrayLike, offset: ArrayLike, read_noise: ArrayLike) -> Image:
        """Convert parameter sets to (W, 3) coordinates."""
        g, o, r = (np.atleast_1d(np.asarray(value, float)) for value in (gain, offset, read_noise))
        variance = g * (self.reference - o) + (g * r) ** 2
        second = o if self.by_offset else np.log(np.maximum(variance, np.finfo(float).tiny))
        return np.column_stack([np.log(g), second, np.log(r)])

    def rescaled(self, best: Image) -> LogPosterior | None:
        """Return the posterior expanded about the most likely scalings at `best`; None if they are unchanged."""
        change = self.likelihood.rescaling(*self.point(best))
        moved = max((abs(factor - 1) + abs(shift) / self.brightest for factor, shift in change.values()), default=0.0)
        if moved < 1e-4:
            return None
        return LogPosterior([one.rescaled(change) for one in self.levels], self.offset)


def maximum_likelihood(
    log_posterior: LogPosterior, start: tuple[float, float, float] | None = None, *, most: int = 6
) -> tuple[LogPosterior, Image, Image]:
    """Find the maximum of the posterior.

    Args:
        start: gain, offset and read noise near the maximum; by default guesses along the photon-transfer line.
        most: largest number of rounds of maximising and of rescaling the signals to the most likely scaling.

    Returns:
        The posterior expanded about the most likely scalings of the signals, the (3,) coordinates of its maximum, and the (3, 3)
        covariance of the Laplace approximation there.

    Raises:
        NotMeasurable: the noise does not grow with the signal.
    """
    best = _start(log_posterior) if start is None else log_posterior.coordinates(*start)[0]
    little, more = 0.03, 0.2
    steps = np.diag([little, more * np.exp(best[0]) if log_posterior.by_offset else little, more])
    for _ in range(most):
        best, steps = by_whole_electrons(log_posterior, *_climb(log_posterior, best, steps))
        moved = log_posterior.rescaled(best)
        if moved is None:
            break
        log_posterior = moved
    return log_posterior, best, steps.T @ steps / SHARE_OF_DEVIATION**2


def _climb(
    log_posterior: LogPosterior, best: Image, steps: Image, *, most: int = 30, gained: float = 1e-4, halvings: int = 30
) -> tuple[Image, Image]:
    """Maximise by Newton's method with finite differences along the rows of `steps`, all points of a round in one evaluation.

    Returns:
        The (3,) maximum, where the last of at most so many rounds has `gained` no more nats, and (3, 3) uncorrelated steps of
        `SHARE_OF_DEVIATION` standard deviations; at an edge of the prior, `halvings` along each coordinate to a fall of a nat.
    """
    pairs = [(0, 1), (0, 2), (1, 2)]
    for _ in range(most):
        both = np.array([steps[i] + steps[j] for i, j in pairs])
        points = best + np.concatenate([np.zeros_like(steps[:1]), steps, -steps, both])
        value = log_posterior(points)
        if not np.isfinite(value).all():  # at an edge of the prior, which lies along the coordinates
            top = int(np.argmax(value))
            best, steps = points[top], np.diag(np.abs(steps).max(axis=0) * (0.5 if top == 0 else 1.0))
            if steps.max() < gained:
                break
            continue
        up, down, corner = value[1:].reshape(3, -1) - value[0]
        curvature = np.diag(up + down)
        for (i, j), at in zip(pairs, corner, strict=True):
            curvature[i, j] = curvature[j, i] = at - up[i] - up[j]
        fall, axes = np.linalg.eigh(-curvature)
        fall = np.maximum(np.abs(fall), (SHARE_OF_DEVIATION / 2) ** 2)  # steps at most double
        newton = axes @ (0.5 * (up - down) @ axes / fall) @ steps
        # gain and read noise change by less than a factor of three
        newton *= min(1.0, 0.5 / max(abs(newton[0]), abs(newton[2]), 1e-30))
        tried = best + np.outer([0.5, 1.0, 2.0], newton)
        points, found = np.concatenate([points, tried]), np.concatenate([value, log_posterior(tried)])
        best = points[np.argmax(found)]
        steps = (SHARE_OF_DEVIATION * axes / np.sqrt(fall)).T @ steps
        if found.max() - value[0] < gained and np.all(np.abs(np.log(fall / SHARE_OF_DEVIATION**2)) < 1):
            return best, steps
    far = READ_NOISE_RANGE[1] * 0.5 ** np.arange(halvings)
    values = [[log_posterior(best + sign * far[:, None] * axis) for sign in (1, -1)] for axis in np.eye(3)]
    near = np.max(values, axis=1) > log_posterior(best)[0] - 1
    return best, SHARE_OF_DEVIATION * np.diag(far[near.argmax(axis=1)])


def by_whole_electrons(
    log_posterior: LogPosterior, best: Image, steps: Image, *, most: int = 12
) -> tuple[Image, Image]:
    """Compare the maximum with those whose offset differs by whole electrons; with single-electron peaks, each is a maximum.

    An error of `most` electrons is that of an offset extrapolated from the photon-transfer line of 12 pixels with 10 electrons.
    """
    gain, offset, read_noise = log_posterior.point(best)
    if read_noise > UNRESOLVED[1]:
        return best, steps
    shift = gain * np.arange(-most, most + 1)
    others = log_posterior.coordinates(np.full(shift.shape, gain), offset + shift, np.full(shift.shape, read_noise))
    other = others[int(np.argmax(log_posterior(others)))]
    return (best, steps) if np.array_equal(other, others[most]) else _climb(log_posterior, other, steps)


def _start(log_posterior: LogPosterior) -> Image:
    """Return the most likely of several guesses along the photon-transfer line, (3,)."""
    gain, offset, read_noise = along_line(log_posterior, (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0))
    # of pairs recorded at one detector setting, whose scalings imply it
    common = {one.scales[index] for one in log_posterior.levels for index in one.scale[one.common]}
    implied = [scale.intercept / (1 - scale.slope) for scale in common]
    known = [log_posterior.offset[0]] if log_posterior.offset else implied
    offsets = [offset, *(np.full_like(offset, value) for value in known)]
    coordinates = np.concatenate([log_posterior.coordinates(gain, one, read_noise) for one in offsets])
    low, high = np.log(READ_NOISE_RANGE)
    coordinates[:, 2] = np.clip(coordinates[:, 2], low + 0.1, high - 0.1)
    values = np.concatenate([log_posterior(part) for part in np.array_split(coordinates, 7)])
    return np.asarray(coordinates[int(np.argmax(values))])


def along_line(log_posterior: LogPosterior, factors: Sequence[float]) -> tuple[Image, Image, Image]:
    """Return gains, the F factors times the slope of the photon-transfer line, with offsets and read noises that agree with the
    measured variance at the mean signal, (5·F,) each."""
    line = fit_photon_transfer(log_posterior.levels, known=log_posterior.offset)
    variance = max(line.gain * log_posterior.reference + line.intercept, 1e-3 * line.gain**2)
    fractions, gains = np.meshgrid((0.02, 0.1, 0.3, 0.6, 0.9), line.gain * np.array(factors))
    gain, read_noise = gains.ravel(), np.sqrt(fractions.ravel() * variance) / gains.ravel()
    return gain, log_posterior.reference - (1 - fractions.ravel()) * variance / gain, read_noise
