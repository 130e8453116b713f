"""Likelihood of histograms of a Poisson-Gaussian detector, integrated over the scalings of the signals."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.detector.levels import Levels, Scale
from calibration.exposures.frames import Image
from noiseflow.distributions.electrons import spectrum
from noiseflow.distributions.electrons.spectrum import LEAST_SIZE, CellTransform, Complex


class DetectorLikelihood:
    """log p(histograms | gain, offset, read noise).

    The probabilities of cells are those of `CellTransform`; residuals include the noise of the signal estimate, and rounding as
    independent uniform noise. The scaling of a long exposure to signals is uncertain: the likelihood is integrated over it, to
    second order around its estimate, or around the most likely one if that is far away.
    """

    def __init__(self, levels: Sequence[Levels]) -> None:
        self.levels = list(levels)
        self._selected = {index for one in levels if one.absolute for index in one.scale}
        self._reaches = {int(index): self._reach(index) for one in levels for index in one.scale if index >= 0}
        self.parts = [LevelMasses(one, self._reaches) for one in levels]

    def __call__(
        self, gain: Image, offset: Image, read_noise: Image, *, largest: float = 5.0, most: int = 4
    ) -> NDArray[np.float64]:
        """Log-likelihood of each parameter set.

        Args:
            gain, offset, read_noise: (W,) counts per electron, counts, and electrons rms.
            largest: largest gain from rescaling the signals, nats: a step of three standard errors. Beyond it the second-order
                expansion is repeated around its own maximum, as where dark signals near the offset bend the likelihood.
            most: rounds of expansion.

        Returns:
            (W,) nats.
        """
        total = np.zeros(len(gain))
        steps: dict[int, Image] = {}
        far = np.ones(len(gain), bool)
        for number in range(most):
            moved = {index: step[far] for index, step in steps.items()}
            total[far], scales = self._sums(gain[far], offset[far], read_noise[far], moved)
            gained = np.zeros(np.count_nonzero(far))
            for index, (gradient, information) in scales.items():
                before = moved.get(index, np.zeros_like(gradient))  # in standard deviations of the prior
                gradient, information = gradient - before, information + np.eye(gradient.shape[1])
                step = np.linalg.solve(information, gradient[..., None])[..., 0]
                gained += 0.5 * np.sum(gradient * step, axis=1)
                total[far] -= 0.5 * (np.linalg.slogdet(information)[1] + np.sum(before**2, axis=1))
                step[:, 2:] = 0.0  # the error of a removed variance is small; far away, negative variances would follow
                steps.setdefault(index, np.zeros((len(gain), *step.shape[1:])))[far] = before + step
            # levels of pixel values were selected by signals of the first scaling; two parameters may follow a shift by rounding
            free = all(self._reaches[index] > 0 for index in steps.keys() & self._selected)
            beyond = (gained > largest) & (number < most - 1) & free
            total[far] += np.where(beyond, 0.0, np.minimum(gained, largest))
            far[far] = beyond
            if not far.any():
                break
        return total

    def rescaling(self, gain: float, offset: float, read_noise: float) -> dict[int, tuple[float, float]]:
        """Return the factor and shift of each scaling's signals that maximise the likelihood at one parameter set."""
        _, scales = self._sums(np.array([gain]), np.array([offset]), np.array([read_noise]), {})
        change = {}
        for index, (gradient, information) in scales.items():
            scale, step = self._scale(index), np.linalg.solve(information[0] + np.eye(gradient.shape[1]), gradient[0])
            if scale.common_offset:  # offset + (1 + step)·(signal − scaled offset)
                image = scale.intercept + scale.slope * offset
                change[index] = (1 + step[0], offset - (1 + step[0]) * image)
            else:
                change[index] = (1 + step[0], self._reaches[index] * step[1] - step[0] * scale.centre)
        return change

    def _scale(self, index: int) -> Scale:
        return next(one.scales[index] for one in self.levels if index in one.scale)

    def _reach(self, index: int) -> float:
        """Prior standard deviation of a shift of the signals, counts: the range of these; none of a common offset."""
        signal = np.concatenate([one.signal[one.scale == index] for one in self.levels])
        return 0.0 if self._scale(index).common_offset else max(float(np.ptp(signal)), 1.0)

    def _sums(
        self, gain: Image, offset: Image, read_noise: Image, moved: dict[int, Image]
    ) -> tuple[Image, dict[int, tuple[Image, Image]]]:
        """Return the log-likelihood, and for each scaling the gradient (W, P) and information (W, P, P) in its parameters, after
        steps `moved` from it, (W, P) each."""
        total = np.zeros(len(gain))
        scales: dict[int, tuple[Image, Image]] = {}
        for part in self.parts:
            value, score, information, design = part.terms(gain, offset, read_noise, moved)
            total += value
            for index in sorted(set(part.levels.scale[part.levels.scale >= 0])):
                chosen = part.levels.scale == index
                basis = design(index)[:, chosen]  # (W, L, D, P)
                first = np.einsum("wld,wldp->wp", score[:, chosen], basis)
                second = np.einsum("wld,wldp,wldq->wpq", information[:, chosen], basis, basis)
                if index in scales:
                    first, second = first + scales[index][0], second + scales[index][1]
                scales[int(index)] = (first, second)
        return total, scales


