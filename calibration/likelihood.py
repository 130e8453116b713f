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

    An observation is rounded gain·Poisson((signal − offset)/gain) + offset + gain·read_noise·normal. Its residual
    from a signal estimate that is noisy itself has the characteristic function of both noises together; the Fourier
    transform of that gives the mass of every bin exactly, for Poisson counts of any size. Mass beyond a rail counts
    at the rail.

    Args:
        levels: from `collect_levels`.
    """

    def __init__(self, levels: Levels) -> None:
        self.levels = levels
        frequency = np.arange(NUM_BINS // 2 + 1) * 2 * np.pi / NUM_BINS
        self._frequency = frequency / levels.width[:, None]  # (L, F) radians per count
        rounding = np.sinc(self._frequency * levels.step[:, None] / (2 * np.pi))
        middle = np.exp(1j * frequency * (NUM_BINS / 2 - 0.5))  # residual 0 lies between the two middle bins
        self._bin = np.sinc(frequency / (2 * np.pi)) * middle * rounding
        self._clipped = bool(levels.below.any() or levels.above.any())

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
        counts = self.levels.weight[:, None] * self.levels.histogram
        return np.asarray(np.einsum("wlk,lk->w", np.log(np.maximum(mass, LEAST_MASS)), counts))

    def masses(self, gain: Image, offset: Image, read_noise: Image) -> Image:
        """Probability of each histogram bin, (W, L, NUM_BINS)."""
        levels = self.levels
        g, o, r = (np.asarray(value, float)[:, None, None] for value in (gain, offset, read_noise))
        t = self._frequency
        lit = (1 - levels.dark)[:, None]
        electrons = lit * np.maximum(levels.signal[:, None] - o, 0.0) / g
        cumulant = _shot(g * t)
        share = levels.shot_share[:, None]
        cumulant = cumulant + np.divide(_shot(-g * t * share), share, out=np.zeros_like(cumulant), where=share > 0)
        exponent = electrons * cumulant + 0.5 * lit * levels.spread[:, None] / g**2 * cumulant**2
        exponent -= 0.5 * (1 + levels.read_share[:, None]) * (g * r * t) ** 2
        mass = np.fft.irfft(np.conj(np.exp(exponent) * self._bin), n=NUM_BINS)
        return self._railed(np.maximum(mass, 0.0)) if self._clipped else mass

    def _railed(self, mass: Image) -> Image:
        """Move the mass beyond each pixel's rail onto it."""
        below, above = self.levels.below, self.levels.above
        free = (1 - below.sum(1, keepdims=True) + np.cumsum(below, 1) - below) * (1 - np.cumsum(above, 1))
        under = np.cumsum(mass, -1)
        over = np.cumsum(mass[..., ::-1], -1)[..., ::-1]
        return np.asarray(mass * free + below * under + above * over)


def _shot(phase: Image) -> NDArray[np.complex128]:
    """Cumulant function of a centred Poisson variable per unit rate: exp(iφ) − 1 − iφ, without cancellation at small
    φ."""
    real = -2 * np.sin(phase / 2) ** 2
    small = np.abs(phase) < 1e-2
    imaginary = np.where(small, -(phase**3) / 6 * (1 - phase**2 / 20), np.sin(phase) - phase)
    return np.asarray(real + 1j * imaginary)
