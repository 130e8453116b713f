"""Correlation of residuals between pixels: what filters, interpolation, afterglow and compression leave, and noise does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.detector.residual import Residual, residual_of
from calibration.exposures.frames import Image
from calibration.exposures.masks import Mask
from calibration.registration.aligned import AlignedPair
from noiseflow.described import described

REACH = 4
"""Pixels either way within which pixels are compared; camera filters and resampling kernels are no longer."""

CLEAR = 5.0
"""Standard errors beyond which a correlation is one: among 40 lags noise reaches them once in 10⁵ frames."""

PEAK = 25.0
"""Power of a spectral line over its neighbourhood's mean. Noise exceeds it with probability exp(−25); the mean is known to 30 %,
which leaves exp(−17), once in 10⁴ frames of 1000 lines."""

ALIKE = 0.03
"""Departure from a linear kernel's correlation within which frames count as interpolated by it: the places between pixels move it
by up to 0.015, the noise of 200² pixels by as much at three standard errors, and cubic kernels are 0.09 and more away."""

LONGEST_PERIOD = 10.0
"""Pixels: blocks of image compression have 8, resampling by factors near 1 has more but then hardly changes the noise."""

LEAST_PROFILE = 64
"""Pixels along an axis from which on a period can be distinguished from chance."""

LAGS = [(dy, dx) for dy in range(REACH + 1) for dx in range(-REACH, REACH + 1) if dy > 0 or dx > 0]


@described()
@dataclass(frozen=True)
class Correlation:
    """Correlation of the residuals of neighbouring pixels, beyond what the interpolated signal brings.

    Attributes:
        lags: (K, 2) distances (y, x), pixels.
        value: (K,) correlation coefficients.
        error: (K,) standard errors for independent pixels.
        factor: spectral density of the noise at frequency 0 over its variance, 1 for independent pixels. A linear filter that
            keeps the mean keeps that density, so variance times `factor` is the variance before the filter.
        factor_error: its standard error.
        period: pixels after which the noise repeats its variance or its correlation along x or y; 0 if it does not.
    """

    lags: Image
    value: Image
    error: Image
    factor: float
    factor_error: float
    period: float

    @property
    def local(self) -> bool:
        """Whether the correlation dies out within `REACH`, as a filter's does and an interference's does not."""
        outer = np.abs(self.value[np.abs(self.lags).max(axis=1) == REACH]).max()
        return bool(outer < max(0.1 * np.abs(self.value).max(), CLEAR * self.error.max()))

    @property
    def step(self) -> float:
        """Pixels of the frames before from one pixel to the next, if these were resampled by linear interpolation; else 1.

        Interpolation repeats itself after `period` pixels, so that the step is 1 ± 1/period. Which of the two it is, and that
        the interpolation is linear, show in the neighbours' correlation: that of linear kernels so far apart. A step whose
        neighbours are as good as uncorrelated (1.5) cannot be seen.
        """
        if self.period:
            for step in (1 + 1 / self.period, 1 - 1 / self.period):
                near = _overlap(step) / _overlap(0.0)
                expected = {(0, 1): near, (1, 0): near, (1, 1): near**2}
                if near > 2 * ALIKE and all(abs(self.at(*lag) - value) < ALIKE for lag, value in expected.items()):
                    return step
        return 1.0

    @property
    def inflation(self) -> float:
        """By how much correlation widens the standard error of a variance: the root of the sum of squared correlations."""
        return float(np.sqrt(1 + 2 * np.sum(np.maximum(self.value**2 - self.error**2, 0.0))))

    @property
    def found(self) -> bool:
        """Whether pixels at any distance, or the nearest neighbours together, are correlated by more than `CLEAR` standard
        errors."""
        return bool(np.any(_clear(self.value, self.error)))

    def at(self, dy: int, dx: int) -> float:
        """Correlation at one distance."""
        return float(self.value[np.all(self.lags == (dy, dx), axis=1)][0])


def correlation_of(pairs: Sequence[AlignedPair]) -> Correlation:
    """Correlation of the residuals of all pairs together.

    Args:
        pairs: aligned, of one detector setting.
    """
    residuals = [residual_of(pair) for pair in pairs]
    expected = [one.share * _of_interpolation(pair) for one, pair in zip(residuals, pairs, strict=True)]
    return correlation_of_residuals(residuals, expected)


def correlation_of_residuals(residuals: Sequence[Residual], expected: Sequence[Image] | None = None) -> Correlation:
    """Correlation of standardised residuals of one detector.

    Args:
        residuals: of one frame each.
        expected: (K,) for each, what is no correlation of the noise; None: nothing.
    """
    products, counts = np.zeros(len(LAGS)), np.zeros(len(LAGS))
    for one, known in zip(residuals, expected or [np.zeros(len(LAGS))] * len(residuals), strict=True):
        for index, (dy, dx) in enumerate(LAGS):
            first, second = _shifted(dy, dx)
            count = float(np.count_nonzero(one.mask[first] & one.mask[second]))
            products[index] += float((one.z[first] * one.z[second]).sum()) - count * known[index]
            counts[index] += count
    value, error = products / np.maximum(counts, 1), 1 / np.sqrt(np.maximum(counts, 1))
    near = _near_clear(value, error)
    factor, spread = 1 + 2 * float(value[near].sum()), 2 * float(np.sqrt(np.sum(error[near] ** 2)))
    return Correlation(np.array(LAGS), value, error, factor, spread, max(map(_period, residuals)))


def _overlap(distance: float) -> float:
    """Integral of the product of two kernels of linear interpolation at a distance, pixels of the frame that is interpolated."""
    far = max(2 - distance, 0.0) ** 3 / 6
    return far if distance >= 1 else far - 4 / 6 * (1 - distance) ** 3


def _clear(value: Image, error: Image) -> Mask:
    """(K,) the lags that stand out; both nearest neighbours where only their sum does, as after a faint blur."""
    nearest = np.array([lag in ((0, 1), (1, 0)) for lag in LAGS])
    together = abs(float(value[nearest].sum())) > CLEAR * float(np.linalg.norm(error[nearest]))
    return np.asarray((np.abs(value) > CLEAR * error) | (nearest & together))


def _near_clear(value: Image, error: Image) -> Mask:
    """The lags that count towards the density at frequency 0: those that stand out, and their inner neighbours."""
    lags = np.abs(np.array(LAGS))
    clear = lags[_clear(value, error)]
    return (
        np.asarray([bool(np.any(np.all(lag <= clear, axis=1))) for lag in lags])
        if clear.size
        else np.zeros(len(lags), bool)
    )


def _shifted(dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Views of a frame and of the same frame (dy, dx) further on; dy is not negative."""
    right = slice(max(dx, 0), None if dx >= 0 else dx)
    left = slice(max(-dx, 0), -dx if dx > 0 else None)
    return (slice(dy, None), right), (slice(0, -dy if dy else None), left)


