"""The distribution of electrons plus read noise from its characteristic function: all cells of a histogram in one transform.

A cell costs a 25th to a 70th of the time in `exact`, and its probability is accurate to 1e-8 absolutely, not relatively: this is
for histograms of many pixel values, `exact` for tails. Frequencies are (L, F), radians per count, for L histograms; gain, offset
and read noise (W, 1) for W detectors; the Poisson means within a histogram have a gamma distribution of mean `electrons` and
variance `spread`, (W, L) each.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEAST_SIZE = 1e-8
"""Magnitude below which the characteristic function is truncated; of 10⁷ pixel values, this misplaces 0.1. Less likely cells are
those of outliers, which count equally."""

Real = NDArray[Any]
Complex = NDArray[np.complex128]
LogSpectrum = Callable[[Real], tuple[Complex, Complex | None]]
"""From (L, F) frequencies, radians per count, to the logarithm of the characteristic function, (W, L, F), and its derivative."""


class CellTransform:
    """Cells of L histograms, whose probabilities follow from characteristic functions.

    Args:
        width, origin: (L,) width of a cell and left edge of the first, counts.
        number: number of cells, even.
        low, high: (L,) clipping limits, counts, whose cells include all values beyond; infinite if there are none.
        dither: (L,) width of each of two uniform distributions that are added to the values, counts; 0 for none.
        sharp: whether cells are as narrow as the values' own grid or peaks: frequencies beyond the cells' count then, too.
    """

    def __init__(
        self, width: Real, origin: Real, number: int, *, low: Real, high: Real, dither: Real, sharp: bool
    ) -> None:
        self.width, self.origin, self.number, self.dither, self.sharp = width, origin, number, dither, sharp
        self._low, self._high = (
            np.where(np.isfinite(rail), np.floor((np.where(np.isfinite(rail), rail, 0) - origin) / width), end)
            for rail, end in ((low, -1.0), (high, float(number)))
        )
        self._clipped = np.flatnonzero((self._low >= 0) | (self._high < number))
        self._most = 16 * number if sharp else number // 2 + 1
        self._enough = min(40, self._most)
        self._kept: tuple[Real, Complex] | None = None

    def transform(self, law: LogSpectrum, gain: Real, read_noise: Real) -> tuple[Complex, Complex | None]:
        """Return the cell transforms of a law at the significant frequencies, and their logarithmic derivative. Gain and read
        noise, (W,), tell whether single electrons show."""
        number = min(max(self._enough, self._least_number(gain, read_noise)), self._most)
        while True:
            frequency, cell = self._frequencies(number)
            exponent, slope = law(frequency)
            if number == self._most or exponent.real[..., -1].max() < np.log(LEAST_SIZE):
                break
            number = min(2 * number, self._most)
        size = exponent.real.max(axis=(0, 1))
        self._enough = int(np.flatnonzero(size > np.log(LEAST_SIZE))[-1] * 1.2) + 2
        return np.exp(exponent) * cell, slope

    def _least_number(self, gain: Real, read_noise: Real) -> int:
        """Number of frequencies that may contain single-electron peaks; 0 if read noise blurs them."""
        highest = np.sqrt(-2 * np.log(LEAST_SIZE))
        if not self.sharp or read_noise.min() > highest / (2 * np.pi):
            return 0
        return int(highest / (gain * read_noise).min() * self.width.max() * self.number / (2 * np.pi)) + 2

    def _frequencies(self, number: int) -> tuple[Real, Complex]:
        """Return the lowest frequencies of each histogram, radians per count, and the transforms of its cells, (L, F)."""
        if self._kept is None or self._kept[0].shape[1] < number:
            turn = np.arange(2 * number) * 2 * np.pi / self.number
            frequency = turn / self.width[:, None]
            cell = np.sinc(turn / (2 * np.pi)) * np.exp(-1j * (0.5 * turn + frequency * self.origin[:, None]))
            if self.dither.any():
                cell = cell * np.sinc(frequency * self.dither[:, None] / (2 * np.pi)) ** 2
            self._kept = frequency, cell
        return self._kept[0][:, :number], self._kept[1][:, :number]

    def masses(self, transform: Complex) -> Real:
        """Convert the transform at frequencies 0, 1, … to cell probabilities, (W, L, cells), with aliasing by the cells.
        Probability beyond a clipping limit is added to its cell."""
        number = self.number
        if transform.shape[-1] > number // 2 + 1:
            periods = -(-transform.shape[-1] // number)
            padded = np.zeros((*transform.shape[:-1], periods * number), complex)
            padded[..., : transform.shape[-1]] = transform
            padded[..., 0] *= 0.5
            half = padded.reshape(*transform.shape[:-1], periods, number).sum(axis=-2)
            transform = (half + np.conj(np.roll(half[..., ::-1], 1, axis=-1)))[..., : number // 2 + 1]
        mass = np.fft.irfft(np.conj(transform), n=number)
        for level in self._clipped:
            low, high = int(self._low[level]), int(self._high[level])
            if 0 <= low < number:
                mass[:, level, low] = mass[:, level, : low + 1].sum(axis=-1)
                mass[:, level, :low] = 0.0
            if 0 <= high < number:
                mass[:, level, high] = mass[:, level, high:].sum(axis=-1)
                mass[:, level, high + 1 :] = 0.0
        return np.asarray(mass)


def of_values(
    frequency: Real, gain: Real, offset: Real, read_noise: Real, electrons: Real, spread: Real, *, slope: bool
) -> tuple[Complex, Complex | None]:
    """Log characteristic function of gain·(k + read_noise·n) + offset, (W, L, F), and its derivative by the mean signal."""
    phase, rate = gain[..., None] * frequency, np.maximum(electrons, 1e-3)[..., None]
    unit = np.exp(1j * phase) - 1
    scale, most = spread[..., None] / rate, np.maximum(rate, 1.0)  # of the gamma distribution
    power = np.where(scale < most, 1.0, np.where(rate > 1, -1.0, 0.0))  # of 1/rate in the scale
    scale = np.maximum(np.minimum(scale, most), 1e-7)
    logarithm = np.empty(np.broadcast_shapes(scale.shape, unit.shape), complex)
    # log(1 + real + i·imaginary), also where these are tiny
    real, imaginary = -scale * unit.real, -scale * unit.imag
    logarithm.real = 0.5 * np.log1p(real * (2 + real) + imaginary * imaginary)
    logarithm.imag = np.arctan2(imaginary, 1 + real)
    exponent = -rate / scale * logarithm + 1j * frequency * offset[..., None]
    exponent -= 0.5 * (phase * read_noise[..., None]) ** 2
    if not slope:
        return exponent, None
    by_rate = -(1 + power) * logarithm / scale - power * unit / (1 - scale * unit)
    return exponent, by_rate * (rate == electrons[..., None]) / gain[..., None]


def of_residuals(
    frequency: Real, gain: Real, read_noise: Real, electrons: Real, parts: Real, *, shot_share: Real, read_share: Real
) -> Complex:
    """Log characteristic function of the difference between a value and an independent, noisy estimate of its signal, (W, L, F).
    The Poisson means are those of up to J `parts`, (W, L, J, 3): weight, 0 if there is none, mean less `electrons`, and variance.
    The shares, (L,), are variances of the estimate's shot noise and read noise over those of the values."""
    phase = gain[..., None] * frequency
    cumulant = _shot(phase)
    share = shot_share[:, None]
    if share.any():
        cumulant = cumulant + np.divide(_shot(-phase * share), share, out=np.zeros_like(cumulant), where=share > 0)
    level, part = np.nonzero(parts[0, ..., 0])
    first = np.flatnonzero(np.diff(level, prepend=-1))
    weight, away, variance = np.moveaxis(parts[:, level, part], -1, 0)
    rate = np.maximum(electrons[:, level] + away, 0.0)  # of darkness, too, whose estimates scatter; the mean stays
    total = np.maximum(np.add.reduceat(weight * rate, first, axis=1), 1e-9)
    rate = np.maximum(rate * (electrons / total)[:, level], 1e-9)[..., None]
    # rate·u/(1 + bend·u), u the cumulant function, in real parts, whose functions take a fifth of the time of complex ones; a
    # plain second-order expansion would give probabilities above one where the variance is far above the mean
    bend = -0.5 * variance[..., None] / rate
    u = np.stack([cumulant.real, cumulant.imag, cumulant.real**2 + cumulant.imag**2])
    real, imaginary, square = np.take(u, level, axis=2)
    square *= bend
    rate = rate / (1 + bend * (2 * real + square))
    size, turn = rate * (real + square), rate * imaginary
    if len(level) > len(first):
        each = weight[..., None] * np.exp(size)
        real, imaginary = (np.add.reduceat(each * wave(turn), first, axis=1) for wave in (np.cos, np.sin))
        size, turn = np.log(np.maximum(np.hypot(real, imaginary), np.finfo(float).tiny)), np.arctan2(imaginary, real)
    return np.asarray(size - 0.5 * (1 + read_share[:, None]) * (phase * read_noise[..., None]) ** 2 + 1j * turn)


def _shot(phase: Real) -> Complex:
    """Cumulant function of a centred Poisson variable of rate 1, exp(iφ) − 1 − iφ, without cancellation at small φ."""
    square = phase * phase
    result = np.empty(phase.shape, complex)
    half = np.sin(0.5 * phase)
    result.real = -2 * half * half
    small = phase * square * (square / 120 * (1 - square / 42) - 1 / 6)
    result.imag = np.where(square < 1e-2, small, np.sin(phase) - phase)
    return result