class LevelMasses:
    """Cell probabilities of one set of levels, in histograms of residuals or of pixel values."""

    def __init__(self, levels: Levels, reach: dict[int, float] | None = None) -> None:
        self.levels, self._reach = levels, reach or {}
        self._gains, self._unsure = levels.by_gains()
        self._removed = bool(self._unsure.any())
        self._counts = levels.weight[:, None] * levels.histogram
        unlimited = np.full_like(levels.low, np.inf)
        values = levels.absolute
        low, high = (levels.low, levels.high) if values else (-unlimited, unlimited)
        grid, dither = (levels.width, levels.origin, levels.histogram.shape[1]), levels.step * (not values)
        self._cells = CellTransform(*grid, low=low, high=high, dither=dither, sharp=values)
        self._tracked = bool(np.any(levels.scale >= 0))

    def terms(
        self, gain: Image, offset: Image, read_noise: Image, steps: dict[int, Image]
    ) -> tuple[Image, Image, Image, Callable[[int], Image]]:
        """Return the terms of the likelihood for W parameter sets, after steps of the scalings, (W, P) by their indices.

        Returns:
            Log-likelihood (W,); its derivative with respect to the mean signal of each level, and to the variance of its signals
            if some was removed, (W, L, D), and the information on them, which only skewness couples; and a function from the
            index of a scaling to their derivatives by its parameters, (W, L, D, P), in prior standard deviations.
        """
        moved = self._moved(offset)
        for index in steps.keys() & set(self.levels.scale.tolist()):
            own, step = self.levels.scale == index, steps[index]
            moved = moved + own * np.einsum("wlp,wp->wl", self._design(index, offset)[:, :, 0], step)
        transform, slope = self._transform(gain, offset, read_noise, moved, self._tracked)
        mass = np.maximum(self._cells.masses(transform), LEAST_SIZE)
        # an offset above the darkest signal costs half the square of the excess in standard errors; otherwise it would bend the
        # variance line, as if dark pixels had only read noise
        lack = np.maximum(offset[:, None] - self.levels.darkest - moved, 0.0) / self.levels.darkest_error
        value = np.einsum("wlk,lk->w", np.log(mass), self._counts) - 0.5 * np.sum(lack**2, axis=1)
        if slope is None:
            none = np.zeros((*mass.shape[:2], 1))
            return value, none, none, lambda index: none[..., None]
        changes = [slope, 0.5 * slope**2][: 1 + self._removed]
        ratio = np.stack([self._cells.masses(one * transform) / mass for one in changes], axis=2)
        score = np.einsum("wldk,lk->wld", ratio, self._counts)
        information = np.einsum("wldk,wldk,wlk->wld", ratio, ratio, mass) * self._counts.sum(axis=1)[:, None]
        return value, score, information, lambda index: self._design(index, offset)

    def masses(self, gain: Image, offset: Image, read_noise: Image) -> Image:
        """Return the probability of each histogram cell, (W, L, cells)."""
        return self._cells.masses(self._transform(gain, offset, read_noise, self._moved(offset), False)[0])

    def _transform(
        self, gain: Image, offset: Image, read_noise: Image, moved: Image, with_slope: bool
    ) -> tuple[Complex, Complex | None]:
        detector = {"gain": gain, "offset": offset, "read_noise": read_noise, "moved": moved}
        return self._cells.transform(partial(self._exponent, **detector, with_slope=with_slope), gain, read_noise)

    def _moved(self, offset: Image) -> Image:
        """Return the (W, L) shift of the signals of a pair due to an offset common to both exposures, counts."""
        slope, intercept = self.levels.scaling
        return np.where(self.levels.common, (1 - slope) * offset[:, None] - intercept, 0.0)

    def _design(self, index: int, offset: Image) -> Image:
        scale, signal = self.levels.scales[index], self.levels.signal
        zero = scale.intercept + scale.slope * offset[:, None] if scale.common_offset else scale.centre
        design = np.zeros((len(offset), len(signal), 1 + self._removed, 2 + self._removed))
        design[:, :, 0, 0], design[:, :, 0, 1] = signal - zero, self._reach[index]
        design[:, :, 1:, 2:] = self._unsure[:, None, None]
        return design

    def _exponent(
        self, t: Image, gain: Image, offset: Image, read_noise: Image, moved: Image, with_slope: bool
    ) -> tuple[Complex, Complex | None]:
        """Return the log characteristic function at (L, F) frequencies, (W, L, F), and its derivative by the mean signal."""
        levels = self.levels
        g, o, r = (np.asarray(value, float)[:, None] for value in (gain, offset, read_noise))
        signal = levels.signal + moved
        if levels.absolute:
            read = levels.read_share * (g * r) ** 2 + levels.rounded
            own = levels.shot_share * g * np.maximum(signal - o, 0.0) + read
            signal = signal + levels.shift * own / levels.own
        electrons = np.maximum(signal - o, 0.0) / g
        if levels.absolute:
            spread = np.maximum(levels.spread + levels.excess * own, 1e-3 * levels.spread) / g**2
            return spectrum.of_values(t, g, o, r, electrons, spread, slope=with_slope)
        units = np.stack([np.ones_like(g), 1 / g, 1 / g**2], -1)[:, None]
        shares = {"shot_share": levels.shot_share, "read_share": levels.read_share}
        exponent = spectrum.of_residuals(t, g, r, electrons, levels.parts * units, **shares)
        exponent -= 0.5 * self._gains[:, None] * t**2
        if self._tracked:
            exponent = exponent + 1j * t * moved[..., None]
        return exponent, np.broadcast_to(1j * t, exponent.shape) if with_slope else None


