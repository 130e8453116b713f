"""Correlation of residuals between pixels and frames, as caused by filters, interpolation, afterglow and shared noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.exposures.frames import Burst, Image
from calibration.exposures.masks import Mask
from calibration.exposures.scaling import alike_apart, around, eroded, finest_band, mean_and_error, separable, spaced
from calibration.registration.aligned import AlignedPair, Residual
from calibration.tolerances import CLEAR, LIKELY, MISALIGNED, MODELLED, PEAK
from noiseflow.described import described
from noiseflow.statistics import neighbour_products

REACH = 4
"""Largest distance between compared pixels; camera filters and resampling kernels are not longer."""

MOST_FRAMES = 24
"""Frames that are compared: 23 successive pairs with 256² pixels each determine a correlation well below 1 %."""

LAGS = [(dy, dx) for dy in range(REACH + 1) for dx in range(-REACH, REACH + 1) if (dy, dx) > (0, 0)]


@described()
@dataclass(frozen=True)
class Correlation:
    """Correlation of the residuals of neighbouring pixels, minus that caused by interpolation of the signal.

    Attributes:
        lags: (K, 2) distances (y, x), pixels.
        value, error: (K,) correlation coefficients, and their standard errors for independent pixels.
        factor: spectral density of the noise at frequency 0 over its variance; 1 for independent pixels. A mean-preserving
            linear filter preserves this density, so variance times `factor` is the variance before the filter.
        factor_error: standard error of `factor`.
        period: period of the variance or the correlation of the noise along x or y, pixels; 0 if there is none.
    """

    lags: Image
    value: Image
    error: Image
    factor: float
    factor_error: float
    period: float

    @property
    def local(self) -> bool:
        """Whether the correlation decays within `REACH`, as for a filter but not for interference."""
        outer = np.abs(self.value[np.abs(self.lags).max(axis=1) == REACH]).max()
        return bool(outer < max(0.1 * np.abs(self.value).max(), CLEAR * self.error.max()))

    @property
    def step(self) -> float:
        """Pixel spacing in pixels of the original frames, if the frames were resampled by linear interpolation; else 1.

        Interpolation is periodic with `period` pixels, so the spacing is 1 ± 1/period. The sign, and whether the interpolation is
        linear, follow from the correlation of neighbours. A spacing of about 1.5, where neighbours are almost uncorrelated,
        cannot be detected.
        """
        if self.period:
            for step in (1 + 1 / self.period, 1 - 1 / self.period):
                near = _overlap(step) / _overlap(0.0)
                expected = {(0, 1): near, (1, 0): near, (1, 1): near**2}
                alike = (abs(self.at(*lag) - value) < MODELLED for lag, value in expected.items())
                if near > 2 * MODELLED and all(alike):
                    return step
        return 1.0

    @property
    def inflation(self) -> float:
        """Factor by which correlation increases the standard error of a variance: root of the sum of squared correlations."""
        return float(np.sqrt(1 + 2 * np.sum(np.maximum(self.value**2 - self.error**2, 0.0))))

    @property
    def found(self) -> bool:
        """Whether the correlation at any lag, or of the nearest neighbours together, exceeds `CLEAR` standard errors."""
        return bool(np.any(_clear(self.value, self.error)))

    @property
    def filtered(self) -> bool:
        """Whether it is that of a short filter, whose `factor` is known well enough to correct for it."""
        return self.found and self.local and self.factor > 3 * self.factor_error

    def at(self, dy: int, dx: int) -> float:
        """Return the correlation at one lag."""
        return float(self.value[np.all(self.lags == (dy, dx), axis=1)][0])


def correlation_of(pairs: Sequence[AlignedPair]) -> Correlation:
    """Measure the correlation of the residuals of all pairs of one detector setting together."""
    residuals = [pair.residual for pair in pairs]
    expected = [_of_interpolation(pair, one.share) for one, pair in zip(residuals, pairs, strict=True)]
    return correlation_of_residuals(residuals, expected, burst=pairs[0].frames > 1)


def correlation_of_residuals(
    residuals: Sequence[Residual], expected: Sequence[Image] | None = None, *, burst: bool = False
) -> Correlation:
    """Measure the correlation of standardised residuals, one per frame, without the `expected` one of each, (K,), that is not due
    to the noise of the exposure. Those of one burst share a period."""
    products, counts = np.zeros(len(LAGS)), np.zeros(len(LAGS))
    for one, known in zip(residuals, expected or [np.zeros(len(LAGS))] * len(residuals), strict=True):
        for index, (dy, dx) in enumerate(LAGS):
            first, second = _shifted(dy, dx)
            frames = one.z.size // one.mask.size
            count = float(frames * np.count_nonzero(one.mask[first] & one.mask[second]))
            rows = np.einsum("...i,...i->...", one.z[..., *first], one.z[..., *second])  # without a copy
            products[index] += float(rows.sum()) - count * known[index]
            counts[index] += count
    value, error = products / np.maximum(counts, 1), 1 / np.sqrt(np.maximum(counts, 1))
    lags, clear = np.abs(LAGS), _clear(value, error)
    # clear lags, all shorter ones, and likely ones of the next, at which a Gaussian of 0.5 pixels hid 4 % of the gain
    shorter, near = (np.any(np.all(lags[:, None] <= lags[clear] + more, axis=-1), axis=1) for more in (0, 1))
    near = shorter | near & (np.abs(value) > LIKELY * error)
    factor, spread = 1 + 2 * float(value[near].sum()), 2 * float(np.sqrt(np.sum(error[near] ** 2)))
    period = _period(residuals) if burst else max(_period([one]) for one in residuals)
    return Correlation(np.array(LAGS), value, error, factor, spread, period)


def _overlap(distance: float) -> float:
    """Integral of the product of two kernels of linear interpolation at a distance, pixels of the frame that is interpolated."""
    far = max(2 - distance, 0.0) ** 3 / 6
    return far if distance >= 1 else far - 4 / 6 * (1 - distance) ** 3


def _clear(value: Image, error: Image) -> Mask:
    """Return the (K,) mask of significant lags; both nearest neighbours if only their sum is, as after a faint blur."""
    nearest = np.array([lag in ((0, 1), (1, 0)) for lag in LAGS])
    together = abs(float(value[nearest].sum())) > CLEAR * float(np.linalg.norm(error[nearest]))
    return np.asarray((np.abs(value) > CLEAR * error) | (nearest & together))


def _shifted(dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return slices of a frame and of the same frame shifted by (dy, dx), dy ≥ 0."""
    right = slice(max(dx, 0), None if dx >= 0 else dx)
    left = slice(max(-dx, 0), -dx if dx > 0 else None)
    return (slice(dy, None), right), (slice(0, -dy if dy else None), left)


