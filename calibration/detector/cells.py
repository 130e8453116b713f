"""Histograms of the pixel values themselves, at signal levels chosen by noisy estimates: what residuals blur stays visible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.detector.levels import REACH, Levels, Readings, constants, gathered, with_darkest
from calibration.detector.photon_transfer import NotMeasurable
from calibration.exposures.frames import Image

LEVEL_WIDTH = 0.8
"""Standard deviations of the noise that a level of unaltered pixel values spans."""

LEAST_READINGS = 100
"""Pixel values that such a level needs."""

MOST_CELLS = 512
"""Cells of such a level's histogram."""


def collect_cells(readings: Sequence[Readings], *, guess: tuple[float, float, float]) -> Levels:
    """Sort pixel values by their own estimated signal and count them as they are, on the converter's own codes.

    That keeps what a residual blurs: rounding, clipping and the peaks of single electrons. Choosing pixels by an estimate
    that is noisy itself makes the true signals regress towards where signals are common; `true_moments` says how far.

    Args:
        readings: of exposure pairs, each with its scale.
        guess: gain, offset and read noise, to lay out the levels and to find the regression.

    Raises:
        NotMeasurable: no level has `LEAST_READINGS`.
    """
    rows = [row for one in readings for row in _cell_levels(one, *guess)]
    if not rows:
        raise NotMeasurable(
            "too few pixels of each brightness are left to compare; give larger frames, or more of them below saturation"
        )
    cells = max(len(row["histogram"]) for row in rows)
    for row in rows:
        row["histogram"] = np.pad(row["histogram"], (0, cells - len(row["histogram"])))
    return gathered(rows, readings, absolute=True)


def _cell_levels(one: Readings, gain: float, offset: float, read_noise: float) -> list[dict[str, Any]]:
    signal = one.signal
    low, high, beyond = np.percentile(signal, (0.05, 99.8, 99.99))
    grid = np.linspace(low, beyond, 1500)
    shot, read = gain * np.maximum(grid - offset, 0.0), (gain * read_noise) ** 2
    deviation = np.sqrt(np.maximum(shot + read + one.step**2 / 12, 0.05 * gain**2))
    steps = np.concatenate([[0.0], np.cumsum(np.diff(grid) * 0.5 * (1 / deviation[1:] + 1 / deviation[:-1]))])
    last = float(np.interp(high, grid, steps))
    number = int(np.clip(np.ceil(last / LEVEL_WIDTH), 8, 40))
    edges = np.interp(np.linspace(0, last, number + 1), steps, grid)
    own = one.shot_share * shot + one.read_share * read
    blur = np.maximum(np.sqrt(own) / 4, grid[1] - grid[0])
    density = _density(signal, grid, blur)
    moments = true_moments(grid - offset, density, one.shot_share * gain, one.read_share * read)
    index = np.searchsorted(edges, signal) - 1
    place = np.searchsorted(edges, grid, side="right") - 1
    rows = []
    for level in range(number):
        group, cells = np.flatnonzero(index == level), place == level
        if len(group) < LEAST_READINGS or cells.sum() < 3:
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
    """Density of noisy estimates, times 1, the mean and the mean square of the true values behind each.

    An estimate is a Poisson count of true/unit in that unit, plus Gaussian noise. Robbins' and Tweedie's formulas
    (doi:10.1198/jasa.2011.tm11181) know the true values' moments from the density of the estimates alone.

    Args:
        estimate: (N,) evenly spaced, above the offset.
        density: (N,) of the estimates.
        unit: counts of the estimate per electron of its own exposure; 0: no Poisson noise.
        variance: of the Gaussian noise.
    """

    def times_truth(values: Image) -> Image:
        gaussian = estimate * values + variance * np.gradient(values, estimate)
        return np.asarray(np.interp(estimate + unit, estimate, gaussian, right=0.0))

    first = times_truth(density)
    return density, first, times_truth(first)


def _cells(one: Readings, group: NDArray[np.int64], deviation: float, finest: float) -> dict[str, Any]:
    """Histogram of the pixel values of one level on whole steps, wide enough for what noise may do."""
    observation, signal = one.observation[group], one.signal[group]
    span = 2 * REACH * deviation
    width = max(min(deviation / 6, finest), span / MOST_CELLS)
    if one.step:
        width = one.step * max(1.0, np.ceil(width / one.step - 0.5))
    cells = max(32, 2 ** int(np.ceil(np.log2(span / width))))
    origin = float(signal.mean()) - 0.45 * cells * width
    if one.step:
        origin = one.step * (np.round(origin / one.step) - 0.5)
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
    """Pixel values per count at some places, by a Gaussian kernel."""
    count, edges = np.histogram(values, bins=4000)
    centre = 0.5 * (edges[1:] + edges[:-1])
    distance = (centre - at[:, None]) / blur[:, None]
    return np.asarray(np.exp(-0.5 * distance**2) @ count / (blur * np.sqrt(2 * np.pi)))
