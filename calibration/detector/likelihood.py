"""Exact likelihood of a Poisson-Gaussian detector, computed from its characteristic function."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.detector.levels import Levels, Scale
from calibration.exposures.frames import Image

LEAST_SIZE = 1e-8
"""Magnitude below which the characteristic function is truncated; of 10⁷ pixel values, this misplaces 0.1.
It is the lower bound of a cell's probability too, below which truncation errors dominate; all farther outliers count equally."""

LARGEST_GAIN = 30.0
"""Largest gain in log-likelihood from rescaling the signals, nats; beyond it the second-order expansion is invalid."""

Complex = NDArray[np.complex128]


class DetectorLikelihood:
    """log p(histograms | gain, offset, read noise).

    An observation is gain·Poisson((signal − offset)/gain) + offset + gain·read_noise·normal, rounded and clipped. The Fourier
    transform of its characteristic function gives the exact probability of every cell, for any Poisson mean, for cells as narrow
    as the rounding step, and for the cells at the clipping limits, which include all values beyond. The true signals within a
    level have a gamma distribution with the measured variance. The characteristic function of a residual includes the noise of
    the signal estimate, and treats rounding as independent uniform noise.

    The scaling of a long exposure to signals is uncertain. The likelihood is integrated over it, to second order around its
    estimate.

    Args:
        levels: from `collect_levels` and `collect_cells`.
    """

    def __init__(self, levels: Sequence[Levels]) -> None:
        self.levels = list(levels)
        self.parts = [LevelMasses(one) for one in levels]

    def __call__(self, gain: Image, offset: Image, read_noise: Image) -> NDArray[np.float64]:
        """Log-likelihood of each parameter set.

        Args:
            gain: (W,) counts per electron.
            offset: (W,) counts.
            read_noise: (W,) electrons rms.

        Returns:
            (W,) nats.
        """
        total, scales = self._sums(gain, offset, read_noise)
        for index, (gradient, information) in scales.items():
            information = information + self._prior(index)
            total += np.minimum(0.5 * np.einsum("wi,wi->w", gradient, _solve(information, gradient)), LARGEST_GAIN)
            total -= 0.5 * np.linalg.slogdet(information)[1]
        return total

    def rescaling(self, gain: float, offset: float, read_noise: float) -> dict[int, tuple[float, float]]:
        """Return the factor and shift of each scaling's signals that maximise the likelihood at one parameter set."""
        _, scales = self._sums(*(np.array([value]) for value in (gain, offset, read_noise)))
        change = {}
        for index, (gradient, information) in scales.items():
            scale = self._scale(index)
            step = _solve(information + self._prior(index), gradient)[0]
            if scale.common_offset:  # offset + (1 + step)·(signal − scaled offset)
                image = scale.intercept + scale.slope * offset
                change[index] = (1 + step[0], offset - (1 + step[0]) * image)
            else:
                change[index] = (1 + step[1], step[0] - step[1] * scale.centre)
        return change

    def _scale(self, index: int) -> Scale:
        return next(one.scales[index] for one in self.levels if index in one.scale)

    def _prior(self, index: int) -> Image:
        """Information matrix of a weak prior: slope within a factor of about two, intercept within the range of the signals."""
        if self._scale(index).common_offset:
            return np.eye(1)
        signal = np.concatenate([one.signal[one.scale == index] for one in self.levels])
        return np.diag([1 / max(float(np.ptp(signal)), 1.0) ** 2, 1.0])

    def _sums(self, gain: Image, offset: Image, read_noise: Image) -> tuple[Image, dict[int, tuple[Image, Image]]]:
        """Return the log-likelihood, and for each scaling the gradient (W, P) and information (W, P, P) in its parameters."""
        total = np.zeros(len(gain))
        scales: dict[int, tuple[Image, Image]] = {}
        for part in self.parts:
            value, score, information, design = part.terms(gain, offset, read_noise)
            total += value
            for index in sorted(set(part.levels.scale[part.levels.scale >= 0])):
                chosen = part.levels.scale == index
                basis = design(index)[:, chosen]  # (W, L, P)
                first = np.einsum("wl,wlp->wp", score[:, chosen], basis)
                second = np.einsum("wl,wlp,wlq->wpq", information[:, chosen], basis, basis)
                if index in scales:
                    first, second = first + scales[index][0], second + scales[index][1]
                scales[int(index)] = (first, second)
        return total, scales


def _solve(information: Image, gradient: Image) -> Image:
    return np.asarray(np.linalg.solve(information, gradient[..., None])[..., 0])