def misfit(
    levels: Sequence[Levels], parameters: Image, *, least: float = 10.0, merged: bool = False, sure: int = 200
) -> float:
    """Return χ² per degree of freedom of the histograms, in bins of at `least` so many expected pixel values; `merged` ones of
    four cells are even if codes are not. Fewer degrees than at which χ² is `sure` to 10 % are padded with perfectly fitting ones,
    to avoid false alarms with a few hundred pixels. The mean that residuals of a burst share takes less than one of each level.
    """
    squares, freedom = 0.0, -3
    for one, histogram, expected in expected_cells(levels, parameters):
        if one.absolute and merged:
            histogram, expected = (each.reshape(len(each), -1, 4).sum(-1) for each in (histogram, expected))
        for row, own_mean in enumerate(one.scale < 0):
            edges = _bins(expected[row], least)
            if len(edges) > 2:
                seen, known = (
                    np.diff(np.concatenate([[0], np.cumsum(values[row])])[edges]) for values in (histogram, expected)
                )
                squares += float(np.sum((seen - known) ** 2 / known))
                freedom += len(known) - 1 - int(own_mean)
    missing = max(sure - freedom, 0)
    return (squares + missing) / (freedom + missing)


def _bins(expected: Image, least: float) -> list[int]:
    """Return the edges of bins with at least `least` expected pixel values.

    The far tails, with less than one expected value in total, are excluded because they contain outliers.
    """
    below, above = np.cumsum(expected), np.cumsum(expected[::-1])[::-1]
    edges: list[int] = []
    held = 0.0
    for cell in np.flatnonzero((below >= 1) & (above >= 1)):
        edges = edges or [int(cell)]
        held += expected[cell]
        if held >= least:
            edges.append(int(cell) + 1)
            held = 0.0
    return edges


def expected_cells(levels: Sequence[Levels], parameters: Image) -> Iterator[tuple[Levels, Image, Image]]:
    """Yield each set of levels with its measured and expected histograms, (L, cells)."""
    gain, offset, read_noise = (np.array([value]) for value in parameters)
    for one in levels:
        number = one.histogram.sum(axis=1, keepdims=True)
        yield one, one.histogram, number * LevelMasses(one).masses(gain, offset, read_noise)[0]
