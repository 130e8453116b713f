"""Fast lookup of likelihoods: the log-likelihood is a function of two scalars, so tabulate it and interpolate.

Lookups are bilinear and run as one fused pass over the pixels (``grid_sample``), at about the cost of a normal log-density.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from noiseflow.digitised import Digitised

_MAX_LEVELS = 1024
_SHIFT = 0.01
_SIZES = ((64, 1024), (128, 2048), (256, 4096), (512, 8192))


class ObservationTable:
    """log p(o | s) and its signal derivative for pixels whose observations stay fixed while their signals change.

    Rows are signals, spaced evenly in the square root because weak signals change the noise fastest. Columns are equally
    spaced residuals o − s, along which noise changes fast while it changes slowly along the rows; observations on a rail have columns of their own. Where that is not accurate enough and the
    observations have few levels (counts of a few electrons), columns are the levels themselves. Beyond the rows the
    log-likelihood continues along its slope, so that a stray signal is still pulled back.

    Args:
        noise_model: the model to tabulate; call `rebuild` after it changes.
        observation: (N,) readings.
        signal_low, signal_high: range of the signals to expect.
        tolerance: accepted mean absolute interpolation error, nats per pixel.

    Attributes:
        error: the error measured when the table was made, nats per pixel.
    """

    def __init__(
        self, noise_model: nn.Module, observation: Tensor, signal_low: float, signal_high: float, *, tolerance: float = 1e-3
    ) -> None:
        self.low, self.high = signal_low, max(signal_high, signal_low + 1e-6 * (1 + abs(signal_low)))
        self._observation = observation
        self._grid = torch.empty(observation.numel(), 2, dtype=observation.dtype, device=observation.device)
        levels = torch.unique(observation[:: max(1, observation.numel() // 65536)])
        self._choices: list[tuple[int, int, Tensor | None]] = [(rows, columns, None) for rows, columns in _SIZES]
        if levels.numel() <= _MAX_LEVELS:
            levels = torch.unique(observation)
            self._choices += [(rows, 0, levels) for rows, _ in _SIZES]
        self._tolerance, self._size = tolerance, 0
        self._refine(noise_model)

    def _refine(self, noise_model: nn.Module) -> None:
        """Take the first size from the present one on that is accurate enough, or else the most accurate one."""
        errors = {}
        for size in range(self._size, len(self._choices)):
            errors[size] = self.error = self._build(noise_model, *self._choices[size])
            self._size = size
            if self.error <= self._tolerance:
                return
        self._size = min(errors, key=lambda size: errors[size])
        self.error = self._build(noise_model, *self._choices[self._size])

    def check(self, noise_model: nn.Module) -> float:
        """Measure the error again, and refine the table where the model has outgrown it."""
        self.error = self.measure_error(noise_model)
        if self.error > self._tolerance and self._size < len(self._choices) - 1:
            self._refine(noise_model)
        return self.error

    def _build(self, noise_model: nn.Module, num_rows: int, num_columns: int, levels: Tensor | None) -> float:
        like = self._observation
        root = torch.linspace(_SHIFT**0.5, (1 + _SHIFT) ** 0.5, num_rows, dtype=torch.float64)
        rows = self.low + (self.high - self.low) * (root**2 - _SHIFT)
        self._signals = rows.to(like)[:, None]
        if levels is None:
            self._columns_of_residuals(noise_model, num_columns)
        else:
            self._columns_of_levels(levels)
        self.rebuild(noise_model)
        return self.measure_error(noise_model)

    def _columns_of_levels(self, levels: Tensor) -> None:
        last = max(levels.numel() - 1, 1)
        self._offset = 2 * torch.searchsorted(levels, self._observation).to(self._grid.dtype) / last - 1
        self._rate = torch.zeros_like(self._offset)
        self._bounds = None
        column = torch.cat([levels, levels[-1:]]) if levels.numel() == 1 else levels
        self._values = column[None, :].expand(self._signals.shape[0], -1)

    def _columns_of_residuals(self, noise_model: nn.Module, count: int) -> None:
        """Columns 0 and `count` + 1 are the rails; a residual r has column 1 + (r − start)/step."""
        observation = self._observation
        rail_low, rail_high = (getattr(noise_model, name, limit) for name, limit in (("low", -math.inf), ("high", math.inf)))
        on_low, on_high = observation <= rail_low, observation >= rail_high
        inside = observation[~(on_low | on_high)]
        inside = inside if inside.numel() else observation
        start, stop = float(inside.min()) - self.high, float(inside.max()) - self.low
        spread = 12 * float(noise_model(self._signals[:, 0]).variance.detach().max().sqrt())
        wide = stop - start > 16 * spread
        if wide:  # a few far outliers must not take the resolution from all others
            start, stop = max(start, -8 * spread), min(stop, 8 * spread)
        step = (stop - start) / (count - 1)
        unit = 2 / (count + 1)
        offset = (1 + (observation - start) / step) * unit - 1
        offset = torch.where(on_low, -1.0, torch.where(on_high, 1.0, offset))
        rail = on_low | on_high
        self._offset, self._rate = offset, torch.where(rail, 0.0, unit / step).to(offset.dtype)
        low_bound, high_bound = unit - 1, 1 - unit
        self._bounds = None
        if wide:
            self._bounds = torch.where(rail, offset, low_bound), torch.where(rail, offset, high_bound)
        residuals = start + step * torch.arange(count, dtype=observation.dtype, device=observation.device)
        values = self._signals + residuals[None, :]
        # readings beyond a rail cannot occur; the formula between the rails is continued past them so that neighbours of a
        # rail interpolate cleanly
        rails = [torch.full_like(self._signals, rail if math.isfinite(rail) else 0.0) for rail in (rail_low, rail_high)]
        self._values = torch.cat([rails[0], values, rails[1]], dim=1)

    @torch.no_grad()
    def rebuild(self, noise_model: nn.Module) -> None:
        """Tabulate the model as it is now."""
        by_residual = bool(self._rate.any())
        likelihood = _between_rails if by_residual else _everywhere
        value = likelihood(noise_model, self._signals, self._values)
        value = torch.nan_to_num(value, nan=-1e5, neginf=-1e5, posinf=1e5).clamp(-1e5, 1e5)
        # along a row of equal residual the observation moves with the signal, so ∂/∂s at fixed o = ∂/∂s at fixed r − ∂/∂r
        (slope,) = torch.gradient(value, spacing=(self._signals[:, 0],), dim=0)
        if by_residual:
            inner = value[:, 1:-1]
            (along,) = torch.gradient(inner, spacing=float(self._values[0, 2] - self._values[0, 1]), dim=1)
            slope = torch.cat([slope[:, :1], slope[:, 1:-1] - along, slope[:, -1:]], dim=1)
        self._table = torch.stack([value, slope])[None].contiguous()

    def log_prob(self, signal: Tensor) -> Tensor:
        """Log-likelihood of each pixel at (N,) signals, differentiable in the signal."""
        found: Tensor = _Lookup.apply(signal, self)  # type: ignore[no-untyped-call]
        return found

    def lookup(self, signal: Tensor, part: slice = slice(None)) -> tuple[Tensor, Tensor]:
        """Log-likelihood and its signal derivative at (N,) signals; of a part of the pixels, where one is given."""
        grid = self._grid[part]
        clamped = signal.detach().clamp(self.low, self.high)
        torch.addcmul(self._offset[part], clamped, self._rate[part], value=-1, out=grid[:, 0])
        if self._bounds is not None:
            torch.clamp(grid[:, 0], self._bounds[0][part], self._bounds[1][part], out=grid[:, 0])
        scale, (start, stop) = 1 / (self.high - self.low), (_SHIFT**0.5, (1 + _SHIFT) ** 0.5)
        root = clamped.mul(scale).add_(_SHIFT - self.low * scale).clamp_(min=_SHIFT).sqrt_()
        torch.sub(root.mul_(2 / (stop - start)), 2 * start / (stop - start) + 1, out=grid[:, 1])
        found = F.grid_sample(self._table, grid[None, None], align_corners=True, padding_mode="border")
        value, slope = found[0, :, 0]
        return torch.addcmul(value, slope, signal.detach() - clamped), slope

    @torch.no_grad()
    def measure_error(self, noise_model: nn.Module, *, count: int = 1024) -> float:
        """Mean absolute interpolation error, nats, at pixels paired with signals in proportion to their likelihood."""
        part = slice(None, None, max(1, self._observation.numel() // count))
        observation = self._observation[part]
        generator = torch.Generator().manual_seed(0)
        coarse = torch.linspace(self.low, self.high, 64, dtype=observation.dtype, device=observation.device)
        likelihood = noise_model(coarse[:, None]).log_prob(observation.expand(coarse.numel(), -1)).cpu()
        gumbel = -torch.log(-torch.log(torch.rand(likelihood.shape, generator=generator).clamp(1e-7, 1 - 1e-7)))
        row = (torch.nan_to_num(likelihood, nan=-1e30) + gumbel).argmax(0)
        jitter = (torch.rand(row.shape, generator=generator) - 0.5) * float(coarse[1] - coarse[0])
        signal = (coarse[row.to(coarse.device)] + jitter.to(coarse)).clamp(self.low, self.high)
        exact = noise_model(signal).log_prob(observation)
        found = self.lookup(signal, part)[0]
        possible = torch.isfinite(exact)
        error = float((found - exact)[possible].abs().mean()) if bool(possible.any()) else 0.0
        return error if math.isfinite(error) else math.inf


def _everywhere(noise_model: nn.Module, signals: Tensor, values: Tensor) -> Tensor:
    value: Tensor = noise_model(signals).log_prob(values)
    return value


def _between_rails(noise_model: nn.Module, signals: Tensor, values: Tensor) -> Tensor:
    """Log-likelihood on the table: its outer columns as they are, the inner ones as if there were no rails."""
    if not isinstance(noise_model, Digitised):
        return _everywhere(noise_model, signals, values)
    free = Digitised(noise_model.model, step=noise_model.step)
    low, inner, high = values[:, :1], values[:, 1:-1], values[:, -1:]
    outer = [_everywhere(noise_model, signals, rail) for rail in (low, high)]
    return torch.cat([outer[0], _everywhere(free, signals, inner), outer[1]], dim=1)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, signal: Tensor, table: ObservationTable) -> Tensor:
        value, slope = table.lookup(signal)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (slope,) = ctx.saved_tensors
        return gradient * slope, None