class LevelMasses:
    """Cell probabilities of one set of levels.

    Args:
        levels: histograms of residuals or of pixel values.
    """

    def __init__(self, levels: Levels) -> None:
        self.levels = levels
        self.num_cells = levels.histogram.shape[1]
        self._cells = np.arange(self.num_cells)
        self._counts = levels.weight[:, None] * levels.histogram
        self._low, self._high = (
            np.where(
                np.isfinite(rail), np.floor((np.where(np.isfinite(rail), rail, 0) - levels.origin) / levels.width), end
            )
            for rail, end in ((levels.low, -1.0), (levels.high, float(self.num_cells)))
        )
        if not levels.absolute:
            self._low[:], self._high[:] = -1, self.num_cells
        self._clipped = np.flatnonzero((self._low >= 0) | (self._high < self.num_cells))
        self._tracked = bool(np.any(levels.scale >= 0))
        self._most = 16 * self.num_cells if levels.absolute else self.num_cells // 2 + 1
        self._number = min(40, self._most)
        self._kept: tuple[Image, Complex] | None = None

    def terms(
        self, gain: Image, offset: Image, read_noise: Image
    ) -> tuple[Image, Image, Image, Callable[[int], Image]]:
        """Return the terms of the likelihood for W parameter sets.

        Returns:
            Log-likelihood (W,); its derivative with respect to the mean signal of each level, and the information on it, (W, L);
            and a function from the index of a scaling to the derivative of that mean by its parameters, (W, L, P).
        """
        transform, slope = self._transform(gain, offset, read_noise, self._tracked)
        mass = np.maximum(self._folded(transform), LEAST_SIZE)
        value = np.einsum("wlk,lk->w", np.log(mass), self._counts) - self._darkness(offset)
        if slope is None:
            none = np.zeros(mass.shape[:2])
            return value, none, none, lambda index: np.zeros((*none.shape, 1))
        ratio = self._folded(slope * transform) / mass
        score = np.einsum("wlk,lk->wl", ratio, self._counts)
        information = np.einsum("wlk,wlk,wlk->wl", ratio, ratio, mass) * self._counts.sum(axis=1)
        return value, score, information, lambda index: self._design(index, offset)

    def masses(self, gain: Image, offset: Image, read_noise: Image) -> Image:
        """Return the probability of each histogram cell, (W, L, cells)."""
        return self._folded(self._transform(gain, offset, read_noise, False)[0])

    def _transform(
        self, gain: Image, offset: Image, read_noise: Image, with_slope: bool
    ) -> tuple[Complex, Complex | None]:
        """Return the cell transforms at the significant frequencies, and their logarithmic derivative by the mean signals."""
        number = min(max(self._number, self._least_number(gain, read_noise)), self._most)
        while True:
            frequency, cell = self._frequencies(number)
            exponent, slope = self._exponent(frequency, gain, offset, read_noise, with_slope)
            if number == self._most or exponent.real[..., -1].max() < np.log(LEAST_SIZE):
                break
            number = min(2 * number, self._most)
        size = exponent.real.max(axis=(0, 1))
        self._number = int(np.flatnonzero(size > np.log(LEAST_SIZE))[-1] * 1.2) + 2
        return np.exp(exponent) * cell, slope

    def _least_number(self, gain: Image, read_noise: Image) -> int:
        """Number of frequencies that may contain single-electron peaks; 0 if read noise blurs them."""
        if not self.levels.absolute or read_noise.min() > np.sqrt(-2 * np.log(LEAST_SIZE)) / (2 * np.pi):
            return 0
        highest = np.sqrt(-2 * np.log(LEAST_SIZE)) / (gain * read_noise).min()
        return int(highest * self.levels.width.max() * self.num_cells / (2 * np.pi)) + 2

    def _frequencies(self, number: int) -> tuple[Image, Complex]:
        """Return the lowest frequencies of each level, radians per count, and the transforms of its cells, (L, F)."""
        if self._kept is None or self._kept[0].shape[1] < number:
            levels = self.levels
            turn = np.arange(2 * number) * 2 * np.pi / self.num_cells
            frequency = turn / levels.width[:, None]
            cell = np.sinc(turn / (2 * np.pi)) * np.exp(-1j * (0.5 * turn + frequency * levels.origin[:, None]))
            if not levels.absolute:  # rounding and dither
                cell = cell * np.sinc(frequency * levels.step[:, None] / (2 * np.pi)) ** 2
            self._kept = frequency, cell
        return self._kept[0][:, :number], self._kept[1][:, :number]

    def _folded(self, transform: Complex) -> Image:
        """Convert the transform at frequencies 0, 1, … to cell probabilities, with aliasing by the cells.

        Probability beyond a clipping limit is added to its cell.
        """
        number = self.num_cells
        if transform.shape[-1] > number // 2 + 1:
            periods = -(-transform.shape[-1] // number)
            padded = np.zeros((*transform.shape[:-1], periods * number), complex)
            padded[..., : transform.shape[-1]] = transform
            padded[..., 0] *= 0.5
            half = padded.reshape(*transform.shape[:-1], periods, number).sum(axis=-2)
            mirrored = np.conj(np.roll(half[..., ::-1], 1, axis=-1))
            transform = (half + mirrored)[..., : number // 2 + 1]
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

    def _moved(self, offset: Image) -> Image:
        """Return the (W, L) shift of the signals of a pair due to an offset common to both exposures, counts."""
        common = self.levels.common
        return np.where(common, (1 - self.levels.slope) * offset[:, None] - self.levels.intercept, 0.0)

    def _darkness(self, offset: Image) -> Image:
        """Return the (W,) penalty, nats, of an offset above the darkest signal: half the square of the excess in standard errors.

        Without it, such an offset would bend the variance line, as if dark pixels had only read noise.
        """
        lack = np.maximum(offset[:, None] - self.levels.darkest - self._moved(offset), 0.0) / self.levels.darkest_error
        return np.asarray(0.5 * np.sum(lack**2, axis=1))

    def _design(self, index: int, offset: Image) -> Image:
        levels = self.levels
        if levels.scales[index].common_offset:
            image = levels.intercept + levels.slope * offset[:, None]
            return np.asarray((levels.signal - image)[..., None])
        basis = np.stack([np.ones_like(levels.signal), levels.signal - levels.scales[index].centre], -1)
        return np.broadcast_to(basis, (len(offset), *basis.shape))

    def _exponent(
        self, t: Image, gain: Image, offset: Image, read_noise: Image, with_slope: bool
    ) -> tuple[Complex, Complex | None]:
        """Return the log characteristic function at (L, F) frequencies, (W, L, F), and its derivative by the mean signal."""
        levels = self.levels
        g, o, r = (np.asarray(value, float)[:, None] for value in (gain, offset, read_noise))
        lit = 1 - levels.dark
        moved = self._moved(offset)
        signal = levels.signal + moved
        own = levels.shot_share * g * np.maximum(signal - o, 0.0) + levels.read_share * (g * r) ** 2
        spread = levels.spread
        if levels.absolute:
            relative = own / levels.own
            signal = signal + levels.shift * relative
            spread = np.maximum(spread + levels.excess * own, 1e-3 * spread)
        electrons = (lit * np.maximum(signal - o, 0.0) / g)[..., None]
        spread = (lit * spread / g**2)[..., None]
        phase = g[..., None] * t
        read = -0.5 * phase**2 * (r**2)[..., None]
        if levels.absolute:
            exponent, slope = _gamma_mixed(np.exp(1j * phase) - 1, np.maximum(electrons, 1e-3), spread, with_slope)
            exponent = exponent + 1j * t * o[..., None] + read
            return exponent, None if slope is None else slope / g[..., None]
        cumulant = _shot(phase)
        share = levels.shot_share[:, None]
        if share.any():
            noise = np.divide(_shot(-phase * share), share, out=np.zeros_like(cumulant), where=share > 0)
            cumulant = cumulant + noise
        # The gamma distribution is approximated by a rational function that agrees to second order. A plain second-order
        # expansion would give probabilities above one if the spread is much larger than the mean, as for levels without
        # electrons.
        rate = np.maximum(electrons, 1e-9)
        exponent = rate * cumulant / (1 - 0.5 * spread / rate * cumulant)
        wide = np.flatnonzero(levels.spread * lit > 0.3 * levels.variance)  # only these need the exact form
        if wide.size:
            exponent[:, wide], _ = _gamma_mixed(cumulant[:, wide], electrons[:, wide], spread[:, wide], False)
        exponent = exponent + (1 + levels.read_share[:, None]) * read
        if self._tracked:
            exponent = exponent + 1j * t * moved[..., None]
        return exponent, np.broadcast_to(1j * t, exponent.shape) if with_slope else None


def _gamma_mixed(unit: Complex, rate: Image, variance: Image, with_slope: bool) -> tuple[Complex, Complex | None]:
    """Return log E exp(λ·unit) for gamma-distributed λ with mean `rate`, and its derivative by that mean."""
    scale = np.maximum(np.minimum(variance / np.maximum(rate, 1e-9), np.maximum(rate, 1.0)), 1e-7)
    logarithm: Complex = np.log1p(-scale * unit)
    slope = -2 * logarithm / scale - unit / (1 - scale * unit) if with_slope else None
    return np.asarray(-rate / scale * logarithm, complex), slope


def _shot(phase: Image) -> Complex:
    """Cumulant function of a centred Poisson variable of rate 1, exp(iφ) − 1 − iφ, without cancellation at small φ."""
    square = phase * phase
    result = np.empty(phase.shape, complex)
    half = np.sin(0.5 * phase)
    result.real = -2 * half * half
    result.imag = np.where(
        square < 1e-2, phase * square * (square / 120 * (1 - square / 42) - 1 / 6), np.sin(phase) - phase
    )
    return result
