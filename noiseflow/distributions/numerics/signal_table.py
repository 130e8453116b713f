"""A table over signals and one more coordinate, with bilinear interpolation and error control."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from noiseflow.distributions.numerics.table_axes import RootScale

_CHUNK = 2**16  # pixels per lookup, so that intermediate arrays fit in the cache
_MARGIN = 2  # rows beyond the signals on each side, needed to estimate the curvature
_ROWS_AT_ONCE = 16
_MOST_GROWTH = 4.0  # relative to the initial rows; beyond this the scale is no longer suitable and the table is rebuilt

Values = Callable[[Tensor], Tensor]


class Table:
    """Values on a grid: rows are signals, evenly spaced on a scale; columns are another coordinate.

    The error of linear interpolation is at most an eighth of the second difference where the function is smooth, and half of it
    at a kink. Nodes where half of the second difference exceeds the tolerance are NaN, and so are all values interpolated from
    them.

    Args:
        scale: scale of the signals.
        num_rows: rows between the ends of the scale.
        columns: (C,) evenly spaced coordinates; a single one if there is no second coordinate.
        tolerance: largest error, in the unit of the values.
    """

    def __init__(self, scale: RootScale, num_rows: int, columns: Tensor, tolerance: float) -> None:
        self.scale, self.columns, self._tolerance = scale, columns, tolerance
        start, stop = scale.ends
        self.step = (stop - start) / (num_rows - 1)
        self.first, self._first_count = start, num_rows
        self.rows = columns.new_empty(0, columns.numel())  # exact values, (rows, C)
        self._beside: dict[Any, Table] = {}

    def cover(self, low: float, high: float, values: Values, unit: Values | None = None) -> bool:
        """Add rows until the table covers signals from `low` to `high`. Return False if it would grow too much.

        Args:
            low, high: detector units.
            values: function from (rows, 1) signals, float64, to (rows, C) values.
            unit: function from (rows, 1) signals to the unit of the tolerance, (rows, 1); 1 by default.
        """
        ends = self.scale.observation(torch.tensor([low, high], dtype=torch.float64))
        wanted = (float(ends[0]) - self.first) / self.step, (float(ends[1]) - self.first) / self.step
        count = self.rows.shape[0]
        before = max(0, _MARGIN - math.floor(wanted[0])) if count == 0 or wanted[0] < _MARGIN - 1 else 0
        after = max(0, math.ceil(wanted[1]) + 1 + _MARGIN - count) if wanted[1] > count - _MARGIN else 0
        if count + before + after > _MOST_GROWTH * self._first_count:
            return False
        if before or after:
            parts = [self._made(-before, 0, values), self.rows, self._made(count, count + after, values)]
            self.first -= before * self.step
            self.rows = torch.cat(parts)
            self._checked = self._check(unit)
        return True

    def _made(self, start: int, stop: int, values: Values) -> Tensor:
        places = self.first + self.step * torch.arange(start, stop, dtype=torch.float64, device=self.columns.device)
        signals = self.scale.inverse(places)[:, None]
        parts = [values(some) for some in torch.split(signals, _ROWS_AT_ONCE)]
        return torch.cat(parts) if parts else self.columns.new_empty(0, self.columns.numel())

    def _check(self, unit: Values | None) -> Tensor:
        """The table with NaN where interpolation is not accurate, (1, 1, rows, C)."""
        rows = self.rows
        allowed = torch.full_like(rows[:, :1], 2 * self._tolerance)
        if unit is not None:
            places = self.first + self.step * torch.arange(rows.shape[0], dtype=torch.float64, device=rows.device)
            allowed = allowed * unit(self.scale.inverse(places)[:, None]).to(rows)
        curved = torch.zeros_like(rows)
        curved[1:-1] += torch.diff(rows, n=2, dim=0).abs()
        if rows.shape[1] > 1:
            curved[:, 1:-1] += torch.diff(rows, n=2, dim=1).abs()
        good = torch.isfinite(rows) & (curved <= allowed)
        return torch.where(good, rows, torch.full_like(rows, math.nan))[None, None]

    def beside(self, key: Any, values: Values) -> Table:
        """A one-column table with the same rows. Raises ValueError if this table covers no signals yet."""
        if not self.rows.shape[0]:
            raise ValueError("this table has no rows yet; call cover() with the range of the signals first")
        if key not in self._beside:
            count = self._first_count
            self._beside[key] = Table(self.scale, count, self.columns[:1], self._tolerance)
        table = self._beside[key]
        ends = self.first + self.step * torch.tensor([_MARGIN, self.rows.shape[0] - 1 - _MARGIN], dtype=torch.float64)
        at = self.scale.inverse(ends)
        table.cover(float(at[0]), float(at[1]), values)
        return table

    def look_up(self, signal: Tensor, column: Callable[[slice], Tensor] | None) -> Tensor:
        """Values of (N,) pixels, in pieces that fit in the cache; NaN where the table is not accurate or out of range.

        Args:
            signal: (N,) detector units.
            column: function from a slice of the pixels to their column coordinates; None for a one-column table.
        """
        found = torch.empty_like(signal)
        for start in range(0, signal.numel(), _CHUNK):
            part = slice(start, start + _CHUNK)
            across = None if column is None else column(part)
            found[part] = self._interpolated(self.scale.observation(signal[part]), across)
        return found

    def _interpolated(self, root: Tensor, across: Tensor | None) -> Tensor:
        table = self._checked.to(root)
        last = table.shape[-2] - 1
        row = (root - self.first) * (2 / (self.step * last)) - 1
        low, high = float(self.columns[0]), float(self.columns[-1])
        column = torch.zeros_like(row) if across is None else (across - low) * (2 / (high - low)) - 1
        outside = ~((row.abs() <= 1) & (column.abs() <= 1))
        grid = torch.stack([column, row], -1).masked_fill_(outside[:, None], 0.0)
        found = F.grid_sample(table, grid[None, None], align_corners=True, padding_mode="border")[0, 0, 0]
        return found.masked_fill_(outside, math.nan)
