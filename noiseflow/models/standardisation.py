"""Data scaling stored in a model: a smooth signal coordinate, and approximate location and scale of the noise along it."""

import math
from functools import reduce
from typing import Any

import numpy as np
import scipy  # its packages load when they are first used
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.distributions.numerics.monotone_maps import between_rows

Array = NDArray[np.float64]
LEAST_PIXELS = 256
"""Pixels whose standard deviation has an error of 4 %."""
_NUM_KNOTS = 17
_START = 0.1  # of the root, so that its slope is finite
# Square roots to choose from (`python -m benchmarks.pages.weak_signals`). Where noise grows a hundredfold in the weakest 1 % of
# the signals, fits along one end 0.04 to 10 nats above the truth, along two 0.0003 to 0.011; where it grows like signals of six
# decades, 0.8, 0.1 and 0.002. Misfits along too few are 0.07 to 3 larger there; at most 0.0025 on other noises.
ROOTS, _WORSE = (1, 2, 3), 0.01


class Standardisation(nn.Module):
    """Maps signals to a coordinate in [0, 1] and residuals to unit scale, for any detector units.

    The coordinate grows like a root of the signal above its lowest value, because noise changes fastest at weak signals: the
    square root of shot noise, or roots of that root if most pixels are weak. Signals outside the range of the fit have the
    coordinate of the nearest end.

    Buffers:
        roots: number of square roots, 1 to 3.
        signal_low, signal_high: range of the signals of the fit, detector units.
        location, log_scale: (17,) residual location (detector units) and log of the residual scale, at equally spaced
            coordinates.
    """

    roots: Tensor
    signal_low: Tensor
    signal_high: Tensor
    location: Tensor
    log_scale: Tensor
    smooths = False
    """Whether location and scale are smoothed along the signal; `fit` does so for signals given as pixels. The scatter of the
    prediction of a signal model is its misfit: beads with outliers lost 0.9 dB."""
    keeps_roots = False
    """Whether `roots` stay: parameters that are interpolated need one coordinate."""
    straight = False
    """Whether the squared scale is a straight line of the signal."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("roots", torch.tensor(1.0))
        self._times = 1  # `roots`, without a wait for a GPU
        self.register_buffer("signal_low", torch.tensor(0.0))
        self.register_buffer("signal_high", torch.tensor(1.0))
        self.register_buffer("location", torch.zeros(_NUM_KNOTS))
        self.register_buffer("log_scale", torch.full((_NUM_KNOTS,), -2.3))

    @property
    def fitted_range(self) -> tuple[float, float]:
        """Smallest and largest signal of the fit, detector units."""
        return float(self.signal_low), float(self.signal_high)

    def coordinate(self, signal: Tensor) -> Tensor:
        """Coordinate in [0, 1] of each signal."""
        fraction = ((signal - self.signal_low) / (self.signal_high - self.signal_low)).clamp(0, 1)
        return root_coordinate(fraction, self._times)

    def forward(self, coordinate: Tensor) -> tuple[Tensor, Tensor]:
        """Residual location and log-scale at each coordinate."""
        return interpolate_linear(self.location, coordinate), interpolate_linear(self.log_scale, coordinate)

    @torch.no_grad()
    def set_from(
        self, signal: Tensor, observation: Tensor, span: tuple[float, float] | None = None, *, smooth: bool = True
    ) -> None:
        """Measure range, location and scale of (N,) signals and observations, robust to outliers and empty levels.

        Args:
            signal, observation: (N,), detector units.
            span: range of signals to cover; by default that of `signal`.
            smooth: smooth them if the instance `smooths`.

        Raises:
            ValueError: the residuals are constant, so that there is no noise to fit.
        """
        signal, residual = signal.double(), observation.double() - signal.double()
        spread = residual.std(correction=0)
        if not spread > 0:
            raise ValueError("observation − signal is constant: there is no noise to fit; check that the images differ")
        low, high = (signal.min(), signal.max()) if span is None else (signal.new_tensor(end) for end in span)
        if high <= low:  # one signal level: give the coordinate a finite width
            low, high = low - spread, high + spread
        self.signal_low.copy_(low)
        self.signal_high.copy_(high)
        fraction = ((signal - low) / (high - low)).clamp(0, 1)
        least = torch.finfo(torch.float).eps if self.smooths else 1e-3  # a signal model may follow its pixels
        if not self.keeps_roots:
            tried = misfits(fraction, residual, least * float(spread))
            most = 2 * min(tried) + _WORSE  # twice is chance where pixels are few
            self._times = next(times for times, each in zip(ROOTS, tried, strict=True) if each <= most)
            self.roots.fill_(self._times)
        level = (root_coordinate(fraction, self._times) * (_NUM_KNOTS - 1)).round().long()
        place, location, log_scale, count = _moments_by_level(level, residual, least * float(spread))
        if self.smooths and smooth:
            location = _smoothed(place, location, np.sqrt(count) / np.exp(log_scale))
            log_scale = _smoothed(place, log_scale, np.sqrt(count), _NUM_KNOTS)
        for table, values in ((self.location, location), (self.log_scale, log_scale)):
            table.copy_(torch.from_numpy(np.interp(np.arange(_NUM_KNOTS), place, values)))
        if self.straight:
            self.log_scale.copy_(torch.from_numpy(_straight(place, np.exp(2 * log_scale), count, self._times)))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        self._times = int(state_dict.get(prefix + "roots", self.roots))
        if self._times not in ROOTS:
            raise ValueError(f"{prefix}roots is {self._times}; it is {' or '.join(map(str, ROOTS))}")
        super()._load_from_state_dict(state_dict, prefix, *others)


def root_coordinate(fraction: Tensor, times: int) -> Tensor:
    """So many square roots of the fraction, but with a finite slope at 0; maps [0, 1] onto itself."""
    shift = float((1 / _START) ** -(2**times))
    root, end = fraction + shift, 1 + shift
    for _ in range(times):
        root, end = torch.sqrt(root), math.sqrt(end)
    return (root - _START) / (end - _START)


def misfits(fraction: Tensor, residual: Tensor, least: float, *, groups: int = 64, size: int = 512) -> list[float]:
    """Mean squared misfit of straight lines between knots along each of `ROOTS` to the log-widths, of at least `least`, of the
    noise in `groups` of up to `size` pixels: (N,) signals in [0, 1] and residuals."""
    some = slice(None, None, max(1, fraction.numel() // (groups * size)))
    signals, residuals = (each[some].cpu().numpy() for each in (fraction, residual))
    groups = min(groups, len(signals))
    # groups of equal size, for which a few pixels are in none
    even = np.linspace(0, len(signals) - 1, len(signals) // groups * groups).round().astype(int)
    order = np.argsort(signals, kind="stable")[even].reshape(groups, -1)
    width = np.log(np.maximum(_moments(residuals[order])[1], least))
    middle, found = torch.from_numpy(signals[order].mean(-1)), []
    for times in ROOTS:
        place = root_coordinate(middle, times).numpy()[:, None] * (_NUM_KNOTS - 1)
        hats = np.maximum(1 - abs(place - np.arange(_NUM_KNOTS)), 0)
        knots, _, rank, _ = np.linalg.lstsq(hats, width)
        found.append(float(np.sum((width - hats @ knots) ** 2)) / max(1, len(width) - int(rank)))
    return found


def _moments_by_level(level: Tensor, residual: Tensor, smallest: float, *, least: int = 32) -> tuple[Array, ...]:
    """Neighbouring knots together that have enough pixels: their mean places, medians, logs of robust scales of at least
    `smallest`, and numbers of pixels."""
    levels, residuals, ends = level.cpu().numpy().astype(np.uint8), residual.cpu().numpy(), [0]
    for end in np.cumsum(np.bincount(levels)):
        if end - ends[-1] >= least:
            ends.append(end)
    rows = []
    for chosen in np.split(np.argsort(levels, kind="stable"), ends[1:-1]):
        middle, spread = _moments(residuals[chosen[:: max(1, len(chosen) // 100_000)]])
        rows.append((levels[chosen].mean(), middle, np.log(np.maximum(spread, smallest)), len(chosen)))
    return tuple(np.array(rows, dtype=float).T)


def _moments(values: Array) -> tuple[Array, Array]:
    """Median and a robust standard deviation of (..., N) values. (torch.quantile sorts, which takes four times as long.)"""
    low, middle, high = np.quantile(values, (0.1587, 0.5, 0.8413), axis=-1)
    return middle, np.maximum((high - low) / 2, values.std(-1) / 4)


def _smoothed(place: Array, value: Array, weight: Array, most: int = 3, *, cost: int = 4) -> Array:
    """The polynomial of at most so many coefficients through (K,) values, with the reciprocals of their errors, of which each
    saves the square of two errors. Networks undo what is too smooth, but not scatter, nor a median that jumps between peaks: 16
    noises after 500 pixels lose 0.022 nats per pixel, 0.038 without; a cost of 2 or 8 is worse."""
    fits = [np.polynomial.Polynomial.fit(place, value, n, w=weight)(place) for n in range(min(most, len(place)))]
    costs = [float(np.sum((weight * (value - smooth)) ** 2)) + cost * degree for degree, smooth in enumerate(fits)]
    return fits[int(np.argmin(costs))]


def _straight(place: Array, squares: Array, count: Array, times: int) -> Array:
    """Logs of the scales of all knots whose squares are the most likely straight line through (K,) `squares`."""
    shift = (1 / _START) ** -(2**times)
    fraction = np.linspace(_START, (1 + shift) ** 0.5**times, _NUM_KNOTS) ** 2**times - shift
    basis, line = np.stack([1 - fraction, fraction]), np.full(len(place), np.average(squares, weights=count))
    at = np.stack([np.interp(place, range(_NUM_KNOTS), each) for each in basis])
    for _ in range(_NUM_KNOTS):  # likelihood of Gaussian residuals by reweighted least squares
        sharp = np.sqrt(count) / line
        ends = scipy.optimize.nnls((at * sharp).T, squares * sharp)[0]
        line = np.maximum(ends @ at, squares.min())
    return np.asarray(0.5 * np.log(np.maximum(ends @ basis, squares.min())))


def between_nodes(coordinate: Tensor, dtype: torch.dtype, count: int) -> tuple[Tensor, Tensor]:
    """Index of the node below each coordinate in [0, 1], of `count` equally spaced nodes, and the weight of the node above."""
    position = coordinate * (count - 1)
    row = torch.nan_to_num(position.detach()).floor().clamp(0, count - 2).long()
    return row, (position - row).to(dtype)


def interpolate_linear(table: Tensor, coordinate: Tensor) -> Tensor:
    """Interpolate a (K,) table of equally spaced values linearly at coordinates in [0, 1]."""
    return between_rows(table, *between_nodes(coordinate, coordinate.dtype, table.shape[0]))


def _taken(table: Tensor, index: Tensor) -> Tensor:
    """``table[index]``, also for scalars under ``torch.func.vmap``, which does not support that indexing."""
    return table.index_select(0, index.reshape(-1)).reshape(index.shape)


def interpolate_cubic(table: Tensor, coordinate: Tensor) -> Tensor:
    """Interpolate a (K,) table of equally spaced values by local cubics (four points) at coordinates in [0, 1]."""
    first, weights = lagrange_weights(coordinate * (table.shape[0] - 1), table.shape[0])
    return sum((weight * _taken(table, first + k) for k, weight in enumerate(weights)), torch.zeros_like(coordinate))


def lagrange_weights(place: Tensor, count: int, points: int = 4) -> tuple[Tensor, list[Tensor]]:
    """First of some neighbouring nodes, numbered from 0 to `count` − 1, of each place, and their Lagrange weights. Four points
    are a cubic, whose curvature is off by the square of the spacing; of six points, by its fourth power."""
    place = place.clamp(0, count - 1)
    first = (torch.nan_to_num(place.detach()).floor().long() - points // 2 + 1).clamp(0, count - points)
    apart = [place - first - node for node in range(points)]
    scales = [1 / math.prod([node - other for other in range(points) if other != node]) for node in range(points)]
    return first, [reduce(torch.mul, apart[:i] + apart[i + 1 :]) * scale for i, scale in enumerate(scales)]
