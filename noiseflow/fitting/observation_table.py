"""The tabulated likelihood of a joint fit: observations stay fixed while their signals change."""

import copy
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from noiseflow.distributions.numerics.elementwise import LONG
from noiseflow.distributions.numerics.tables import SIZES, TOLERANCE, RootScale, coarse_signals, variance_along
from noiseflow.fitting.steps import snapshot
from noiseflow.models.digitisation import MOST_CODES
from noiseflow.models.wrapper import as_noise_model
from noiseflow.statistics import SAMPLE


class ObservationTable:
    """log p(o | s) and its derivative with respect to the signal, for pixels with fixed observations and changing signals.

    Rows are signals. If the observations have few levels (integer counts, 8-bit data), columns are the levels: there is no
    interpolation along them, and the table is small. Otherwise, or if such a table is not accurate enough, columns are
    residuals, because the likelihood changes fast along the residual and slowly along the signal. Beyond the rows the
    log-likelihood continues linearly, so that signals out of range still have a gradient towards it.

    Args:
        noise_model: the model to tabulate; call `rebuild` after it changes.
        observation: (N,) pixel values.
        signal_low, signal_high: expected range of the signals.
        tolerance: accepted mean absolute interpolation error, nats per pixel.
        resume: the result of `state`, to build the table with the same rows and columns.

    Attributes:
        error: the last measured error, nats per pixel.
    """

    def __init__(
        self,
        noise_model: nn.Module,
        observation: Tensor,
        signal_low: float,
        signal_high: float,
        *,
        tolerance: float = TOLERANCE,
        resume: dict[str, Any] | None = None,
    ) -> None:
        if resume is not None:
            signal_low, signal_high = resume["low"], resume["high"]
        self.low, self.high = signal_low, max(signal_high, signal_low + 1e-6 * (1 + abs(signal_low)))
        self._observation, self._tolerance, self._size = observation, tolerance, 0
        self.error = math.inf
        if resume is None:
            self._refine(noise_model)
            return
        present, self._size = snapshot(noise_model), resume["size"]
        noise_model.load_state_dict(resume["laid_out_for"])
        self._build(noise_model, self._size)
        noise_model.load_state_dict(present)
        self.rebuild(noise_model)
        self.error = self.measure_error(noise_model)

    def state(self) -> dict[str, Any]:
        """Layout of the table: its size, the range of signals, and the model it was made for."""
        return {"low": self.low, "high": self.high, "size": self._size, "laid_out_for": self._laid_out_for}

    @property
    def _num_sizes(self) -> int:
        """Number of table sizes to try: first with observation levels as columns, if they are few, then with residuals."""
        return len(SIZES) if self._levels is None else 2 * len(SIZES)

    @cached_property
    def _levels(self) -> Tensor | None:
        """All levels of the observations if they are few, otherwise None."""
        some = torch.unique(self._observation[:: max(1, self._observation.numel() // SAMPLE)])
        return torch.unique(self._observation) if some.numel() <= MOST_CODES else None

    def _refine(self, noise_model: nn.Module, *, worthwhile: float = 0.7) -> None:
        """Choose the first size, from the present one on, that is accurate enough, or otherwise the most accurate one. Finer
        sizes of a kind are skipped if the error is not a `worthwhile` part of that of the size before."""
        errors: dict[int, float] = {}
        size = self._size
        while size < self._num_sizes:
            errors[size] = self.error = self._build(noise_model, size)
            self._size = size
            if self.error <= self._tolerance:
                return
            stalled = size % len(SIZES) > 0 and self.error > worthwhile * errors.get(size - 1, math.inf)
            size = (size // len(SIZES) + 1) * len(SIZES) if stalled else size + 1
        best = min(errors, key=lambda size: errors[size])
        if best != self._size:
            self._size = best
            self.error = self._build(noise_model, best)

    def cover(
        self, noise_model: nn.Module, signal: Tensor, *, few: float = 1e-3, margins: Sequence[float] = (0.01, 0.2)
    ) -> None:
        """Rebuild the rows for a wider range, with margins at both ends, if more than a few signals have left it. Beyond the rows
        the likelihood has no curvature, and signals of clipped observations would be unconstrained."""
        stray = int(few * signal.numel())
        if max(int((signal < self.low).sum()), int((signal > self.high).sum())) <= stray:
            return
        low, high = (float(signal.kthvalue(rank)[0]) for rank in (1 + stray, signal.numel() - stray))
        if not math.isfinite(low + high):
            return
        span = max(self.high - self.low, high - low)
        # a wide margin at the low end would reduce the resolution for weak signals, which have the narrowest noise
        self.low = 2 * low - self.low - margins[0] * span if low < self.low else self.low
        self.high = high + margins[1] * span if high > self.high else self.high
        self._refine(noise_model)

    def check(self, noise_model: nn.Module) -> float:
        """Measure the error again, and refine the table if it is no longer accurate."""
        self.error = self.measure_error(noise_model)
        if self.error > self._tolerance and self._size + 1 < self._num_sizes:
            self._refine(noise_model)
        return self.error

    def _build(self, noise_model: nn.Module, size: int) -> float:
        num_rows, num_columns = SIZES[size % len(SIZES)]
        levels = self._levels if size < len(SIZES) else None
        self._laid_out_for = snapshot(noise_model)
        self.low = self._lowest_possible(noise_model)
        self._scale = RootScale.of(noise_model, self.low, self.high, self._observation)
        roots = torch.linspace(*self._scale.ends, num_rows, dtype=torch.float64)
        self._signals = self._scale.inverse(roots).to(self._observation)[:, None]
        self._step, self._bounds = 0.0, list[Tensor]()
        if levels is None:
            self._lay_out_residuals(noise_model, num_columns)
        else:
            last = max(levels.numel() - 1, 1)
            self._offset = 2 * torch.searchsorted(levels, self._observation).to(self._observation.dtype) / last - 1
            self._rate, self._values = torch.zeros_like(self._offset), levels[None, :].expand(num_rows, -1)
        self.rebuild(noise_model)
        return self.measure_error(noise_model)

    def _lay_out_residuals(self, noise_model: nn.Module, count: int) -> None:
        """Columns of equally spaced residuals on the scale, and one at each end for observations on a clipping limit.

        In texture coordinates the column of an observation is offset − rate · (position of the signal); on a clipping limit the
        rate is 0. If some residuals may lie outside the columns, bounds keep them away from the clipping limits.
        """
        observation, scale = self._observation, self._scale
        model = as_noise_model(noise_model)
        on_low, on_high = observation <= model.low, observation >= model.high
        on_limit = on_low | on_high
        inside = observation if bool(on_limit.all()) else observation[~on_limit]
        ends = scale.observation(torch.stack(torch.aminmax(inside)))
        start, stop = float(ends[0]) - scale.ends[1], float(ends[1]) - scale.ends[0]
        coarse = coarse_signals(scale.low, scale.high, observation)
        width = variance_along(noise_model, coarse).sqrt() * scale.slope(coarse)
        reach = 100 * float(width.max())
        wide = stop - start > reach  # a few extreme outliers must not reduce the resolution for all others
        if wide:
            start, stop = max(start, -reach / 2), min(stop, reach / 2)
        self._step = (max(stop, start + 1e-9) - start) / (count - 1)
        unit, rate = 2 / (count + 1), 2 / (count + 1) / self._step
        offset = scale.observation(observation) * rate + ((1 - start / self._step) * unit - 1)
        self._offset = torch.where(on_low, -1.0, torch.where(on_high, 1.0, offset))
        self._rate = torch.full_like(offset, rate).masked_fill_(on_limit, 0.0)
        if wide:
            self._bounds = [torch.where(on_limit, self._offset, end) for end in (unit - 1, 1 - unit)]
        residuals = start + self._step * torch.arange(count, dtype=torch.float64, device=observation.device)
        parts = torch.split(scale.signal(self._signals.double()), max(1, LONG // count))
        inner = [scale.inverse(part + residuals).to(observation) for part in parts]
        outer = (torch.full_like(self._signals, end if math.isfinite(end) else 0.0) for end in (model.low, model.high))
        self._values = torch.cat([next(outer), torch.cat(inner), next(outer)], dim=1)

    @torch.no_grad()
    def _lowest_possible(self, noise_model: nn.Module, *, accuracy: float = 1e-4) -> float:
        """The low end of the rows, to an accuracy of a share of their range, raised to where observations become possible, such
        as counts above their offset: rows without a likelihood would spoil the slope of those beside them."""
        observation = self._observation[:: max(1, self._observation.numel() // 1024)]

        def impossible(signal: float) -> int:
            return int(torch.isinf(noise_model(observation.new_full((1,), signal)).log_prob(observation)).sum())

        below, above = self.low, self.high
        fewest = impossible(above)
        if impossible(below) <= fewest:
            return below
        while above - below > accuracy * (self.high - self.low):
            middle = (below + above) / 2
            below, above = (below, middle) if impossible(middle) <= fewest else (middle, above)
        return above

    @torch.no_grad()
    def rebuild(self, noise_model: nn.Module) -> None:
        """Tabulate the current model."""
        value = _log_likelihood(noise_model, self._signals, self._values, between_rails=self._step > 0)
        (slope,) = torch.gradient(value, spacing=(self._signals[:, 0],), dim=0)
        if self._step > 0:
            # along a column of constant residual r = t(o) − t(s) the observation changes with the signal:
            # ∂/∂s at fixed o = ∂/∂s at fixed r − t'(s) ∂/∂r
            (along,) = torch.gradient(value[:, 1:-1], spacing=self._step, dim=1)
            slope[:, 1:-1] -= along * self._scale.slope(self._signals)
        # two tables, because a lookup in a two-channel table takes three times as long as in a one-channel table
        self._value, self._slope = value[None, None].contiguous(), slope[None, None].contiguous()

    def log_prob(self, signal: Tensor, part: slice | Tensor = slice(None)) -> Tensor:
        """Log-likelihood at (N,) signals, without gradient; `part` selects pixels."""
        signal = signal.detach()
        clamped = signal.clamp(self.low, self.high)
        places = self._places(clamped, part)
        value, slope = (_interpolated(table, places) for table in (self._value, self._slope))
        return torch.addcmul(value, slope, signal - clamped)

    def slope(self, signal: Tensor) -> Tensor:
        """Derivative of the log-likelihood of each pixel with respect to its signal, at (N,) signals."""
        signal = signal.detach()
        found = torch.empty_like(signal)
        chunk = LONG if signal.device.type == "cpu" else signal.numel()
        for start in range(0, signal.numel(), chunk):
            part = slice(start, start + chunk)
            found[part] = _interpolated(self._slope, self._places(signal[part].clamp(self.low, self.high), part))
        return found

    def _places(self, signal: Tensor, part: slice | Tensor) -> Tensor:
        """Texture coordinates of the signals, clamped to the rows, (n, 2)."""
        root, places = self._scale.signal(signal), signal.new_empty(2, signal.numel())
        across = torch.addcmul(self._offset[part], root, self._rate[part], value=-1, out=places[0])
        if self._bounds:
            torch.clamp(across, self._bounds[0][part], self._bounds[1][part], out=across)
        start, stop = self._scale.ends
        torch.add(root * (2 / (stop - start)), -2 * start / (stop - start) - 1, out=places[1])
        return places.T

    @torch.no_grad()
    def measure_error(self, noise_model: nn.Module, *, count: int = 1024) -> float:
        """Mean absolute interpolation error, nats, at pixels paired with signals in proportion to their likelihood."""
        part = slice(None, None, max(1, self._observation.numel() // count))
        observation = self._observation[part]
        generator = torch.Generator().manual_seed(0)
        coarse = torch.linspace(self.low, self.high, 64, dtype=observation.dtype, device=observation.device)
        likelihood = noise_model(coarse[:, None]).log_prob(observation.expand(coarse.numel(), -1)).cpu()
        gumbel = -torch.log(-torch.log(torch.rand(likelihood.shape, generator=generator)))
        row = (torch.nan_to_num(likelihood, nan=-1e30) + gumbel).argmax(0)
        jitter = (torch.rand(row.shape, generator=generator) - 0.5) * float(coarse[1] - coarse[0])
        signal = (coarse[row.to(coarse.device)] + jitter.to(coarse)).clamp(self.low, self.high)
        exact = noise_model(signal).log_prob(observation)
        possible = torch.isfinite(exact)
        error = float((self.log_prob(signal, part) - exact)[possible].abs().mean()) if bool(possible.any()) else 0.0
        return error if math.isfinite(error) else math.inf


def _interpolated(table: Tensor, grid: Tensor) -> Tensor:
    """Bilinear lookup in a (1, 1, rows, columns) table at (N, 2) coordinates in one pass, at the cost of a normal log-density."""
    return F.grid_sample(table, grid[None, None], align_corners=True, padding_mode="border")[0, 0, 0]


def _log_likelihood(noise_model: nn.Module, signals: Tensor, values: Tensor, *, between_rails: bool) -> Tensor:
    """Log-likelihood on a table, some rows at a time, because a mixture needs several arrays for each component. With
    `between_rails` only the outer columns include clipping, so that interpolation near a clipping limit is accurate."""
    if len(signals) > (together := max(1, LONG // values.shape[1])):
        parts = zip(torch.split(signals, together), torch.split(values, together), strict=True)
        return torch.cat([_log_likelihood(noise_model, *part, between_rails=between_rails) for part in parts])
    if between_rails:
        free, ends = as_noise_model(noise_model).without_rails(), (values[:, :1], values[:, -1:])
        outer = [noise_model(signals).log_prob(end) for end in ends]
        value = torch.cat([outer[0], free(signals).log_prob(values[:, 1:-1]), outer[1]], dim=1)
    else:
        value = noise_model(signals).log_prob(values)
    return torch.nan_to_num(value, nan=-1e5, neginf=-1e5, posinf=1e5).clamp(-1e5, 1e5)


class TableKeeper:
    """Stores the table of a set of pixels under a frozen noise model, built by the first fit that needs it.

    Attributes:
        table: as first built; every fit gets a copy, whose range follows its signals.
        resume: state of the table of an interrupted fit, to build it with the same rows and columns.
    """

    def __init__(self) -> None:
        self.table: ObservationTable | None = None
        self.resume: dict[str, Any] | None = None

    def get(self, make: Callable[[dict[str, Any] | None], ObservationTable]) -> ObservationTable:
        """The table, built by ``make(resume)`` if there is none."""
        if self.resume is not None:
            resumed, self.resume = make(self.resume), None
            return resumed
        self.table = make(None) if self.table is None else self.table
        return copy.copy(self.table)
