"""Histograms of pixel values at signals selected by noisy estimates: details that residuals blur, and single-electron peaks."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.detector.levels import Levels, Readings, constants, gathered, with_darkest
from calibration.detector.photon_transfer import NotMeasurable
from calibration.exposures.frames import Image
from calibration.tolerances import CERTAIN, CLIPPED, PEAK


def collect_cells(readings: Sequence[Readings], *, guess: tuple[float, float, float]) -> Levels:
    """Sort pixel values by their estimated signal and compute histograms on the converter's codes.

    These histograms keep what residuals blur: rounding, clipping and single-electron peaks. Selection by a noisy estimate causes
    regression of the true signals towards more frequent signals, which `true_moments` quantifies, for a `guess` of gain, offset
    and read noise that defines the levels, too.

    Raises:
        NotMeasurable: no level has enough pixel values.
    """
    rows = [row for one in readings for row in _cell_levels(one, *guess)]
    if not rows:
        raise NotMeasurable("too few pixels of each brightness are left to compare; use larger or unsaturated frames")
    cells = max(len(row["histogram"]) for row in rows)
    for row in rows:
        row["histogram"] = np.pad(row["histogram"], (0, cells - len(row["histogram"])))
    return gathered(rows, readings, absolute=True)


def _cell_levels(
    one: Readings, gain: float, offset: float, read_noise: float, *, width: float = 0.8, least: int = 100
) -> list[dict[str, Any]]:
    """Levels of at least so many pixel values, `width` standard deviations of the noise wide."""
    signal = one.signal
    low, high, beyond = np.percentile(signal, (0.05, 99.8, 99.99))
    grid = np.linspace(low, beyond, 1500)
    shot, read = gain * np.maximum(grid - offset, 0.0), (gain * read_noise) ** 2
    deviation = np.sqrt(np.maximum(shot + read + one.step**2 / 12, 0.05 * gain**2))
    steps = np.concatenate([[0.0], np.cumsum(np.diff(grid) * 0.5 * (1 / deviation[1:] + 1 / deviation[:-1]))])
    last = float(np.interp(high, grid, steps))
    number = int(np.clip(np.ceil(last / width), 8, 40))
    edges = np.interp(np.linspace(0, last, number + 1), steps, grid)
    normal = one.read_share * read + one.rounded
    own = one.shot_share * shot + normal
    blur = np.maximum(np.sqrt(own) / 4, grid[1] - grid[0])
    density = _density(signal, grid, blur)
    moments = true_moments(grid - offset, density, one.shot_share * gain, normal)
    index = np.searchsorted(edges, signal) - 1
    place = np.searchsorted(edges, grid, side="right") - 1
    rows = []
    for level in range(number):
        group, cells = np.flatnonzero(index == level), place == level
        if len(group) < least or cells.sum() < 3:
            continue
        row = _cells(one, group, float(np.interp(signal[group].mean(), grid, deviation)), float(deviation.min()) / 5)
        noise = float(np.average(own[cells], weights=density[cells]))
        if noise > 0:
            mass, first, second = (float(moment[cells].sum()) for moment in moments)
            mean = float(np.average(grid[cells], weights=density[cells]))
            about = float(np.average((grid[cells] - mean) ** 2, weights=density[cells]))
            excess = (second / mass - (first / mass) ** 2 - about) / noise
            row |= {"own": noise, "shift": first / mass + offset - mean, "excess": excess}
        rows.append(row)
    return with_darkest(rows, one)


def true_moments(estimate: Image, density: Image, unit: float, variance: float) -> tuple[Image, Image, Image]:
    """Return the density of noisy estimates times 1, the mean and the mean square of the true values given the estimate.

    An estimate is a Poisson count of mean true/unit, times unit, plus Gaussian noise. Robbins' and Tweedie's formulas
    (doi:10.1198/jasa.2011.tm11181) give the moments of the true values from the density of the estimates alone.

    Args:
        estimate: (N,) evenly spaced values above the offset, counts.
        density: (N,) density of the estimates.
        unit: counts of the estimate per electron of the long exposure; 0 without Poisson noise.
        variance: variance of the Gaussian noise, counts².
    """

    def times_truth(values: Image) -> Image:
        gaussian = estimate * values + variance * np.gradient(values, estimate)
        return np.asarray(np.interp(estimate + unit, estimate, gaussian, right=0.0))

    first = times_truth(density)
    return density, first, times_truth(first)


def _cells(
    one: Readings, group: NDArray[np.int64], deviation: float, finest: float, *, most: int = 512
) -> dict[str, Any]:
    """Histogram of the pixel values of one level on whole rounding steps, wide enough to include the noise."""
    observation, signal = one.observation[group], one.signal[group]
    span = 2 * CERTAIN * deviation
    width = max(min(deviation / 6, finest), span / most)
    if one.step:
        width = one.step * max(1.0, np.ceil(width / one.step - 0.5))
    cells = max(32, 2 ** int(np.ceil(np.log2(span / width))))
    origin = float(signal.mean()) - 0.45 * cells * width
    if one.step:
        origin = observation[0] + one.step * (np.round((origin - observation[0]) / one.step) - 0.5)
    index = np.floor((observation - origin) / width)
    inside = (index >= 0) & (index < cells)
    return {
        "signal": float(signal.mean()),
        "spread": float(np.var(signal)),
        "variance": float(np.var((observation - signal)[inside])),
        "count": float(inside.sum()),
        "width": width,
        "origin": origin,
        "histogram": np.bincount(index[inside].astype(int), minlength=cells).astype(float),
    } | constants(one)


def _density(values: Image, at: Image, blur: Image) -> Image:
    """Kernel density estimate, in pixel values per count, at the increasing values `at` with bandwidths `blur`."""
    count, edges = np.histogram(values, bins=4000)
    centre, found = 0.5 * (edges[1:] + edges[:-1]), np.empty_like(at)
    for part in np.array_split(np.arange(len(at)), 32):  # of which each sees its neighbourhood only
        reach = CERTAIN * blur[part].max()
        near = slice(*np.searchsorted(centre, (at[part[0]] - reach, at[part[-1]] + reach)))
        found[part] = np.exp(-0.5 * ((centre[near] - at[part, None]) / blur[part, None]) ** 2) @ count[near]
    return np.asarray(found / (blur * np.sqrt(2 * np.pi)))


def electrons_show(levels: Sequence[Levels], gain: float) -> bool:
    """Test whether histograms of pixel values have peaks one `gain` apart, as for a read noise below about 0.4 e⁻ rms.

    Their power is N·|mean of exp(2πi·value/gain)|²; a search tries a few hundred gains. Histograms of residuals are ignored,
    because the noise of the signals blurs the peaks, and levels with clipped values, whose peak at the limit has power at every
    distance. Below two rounding steps, peaks cannot be distinguished from codes.
    """
    total, count = 0j, 0.0
    for one in levels:
        fine = one.absolute & (np.maximum(one.width, one.step) < gain / 2) & (one.clipped() < CLIPPED)
        place = one.origin[fine, None] + one.width[fine, None] * (np.arange(one.histogram.shape[1]) + 0.5)
        total += complex(np.sum(one.histogram[fine] * np.exp(2j * np.pi * place / gain)))
        count += float(one.histogram[fine].sum())
    return count > 0 and abs(total) ** 2 / count > PEAK
