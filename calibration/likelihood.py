"""The exact likelihood of a Poisson-Gaussian detector, by its characteristic function."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.exposures import Image
from calibration.photon_transfer import NUM_BINS, Levels

LEAST_MASS = 1e-13
"""Probability below which rounding errors of the Fourier transform rule; outliers so far out all count alike."""


class DetectorLikelihood:
    """log p(residual histograms | gain, offset, read noise).

    An observation is rounded gain·Poisson((signal − offset)/gain) + offset + gain·read_noise·normal. Its residual from a
    signal estimate that is noisy itself has the characteristic function of both noises together; the Fourier transform
    of that gives the mass of every bin exactly, for Poisson counts of any size. The signals within a level spread as a
    gamma distribution of the measured variance. Rounding counts as independent uniform noise, which it is while
    gain·read noise exceeds half a step; below that, intervals are too narrow.

    Args:
        levels: from `collect_levels`.
        num_frequencies: leading frequencies to compute, see `needed_frequencies`; all by default.
    """

    def __init__(self, levels: Levels, *, num_frequencies: int = NUM_BINS // 2 + 1) -> None:
        self.levels = levels
        frequency = np.arange(num_frequencies) * 2 * np.pi / NUM_BINS
        self._frequency = frequency / levels.width[:, None]  # (L, F) radians per count
        rounding = np.sinc(self._frequency * levels.step[:, None] / (2 * np.pi)) ** 2  # the converter's, and our dither
        middle = np.exp(1j * frequency * (NUM_BINS / 2 - 0.5))  # residual 0 lies between the two middle bins
        self._bin = np.sinc(frequency / (2 * np.pi)) * middle * rounding
        # where signals spread little, a gamma distribution to second order saves a logarithm
        self._wide = np.flatnonzero(levels.spread * (1 - levels.dark) > 0.3 * levels.variance)
        self._counts = levels.weight[:, None] * levels.histogram

    def __call__(self, gain: Image, offset: Image, read_noise: Image) -> NDArray[np.float64]:
        """Log-likelihood of each parameter set.

        Args:
            gain: (W,) counts per electron.
            offset: (W,) counts.
            read_noise: (W,) electrons rms.

        Returns:
            (W,) nats.
        """
        mass = self.masses(gain, offset, read_noise)
        return np.asarray(np.einsum("wlk,lk->w", np.log(np.maximum(mass, LEAST_MASS)), self._counts))

    def masses(self, gain: Image, offset: Image, read_noise: Image) -> Image:
        """Probability of each histogram bin, (W, L, NUM_BINS)."""
        transform = np.exp(self._exponent(gain, offset, read_noise)) * self._bin
        return np.asarray(np.fft.irfft(np.conj(transform), n=NUM_BINS))

    def needed_frequencies(self, gain: Image, offset: Image, read_noise: Image) -> int:
        """How many leading frequencies carry more than 10⁻¹² of any level for any of the parameter sets."""
        size = np.exp(self._exponent(gain, offset, read_noise).real).max(axis=(0, 1))
        return int(np.flatnonzero(size > 1e-12).max()) + 1

    def _exponent(self, gain: Image, offset: Image, read_noise: Image) -> NDArray[np.complex128]:
        """Log characteristic function of the residual, (W, L, F)."""
        levels, t = self.levels, self._frequency
        g, o, r = (np.asarray(value, float)[:, None, None] for value in (gain, offset, read_noise))
        cumulant = _shot(g * t)
        share = levels.shot_share[:, None]
        if share.any():
            own = np.divide(_shot(-g * t * share), share, out=np.zeros_like(cumulant), where=share > 0)
            cumulant = cumulant + own
        electrons = (1 - levels.dark)[:, None] * np.maximum(levels.signal[:, None] - o, 0.0) / g
        spread = (1 - levels.dark)[:, None] * levels.spread[:, None] / g**2
        exponent = cumulant * (electrons + 0.5 * spread * cumulant)  # a gamma distribution to second order
        wide = self._wide
        if wide.size:
            rate = electrons[:, wide]
            scale = np.maximum(np.minimum(spread[:, wide] / np.maximum(rate, 1e-9), rate), 1e-9)
            exponent[:, wide] = -rate / scale * np.log(1 - scale * cumulant[:, wide])
        read: NDArray[np.complex128] = exponent - 0.5 * (1 + levels.read_share[:, None]) * (g * r * t) ** 2
        return read


def _shot(phase: Image) -> NDArray[np.complex128]:
    """Cumulant function of a centred Poisson variable of rate 1, exp(iφ) − 1 − iφ, without cancellation at small φ."""
    square = phase * phase
    result = np.empty(phase.shape, complex)
    half = np.sin(0.5 * phase)
    result.real = -2 * half * half
    result.imag = np.where(
        square < 1e-2, phase * square * (square / 120 * (1 - square / 42) - 1 / 6), np.sin(phase) - phase
    )
    return result
