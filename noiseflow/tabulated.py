"""Fast lookup of likelihoods: the log-likelihood is a function of two scalars, so tabulate it and interpolate.

Lookups are bilinear and run as one fused pass over the pixels (``grid_sample``), at about the cost of a normal log-density.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_MAX_LEVELS = 1024
_MAX_ROWS = 512


class ObservationTable:
    """log p(o | s) and its signal derivative for pixels whose observations stay fixed while their signals change.

    Columns are observations: every level exactly where there are few of them, else knots that crowd where the observations do,
    with the rails of clipped data as columns of their own. Rows are equally spaced signals. Beyond the rows the log-likelihood
    continues along its slope, so that a stray signal is still pulled back.

    Args:
        noise_model: the model to tabulate; call `rebuild` after it changes.
        observation: (N,) readings.
        signal_low, signal_high: range of the signals to expect.
        tolerance: accepted root-mean-square interpolation error, nats per pixel.
    """

    def __init__(
        self,
        noise_model: nn.Module,
        observation: Tensor,
        signal_low: float,
        signal_high: float,
        *,
        tolerance: float = 1e-3,
    ) -> None:
        self.low, self.high = signal_low, max(signal_high, signal_low + 1e-6 * (1 + abs(signal_low)))
        self._observation, self._tolerance = observation, tolerance
        self.num_rows, num_columns = 128, 256
        while True:
            self._place_columns(observation, num_columns)
            self.rebuild(noise_model)
            self.error = self.measure_error(noise_model)
            if self.error <= tolerance or self.num_rows >= _MAX_ROWS:
                return
            self.num_rows, num_columns = self.num_rows * 2, num_columns * 2

    def _place_columns(self, observation: Tensor, count: int) -> None:
        levels = torch.unique(observation[:: max(1, observation.numel() // 65536)])
        if levels.numel() <= _MAX_LEVELS:
            levels = torch.unique(observation)
        self.exact = levels.numel() <= _MAX_LEVELS
        self.columns = levels if self.exact else _knots(observation, count)
        last = self.columns.numel() - 1
        right = torch.searchsorted(self.columns, observation).clamp(1, max(last, 1))
        if last == 0:
            position = torch.zeros_like(observation)
        else:
            left_value, right_value = self.columns[right - 1], self.columns[right]
            position = right - 1 + (observation - left_value) / (right_value - left_value)
        self._grid = torch.empty(observation.numel(), 2, dtype=observation.dtype, device=observation.device)
        self._grid[:, 0] = 2 * position / max(last, 1) - 1

    @torch.no_grad()
    def rebuild(self, noise_model: nn.Module) -> None:
        """Tabulate the model as it is now."""
        like = self._grid
        self.signals = torch.linspace(self.low, self.high, self.num_rows, dtype=like.dtype, device=like.device)
        columns = self.columns[None, :]
        value = noise_model(self.signals[:, None]).log_prob(columns.expand(self.num_rows, -1))
        floor = torch.finfo(value.dtype).min / 1e6
        value = torch.nan_to_num(value, nan=floor, neginf=floor).clamp(min=-1e5)
        (slope,) = torch.gradient(value, spacing=(self.high - self.low) / (self.num_rows - 1), dim=0)
        if value.shape[1] == 1:
            value, slope = value.expand(-1, 2), slope.expand(-1, 2)
        self._table = torch.stack([value, slope])[None].contiguous()

    def log_prob(self, signal: Tensor) -> Tensor:
        """Log-likelihood of each pixel at (N,) signals, differentiable in the signal."""
        found: Tensor = _Lookup.apply(signal, self)  # type: ignore[no-untyped-call]
        return found

    def score(self, signal: Tensor) -> Tensor:
        """Derivative of each pixel's log-likelihood with respect to its (N,) signal."""
        return self._sample(signal, 1, 2)[0]

    def _sample(self, signal: Tensor, first: int, last: int, grid: Tensor | None = None) -> Tensor:
        grid = self._grid if grid is None else grid
        scale = 2 / (self.high - self.low)
        torch.sub(signal.detach() * scale, self.low * scale + 1, out=grid[:, 1])
        table = self._table[:, first:last]
        return F.grid_sample(table, grid[None, None], align_corners=True, padding_mode="border")[0, :, 0]

    def lookup(self, signal: Tensor, grid: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Log-likelihood and its signal derivative at (N,) signals."""
        value, slope = self._sample(signal, 0, 2, grid)
        beyond = signal.detach() - signal.detach().clamp(self.low, self.high)
        return value + slope * beyond, slope

    @torch.no_grad()
    def measure_error(self, noise_model: nn.Module, *, count: int = 1024) -> float:
        """Root-mean-square interpolation error, nats, at pixels paired with signals in proportion to their likelihood."""
        stride = max(1, self._observation.numel() // count)
        observation = self._observation[::stride]
        generator = torch.Generator().manual_seed(0)
        coarse = self.signals[:: max(1, self.num_rows // 64)]
        likelihood = noise_model(coarse[:, None]).log_prob(observation.expand(coarse.numel(), -1)).cpu()
        gumbel = -torch.log(-torch.log(torch.rand(likelihood.shape, generator=generator).clamp(1e-7, 1 - 1e-7)))
        row = (torch.nan_to_num(likelihood, nan=-1e30) + gumbel).argmax(0)
        jitter = torch.rand(row.shape, generator=generator) * float(coarse[1] - coarse[0])
        signal = (coarse[row.to(coarse.device)] + jitter.to(coarse)).clamp(self.low, self.high)
        exact = noise_model(signal).log_prob(observation)
        found = self.lookup(signal, self._grid[::stride].clone())[0]
        possible = torch.isfinite(exact)
        error = float((found - exact)[possible].square().mean().sqrt()) if bool(possible.any()) else 0.0
        return error if math.isfinite(error) else math.inf


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx, signal: Tensor, table: ObservationTable) -> Tensor:  # type: ignore[no-untyped-def]
        value, slope = table.lookup(signal)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[no-untyped-def]
        (slope,) = ctx.saved_tensors
        return gradient * slope, None


def _knots(observation: Tensor, count: int) -> Tensor:
    """Column positions: half spread evenly over the bulk of the observations, the rest following their quantiles; the two
    extremes, where clipped data pile up, are fenced off by close neighbours."""
    ordered = torch.sort(observation[:: max(1, observation.numel() // 1_000_000)].double())[0]
    low, high = float(observation.min()), float(observation.max())
    quantile = ordered[(torch.linspace(0, 1, count // 2, dtype=torch.float64) * (ordered.numel() - 1)).long()]
    bulk_low, bulk_high = (
        float(ordered[int(0.002 * (ordered.numel() - 1))]),
        float(ordered[int(0.998 * (ordered.numel() - 1))]),
    )
    even = torch.linspace(bulk_low, bulk_high, count // 2, dtype=torch.float64, device=ordered.device)
    fence = 1e-5 * (high - low)
    ends = torch.tensor([low, low + fence, high - fence, high], dtype=torch.float64, device=ordered.device)
    inner = torch.cat([quantile, even])
    inner = inner[(inner > low + fence) & (inner < high - fence)]
    knots: Tensor = torch.unique(torch.cat([inner, ends]).to(observation.dtype))
    return knots
