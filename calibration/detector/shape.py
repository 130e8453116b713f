"""Deviations from a Poisson-Gaussian detector: shape of the histograms, converter codes, differences between pixels."""

from collections.abc import Sequence

import numpy as np

from calibration.detector.levels import Levels
from calibration.detector.likelihood import expected_cells
from calibration.detector.log_posterior import UNRESOLVED
from calibration.detector.posterior import NINETY, Interval
from calibration.exposures.frames import Image, rounding_step
from calibration.exposures.scaling import VarianceLine, around, spread_by_level
from calibration.registration.aligned import AlignedPair
from calibration.tolerances import CLEAR, UNEVEN
from noiseflow.checks import SIGNIFICANT, Effect
from noiseflow.statistics import weighted_line


def excess_skew(levels: Sequence[Levels], parameters: Image, *, fewest: int = 4) -> Effect:
    """Third cumulant of the histograms beyond the expected one, over that of Poisson noise: 1 − 1/F² with an excess-noise factor.

    At each level of at least `fewest` cells, what number, mean and variance explain is removed, because the fit adjusts these,
    and so are outliers. 0 if the cumulant is smaller, as that of filtered noise is.
    """
    gain, offset, _ = parameters
    found = information = 0.0
    for one, histogram, expected in expected_cells(levels, parameters):
        poisson = gain**2 * np.maximum(one.signal - offset, 0.0) / one.width**3
        for seen, known, third in zip(histogram, expected, poisson, strict=True):
            if np.count_nonzero(known) < fewest:
                continue
            place = np.arange(len(known)) - np.average(np.arange(len(known)), weights=known)
            deviation = np.sqrt(np.average(place**2, weights=known))
            z, weight, more = (
                each[np.abs(place) < CLEAR * deviation] for each in (place / deviation, known, seen - known)
            )
            *powers, cube = np.vander(z, fewest, increasing=True).T
            removed, root = np.stack(powers), np.sqrt(np.maximum(weight, 0.0))  # sums of a series
            score = cube - np.linalg.lstsq((removed * root).T, cube * root, rcond=None)[0] @ removed
            score *= third / deviation**3 / 6  # of Gram and Charlier
            found, information = found + float(score @ more), information + float(weight @ score**2)
    return Effect(max(0.0, found / information), 1 / np.sqrt(information)) if information > 0 else Effect(0.0)


def uneven_codes(
    levels: Sequence[Levels], parameters: Image, *, least: float = 50.0, neighbours: int = 9, resolved: float = 2.0
) -> float:
    """Return the relative deviation (rms) of the converter's code widths from their neighbours; 0 if not significant.

    Differential nonlinearity, or integers rescaled and rounded again, favour the same codes at every level. Electrons two codes
    apart seem to do the same, and nothing in the pixel values tells one from the other.

    Args:
        least: smallest number of expected pixel values per code.
        neighbours: number of codes over which a distribution is nearly linear, so that deviations are due to the code widths.
        resolved: fewest codes per standard deviation of the noise, so that the distribution and its peaks are resolved.
    """
    seen: dict[int, list[float]] = {}
    gain, offset, read_noise = parameters
    step = levels[-1].step[0] or np.inf  # as of values that are not rounded
    if read_noise < UNRESOLVED[1] and round(gain / step, 1) == 2:  # without peaks, of the same variance
        parameters = np.array([gain, offset + gain * (2 - read_noise**2), read_noise := np.sqrt(2)])
    for one, histogram, expected in expected_cells(levels, parameters):
        fine = (one.width == one.step) & (one.step * resolved < gain * read_noise)
        for row in np.flatnonzero(fine) if one.absolute else ():
            first = round((one.origin[row] - one.origin[0]) / one.step[row])
            for cell in np.flatnonzero(expected[row] > 1):
                total = seen.setdefault(first + int(cell), [0.0, 0.0])
                total[0] += float(histogram[row, cell])
                total[1] += float(expected[row, cell])
    codes = sorted(code for code, (_, known) in seen.items() if known > least)
    if len(codes) < 4 * neighbours:
        return 0.0
    counted, expected_all = np.array([seen[code] for code in codes]).T
    ratio = counted / expected_all
    smooth = around(ratio, neighbours).mean(axis=1)
    departure, noise = ratio - smooth, (1 - 1 / neighbours) * smooth / expected_all
    excess = float(np.sum(departure**2 / np.maximum(noise, np.finfo(float).tiny))) - len(codes)  # codes left out: 0 / 0
    share = float(np.sum(departure**2 - noise)) / len(codes)
    return float(np.sqrt(share)) if excess > CLEAR * np.sqrt(2 * len(codes)) and share > 0 else 0.0