def _of_interpolation(pair: AlignedPair, share: float) -> Image:
    """Return the (K,) correlation of residuals of which the warped long exposure has a share, and that of the pixels' gains."""
    images, part = [] if pair.white is None else [(1.0, pair.white)], sum(pair.gains[1:2])
    if pair.frames == 1 and (pair.kernel is not None or pair.registration.interpolates(pair.long.shape)):
        white, warped = pair.noise
        images = [(share - part * pair.kept / (1 + pair.kept), warped), *[(part, warped - white)] * (part > 0)]
    places = [_shifted(*lag) for lag in LAGS]
    found = [share / np.mean(z**2) * np.array([np.mean(z[a] * z[b]) for a, b in places]) for share, z in images]
    return np.asarray(np.sum(found, axis=0)) + np.zeros(len(LAGS))


def _period(residuals: Sequence[Residual], *, longest: float = 10.0, least: int = 64) -> float:
    """Return the period, pixels, of the squares or neighbour products of residuals along an axis; 0 if none.

    A period that the scene has too is ignored, and those longer than `longest` pixels: compression blocks have 8, and resampling
    by factors near 1, which has more, hardly changes the noise. Axes of fewer than `least` pixels show none.
    """
    found, first = [0.0], residuals[0]
    scene = np.zeros(first.mask.shape) if first.signal is None else np.where(first.mask, first.signal, 0.0)
    for turned, signal in ((False, scene), (True, scene.T)):
        # colours of a mosaic may cancel in two rows
        own = np.max([around(_lines(signal[row::2].mean(0)), 3).max(axis=1) for row in (0, 1)], axis=0)
        frames = [one.z.swapaxes(-1, -2) if turned else one.z for one in residuals]
        rows = tuple(range(frames[0].ndim - 1))
        for products in (np.square, neighbour_products):
            profile = np.mean([products(z).mean(rows) for z in frames], axis=0)
            if len(profile) < least:
                continue
            relative = _lines(profile)
            least_line = int(np.ceil(len(profile) / longest))
            seen = (relative[least_line:] > PEAK) & (own[least_line : len(relative)] < PEAK)
            if seen.any():
                found.append(len(profile) / (least_line + int(np.argmax(np.where(seen, relative[least_line:], 0.0)))))
    return max(found)