def _of_interpolation(pair: AlignedPair) -> Image:
    """(K,) correlation that warping gives to the white noise of the long exposure."""
    if pair.frames > 1:
        return np.zeros(len(LAGS))
    noise = np.random.default_rng(0).standard_normal(pair.long.shape)
    warped = pair.registration.warp(noise)[0]
    if warped is noise:
        return np.zeros(len(LAGS))
    products = [float(np.mean(warped[first] * warped[second])) for first, second in (_shifted(*lag) for lag in LAGS)]
    return np.array(products) / float(np.mean(warped**2))


def _period(residual: Residual) -> float:
    """The period, in pixels, of the squares and of the neighbour products of residuals along either axis, unless the scene has it
    too; 0 if none."""
    from scipy.ndimage import maximum_filter1d

    found = [0.0]
    scene = np.where(residual.mask, residual.z if residual.signal is None else residual.signal, 0.0)
    for z, signal in ((residual.z, scene), (residual.z.T, scene.T)):
        own = maximum_filter1d(_lines(signal.mean(0)), 3)
        for profile in ((z**2).mean(0), (z[:, 1:] * z[:, :-1]).mean(0)):
            if len(profile) < LEAST_PROFILE:
                continue
            relative = _lines(profile)
            first = int(np.ceil(len(profile) / LONGEST_PERIOD))
            seen = (relative[first:] > PEAK) & (own[first : len(relative)] < PEAK)
            if seen.any():
                found.append(len(profile) / (first + int(np.argmax(np.where(seen, relative[first:], 0.0)))))
    return max(found)


def _lines(profile: Image) -> Image:
    """Power spectrum over its neighbourhood's mean, the spectral lines of a profile."""
    from scipy.ndimage import median_filter

    power = np.abs(np.fft.rfft((profile - profile.mean()) * np.hanning(len(profile)))) ** 2
    usual = median_filter(power, min(31, len(power) // 2 + 1)) / np.log(2)
    return np.asarray(power / np.maximum(usual, np.finfo(float).tiny))