def unevenness(pairs: Sequence[AlignedPair], *, per_level: int = 5000) -> float:
    """Return the relative deviation (rms) of the pixels' variances at equal signal, in a burst.

    The squared differences of disjoint pairs of frames are correlated over the pixels only if some pixels are noisier than
    others. A second test gives more weight to dim pixels, where read noise is visible.

    Args:
        per_level: frame differences per level; they determine its variance to 2 %.

    Returns:
        The deviation; 0 for fewer than four frames, a drifting burst, or a result below `SIGNIFICANT` standard errors.
    """
    if len(pairs) < 4 or pairs[0].frames == 1 or _moved(pairs):
        return 0.0
    mask = np.logical_and.reduce([pair.mask for pair in pairs])
    frames = np.stack([(pair.short[mask] - pair.scaling.intercept) / pair.scaling.slope for pair in pairs])
    level = frames.mean(0)  # includes the pixels' own values: given it, Poisson counts have its variance on any scene
    squares = frames.var(axis=0, ddof=1)
    line = VarianceLine.fitted(level, squares)
    spread = np.sqrt(np.maximum(line(level), UNEVEN * squares.mean()))  # without light the line may cross zero
    differences = (frames[1::2] - frames[:-1:2]) / spread
    number = min(24, differences.size // per_level + 1)  # so that errors of the levels do not count as unevenness
    levels, step = np.tile(level, len(differences)), rounding_step(pairs[0].short)
    spread *= np.interp(level, *spread_by_level(levels, differences.ravel(), step=step, num_levels=number))
    products, power = _products(frames, spread)
    independent = (len(frames) - 1) * (len(frames) - 2) / 2  # products of orthogonal differences
    found = 0.0
    for weight in (np.ones_like(spread), (spread.min() / spread) ** 4):
        mean = float(np.average(products, weights=weight))
        error = power / np.sqrt(independent) * float(np.sqrt(np.sum(weight**2)) / weight.sum())  # of even pixels
        found = max(found, mean if mean > SIGNIFICANT * error else 0.0)
    return float(np.sqrt(found))


def _products(frames: Image, spread: Image, *, rounds: int = 12) -> tuple[Image, float]:
    """Return the (N,) mean products of two disjoint squared frame differences minus 1, and the variance of such a square (about
    2).

    The mean of the products is the squared unevenness. Twelve random pairings of the frames contain nearly all the information.
    """
    generator = np.random.default_rng(0)
    total, power = np.zeros(frames.shape[1]), 0.0
    for _ in range(rounds):
        order = generator.permutation(len(frames))
        even = order[: len(order) // 2 * 2]
        difference = (frames[even[::2]] - frames[even[1::2]]) / (np.sqrt(2) * spread)
        squares = np.clip(difference - difference.mean(axis=1, keepdims=True), -CLEAR, CLEAR) ** 2
        squares = squares / squares.mean(axis=1, keepdims=True) - 1
        number, power = len(squares), power + float(np.mean(squares**2)) / rounds
        total += (squares.sum(0) ** 2 - (squares**2).sum(0)) / (number * (number - 1))
    return total / rounds, power


def _moved(pairs: Sequence[AlignedPair]) -> bool:
    """Whether the frames were warped before the comparison: differences then involve different detector pixels."""
    others = (np.sum([pair.short for pair in pairs[1:]], axis=0)) / (len(pairs) - 1)
    first, mask = pairs[0], pairs[0].mask
    return bool(np.std((first.long - others)[mask]) > 0.05 * np.std((first.short - others)[mask]))


def excess_factor(
    points: list[tuple[float, float, float]], gain: float, gain_error: float, *, widest: float = 0.1, most: float = 1.9
) -> Interval | None:
    """Estimate F² from the third moment, for a gain register or deposited energy with a gamma distribution.

    With K = g·F², the third central moment grows by K²·(2 − 1/F²) per count: K² for Poisson noise, 1.5·K² for F² = 2.

    Args:
        points: mean, third central moment and its standard error at several levels, counts and counts³.
        gain: K, counts per electron, and its standard error `gain_error`.
        widest: largest standard error of the slope over K², with which 1 and 1.5 are five of them apart.
        most: largest slope over K²; at 2, F² is infinite.

    Returns:
        The 90 % interval; None if the moments do not determine it.
    """
    if len(points) < 2:
        return None
    mean, third, error = np.array(points).T
    line = weighted_line(mean, third, 1 / np.maximum(error, np.finfo(float).tiny) ** 2)
    ratio = line.slope / gain**2
    spread = float(np.hypot(line.slope_error / gain**2, 2 * ratio * gain_error / gain))
    if spread > widest:
        return None
    low, middle, high = (1 / (2 - np.clip(ratio + away * NINETY * spread, 1.0, most)) for away in (-1, 0, 1))
    return Interval(float(middle), float(low), float(high))


def third_moments(levels: Sequence[Levels]) -> list[tuple[float, float, float]]:
    """Return mean, third central moment and its standard error of the residuals at each level, without rounding.

    The noise of the signals, which is independent, has the opposite third moment, less by the square of its share.
    """
    found = []
    for one in levels:
        if one.absolute:  # selected by their own estimates
            continue
        place = one.width[:, None] * (np.arange(one.histogram.shape[1]) + 0.5)
        share = one.histogram / one.count[:, None]
        place = place - (share * place).sum(1, keepdims=True)
        second, third = ((share * place**power).sum(1, keepdims=True) for power in (2, 3))
        influence = place**3 - 3 * second * place - third
        error = np.sqrt((share * influence**2).sum(1) / (one.count * one.weight))
        kept = 1 - one.shot_share**2
        found += [*zip(one.signal.tolist(), (third[:, 0] / kept).tolist(), (error / kept).tolist(), strict=True)]
    return found