def _lines(profile: Image) -> Image:
    """Return the power spectrum of a profile, relative to the mean of its neighbourhood."""
    power = np.abs(np.fft.rfft((profile - profile.mean()) * np.hanning(len(profile)))) ** 2
    usual = np.median(around(power, min(31, len(power) // 2 | 1)), axis=1) / np.log(2)
    return np.asarray(power / np.maximum(usual, np.finfo(float).tiny))


def correlation_in_time(pairs: Sequence[AlignedPair]) -> tuple[float, float]:
    """Correlation of the noise of successive frames of a burst, minus that of more distant frames, and its standard error.

    Image lag, recursive filters and running means correlate successive frames. This reduces the variance of their differences,
    by twice the correlation if the next frame loses what the filter keeps of the previous one.
    """
    if pairs[0].frames == 1:
        return 0.0, 0.0
    chosen = pairs[:MOST_FRAMES]
    mask = np.logical_and.reduce([pair.mask for pair in chosen])
    z = np.stack([pair.residual.z[mask] for pair in chosen])
    # residuals from the mean of the others have a larger variance by 1/(1 − 1/n), and share the warped noise of these
    whites = [pair.white.ravel() / pair.white.std() for pair in chosen if pair.white is not None]
    found, expected = (_of_successive([np.sqrt(1 - 1 / len(pairs)) * one]) for one in (z, np.array(whites)))
    return found[0] - expected[0], float(np.hypot(found[1], expected[1]))


def correlation_of_flats(bursts: Sequence[Burst]) -> tuple[float, float]:
    """The same for frames without a scene, all levels together; 0 if every level has only two frames."""
    standardised = []
    for burst in bursts:
        residual = burst.frames[:MOST_FRAMES]
        for axis in (2, 1, 0):  # pixels of a row or column are not independent if it has an offset
            residual = residual - residual.mean(axis=axis, keepdims=True)
        residual = residual.reshape(len(residual), -1)
        deviation = float(residual.std()) * np.sqrt(len(residual) / (len(residual) - 1))
        standardised.append(np.clip(residual / max(deviation, np.finfo(float).tiny), -CLEAR, CLEAR))
    return _of_successive(standardised)


def _of_successive(bursts: Sequence[Image]) -> tuple[float, float]:
    """Mean product of successive frames minus that of distant frames, for (frame, pixel) residuals of unit variance."""
    excess = information = 0.0
    for z in bursts:
        if len(z) < 3 or not z.shape[1]:
            continue
        products = z @ z.T / z.shape[1]
        first, second = np.triu_indices(len(z), 1)
        near = second - first == 1
        weight = z.shape[1] / (1 / near.sum() + 1 / (~near).sum())
        excess += weight * float(products[first, second][near].mean() - products[first, second][~near].mean())
        information += weight
    return (excess / information, float(1 / np.sqrt(information))) if information else (0.0, 0.0)


def contained_share(
    pair: AlignedPair, *, least: float = 0.75, most: float = 0.9, white: float = 1.3, alike: float = 1.5
) -> float:
    """Share of the signal that is the short exposure itself, which a mean or sum of frames may include; 0 if not significant.

    The finest detail common to both exposures is then white, and includes all noise of the long one. Detail of a scene is not
    white because of the optics, and the long exposure has additional noise.

    Args:
        least: smallest share of the long exposure's finest noise in common with the short exposure: 1 if contained, else 0.
        most: largest share; above it the long exposure has hardly light of its own, and detail is finer than optics allow. At a
            smaller part of the agreement of signs that normal values have, single bright pixels (hot ones) are in common.
        white: largest ratio of the powers of two frequency bands of white noise; images have several times it along one axis.
        alike: largest ratio of equal shares in bright and dim pixels; that of fixed patterns to shot noise depends on the signal.
    """
    if pair.frames > 1 or pair.registration.interpolates(pair.long.shape, MISALIGNED):  # a contained frame fits
        return 0.0
    apart = alike_apart(pair.long)
    inner = eroded(pair.mask, 2 * apart)
    inner &= np.abs(pair.short - pair.signal) < CLEAR * np.std((pair.short - pair.signal)[pair.mask])
    if not inner.any():
        return 0.0
    short, signal = finest_band(pair.short, step=apart), finest_band(pair.signal, step=apart)
    middle = np.median(pair.signal[inner])
    shares = []
    for part in (inner, inner & (pair.signal > middle), inner & (pair.signal <= middle)):
        common, error = mean_and_error(short * signal, part)
        if not (common > CLEAR * error and common > least * float(np.mean(signal[part] ** 2))):
            return 0.0
        shares.append(common / float(np.mean(short[part] ** 2)))
    signs = np.sign(both := (short * signal)[inner])
    common, whole = float(np.mean(both)), np.sqrt(np.mean(short[inner] ** 2) * np.mean(signal[inner] ** 2))
    single = np.sum(signs) < most * np.count_nonzero(signs) * np.arcsin(common / whole) / (np.pi / 2)
    # the fourth difference along one axis removes smooth detail, too, and has unit gain for white noise
    one_axis, none = spaced(np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70), apart), np.ones(1)
    along = 0.5 * sum(
        float(np.mean((separable(pair.short, *kernels) * separable(pair.signal, *kernels))[inner]))
        for kernels in ((one_axis, none), (none, one_axis))
    )
    equal = max(shares[1], shares[2]) < alike * min(shares[1], shares[2]) and shares[0] < most
    return shares[0] if equal and not single and along < white * common else 0.0
