"""Likelihoods, samples and slow moments of large inputs from cached tables, used when no gradient is required.

The key of a table is a hash of the model's parameters (`fingerprint`), the data type and the device, so that it is never stale.
A table is replaced when signals leave its range. The error of each pixel is bounded: nodes where the function is too curved for
linear interpolation are NaN, and pixels beside them or outside the table are evaluated exactly.
"""

from __future__ import annotations

import hashlib
import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from noiseflow.distributions.numerics.elementwise import LONG, PIECE
from noiseflow.distributions.numerics.normal import REACH
from noiseflow.distributions.pixels import is_traced, needs_image

LARGE = 2**18
"""Pixels from which a table is used, if no gradient is required, and that are otherwise evaluated at once: the graph of a flow
has about a hundred float64 arrays of this size, 200 MB."""

TOLERANCE = 1e-3
"""Largest interpolation error: nats for a log-likelihood, standard deviations for a sample and a mean, relative for a standard
deviation."""

SIZES = [(64 << doubled, 1024 << doubled) for doubled in range(4)]

_tables: weakref.WeakKeyDictionary[nn.Module, dict[Any, Table]] = weakref.WeakKeyDictionary()


@dataclass(frozen=True)
class RootScale:
    """A scale of pixel values on which the noise has about constant width: √((value − low)/(high − low) + shift). Below `low` it
    continues linearly, because observations can be below every signal."""

    low: float
    high: float
    shift: float

    @staticmethod
    def of(
        noise_model: nn.Module, low: float, high: float, like: Tensor, *, shifts: tuple[float, float] = (1e-6, 0.1)
    ) -> RootScale:
        """The scale for signals from `low` to `high`, if the noise variance is linear between its values at the ends. Its shift
        is limited: slopes are finite, and it stays near a root."""
        variance = variance_along(noise_model, coarse_signals(low, high, like))
        least, most = float(variance.min()), float(variance.max())
        found = least / (most - least) if most > least else math.inf
        return RootScale(low, high, min(max(found, shifts[0]), shifts[1]))

    @property
    def ends(self) -> tuple[float, float]:
        """Positions of `low` and `high` on the scale."""
        return self.shift**0.5, (1 + self.shift) ** 0.5

    def signal(self, signal: Tensor) -> Tensor:
        """Positions of signals inside the range."""
        scale = 1 / (self.high - self.low)
        return signal.mul(scale).add_(self.shift - self.low * scale).clamp_(min=self.shift).sqrt_()

    def observation(self, observation: Tensor) -> Tensor:
        """Positions of any pixel values."""
        share = ((observation - self.low) / (self.high - self.low)).clamp(max=0)
        root: Tensor = self.signal(observation) + share / (2 * self.shift**0.5)
        return root

    def inverse(self, root: Tensor) -> Tensor:
        """Pixel values at positions on the scale."""
        start = self.shift**0.5
        share = root.clamp(min=start) ** 2 - self.shift + 2 * start * (root - start).clamp(max=0)
        readings: Tensor = self.low + (self.high - self.low) * share
        return readings

    def slope(self, signal: Tensor) -> Tensor:
        """Derivative of the scale with respect to the signal."""
        return 0.5 / ((self.high - self.low) * self.signal(signal))


def variance_along(noise_model: nn.Module, signals: Tensor) -> Tensor:
    """The variance of the noise, without the effect of clipping."""
    variance: Tensor = getattr(noise_model, "model", noise_model)(signals).variance.detach()
    return variance


def coarse_signals(low: float, high: float, like: Tensor, count: int = 65) -> Tensor:
    """Few equally spaced signals, between which the noise hardly changes."""
    return torch.linspace(low, high, count, dtype=torch.float64).to(like)


def is_large(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> bool:
    """Whether a table may replace the exact likelihood: many pixels, no gradient required, and the model allows it."""
    if observation.numel() < LARGE or signal.shape != observation.shape or is_traced(observation):
        return False
    tensors = signal, observation, *noise_model.parameters()
    differentiable = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    return not differentiable and may_tabulate(noise_model)


def may_tabulate(noise_model: nn.Module) -> bool:
    """Whether all parts of the model allow tables and none needs images."""
    return all(getattr(module, "tabulate", True) for module in noise_model.modules()) and not needs_image(noise_model)


@torch.no_grad()
def log_prob(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> Tensor | None:
    """Log-likelihood of each pixel, accurate to `TOLERANCE`, shaped like `observation`; None if no table is accurate.

    Args:
        signal, observation: equal shapes, detector units.
    """
    kind = torch.promote_types(torch.promote_types(signal.dtype, observation.dtype), torch.float32)
    s, o = signal.reshape(-1).to(kind), observation.reshape(-1).to(kind)
    # without clipping, the likelihood is smooth
    free = noise_model.without_rails() if hasattr(noise_model, "without_rails") else noise_model  # type: ignore[operator]
    low, high = (getattr(noise_model, name, limit) for name, limit in (("low", -math.inf), ("high", math.inf)))
    clipped = math.isfinite(low) or math.isfinite(high)
    largest = max((abs(limit) for limit in (low, high) if math.isfinite(limit)), default=0.0)
    # within it, an observation counts as clipped; see `DigitisedDistribution`
    slack = max(1e-3 * float(getattr(noise_model, "step", 0.0)), 8 * torch.finfo(o.dtype).eps * largest)
    inner = (o > low + slack) & (o < high - slack) if clipped else None
    judged = _spread(torch.nonzero(inner)[:, 0] if inner is not None else torch.arange(o.numel(), device=o.device))
    if judged.numel() == 0:
        return None

    def columns(scale: RootScale, count: int) -> tuple[Tensor, Values]:
        start, stop = _residuals(free, scale, s)
        across = torch.linspace(start, stop, count, dtype=torch.float64, device=s.device)
        return across, lambda at: free(at).log_prob(scale.inverse(scale.observation(at) + across))

    def place(scale: RootScale, some: Tensor, seen: Tensor) -> Tensor:
        return scale.observation(seen) - scale.observation(some)

    kept = _table_of(noise_model, "log_prob", s, judged, columns, lambda scale, at: place(scale, s[at], o[at]))
    if kept is None:
        return None
    found = kept.look_up(s, lambda part: place(kept.scale, s[part], o[part]))
    if inner is not None:
        found = torch.where(inner, found, torch.full_like(found, math.nan))
        for limit in (low, high):
            on = torch.nonzero((o - limit).abs() <= slack)[:, 0]
            if math.isfinite(limit) and on.numel():  # the likelihood of clipped pixels depends on the signal alone
                beside = kept.beside(limit, lambda at, end=limit: noise_model(at).log_prob(at * 0 + end))  # type: ignore[misc]
                found[on] = beside.look_up(s[on], None)
    return _exact_where_missing(found, lambda at: noise_model(s[at]).log_prob(o[at])).reshape(observation.shape)


def _residuals(free: nn.Module, scale: RootScale, like: Tensor, *, tail: float = 1e-6) -> tuple[float, float]:
    """Range of the residuals, on the scale, between quantiles of the model with this probability outside on each side."""
    signals = coarse_signals(scale.low, scale.high, like)
    distribution = free(signals)
    tails = [distribution.icdf(torch.full_like(signals, q, dtype=torch.float64)) for q in (tail, 1 - tail)]
    low, high = (scale.observation(end.double()) - scale.observation(signals.double()) for end in tails)
    return float(low.min()), float(high.max())


@torch.no_grad()
def sample(noise_model: nn.Module, signal: Tensor, generator: torch.Generator | None) -> Tensor | None:
    """Draw one observation per pixel from a table of quantiles over (signal, normal latent); None if no table is accurate.

    Args:
        noise_model: noise model whose distribution has ``from_latent``.
        signal: any shape.
    """
    flat = signal.reshape(-1).to(torch.promote_types(signal.dtype, torch.float32))
    judged = _spread(torch.arange(flat.numel(), device=flat.device))
    tried = torch.randn(judged.shape, generator=torch.Generator().manual_seed(0)).to(flat)

    def columns(scale: RootScale, count: int) -> tuple[Tensor, Values]:
        nodes = torch.linspace(-REACH, REACH, count // 2, dtype=torch.float64, device=flat.device)
        return nodes, lambda at: noise_model(at).from_latent(nodes.expand(at.shape[0], -1)) - at

    unit = lambda at: noise_model(at).stddev  # noqa: E731
    kept = _table_of(noise_model, "sample", flat, judged, columns, lambda scale, at: tried, unit)
    if kept is None:
        return None
    latent = torch.randn(flat.shape, generator=generator, dtype=flat.dtype, device=flat.device)
    drawn = kept.look_up(flat, lambda part: latent[part]).add_(flat)
    return _exact_where_missing(drawn, lambda at: noise_model(flat[at]).from_latent(latent[at])).reshape(signal.shape)


@torch.no_grad()
def moments(
    noise_model: nn.Module,
    signal: Tensor,
    exact: Callable[[Tensor], tuple[Tensor, Tensor]],
    *,
    least: int = 256,
    few: float = 1e-3,
) -> tuple[Tensor, Tensor]:
    """Mean minus signal, and standard deviation, (N,) each, float64; of at least so many pixels, four times the fewest rows of a
    table, from one of both, in which `few` are missing: these cost a hundred times as much.

    Args:
        signal: (N,) detector units.
        exact: function from (R,) signals to both.
    """
    if signal.numel() < least or not may_tabulate(noise_model):
        return exact(signal)
    ends = torch.arange(2, dtype=torch.float64, device=signal.device)

    def values(at: Tensor) -> Tensor:
        shift, width = exact(at[:, 0])
        return torch.stack([shift / width, torch.log(width)], 1)

    judged = _spread(torch.arange(signal.numel(), device=signal.device))
    columns = lambda scale, count: (ends, values)  # noqa: E731
    kept = _table_of(noise_model, "moments", signal, judged, columns, lambda scale, at: (at % 2).to(signal), few=few)
    if kept is None:
        return exact(signal)
    places = [torch.full_like(signal, float(end), dtype=torch.float64) for end in ends]
    shift, log_width = (kept.look_up(signal.double(), place.__getitem__) for place in places)
    missing = torch.isnan(shift + log_width)
    shift, width = shift * torch.exp(log_width), torch.exp(log_width)
    shift[missing], width[missing] = exact(signal[missing])
    return shift, width


def _spread(index: Tensor) -> Tensor:
    return index[:: max(1, index.numel() // PIECE)]


def _table_of(
    noise_model: nn.Module,
    kind: str,
    signal: Tensor,
    judged: Tensor,
    columns: Callable[[RootScale, int], tuple[Tensor, Values]],
    place: Callable[[RootScale, Tensor], Tensor],
    unit: Values | None = None,
    *,
    few: float = 0.02,
    many: float = 0.3,
) -> Table | None:
    """The cached table if it suits these pixels, or a new one of their range, refined until few would need exact evaluation; None
    if many would."""
    low, high = (float(bound) for bound in torch.aminmax(signal))
    if not math.isfinite(low + high):
        return None
    key = (kind, fingerprint(noise_model), signal.dtype, signal.device)
    kept = _tables.setdefault(noise_model, {})

    def share_missing(table: Table) -> float:
        found = table.look_up(signal[judged], lambda part: place(table.scale, judged)[part])
        return float(torch.isnan(found).float().mean())

    if (table := kept.get(key)) is not None:
        ends = min(low, table.scale.low), max(high, table.scale.high)
        if share_missing(table) <= (many if ends == (table.scale.low, table.scale.high) else few):
            return table
        low, high = (
            ends if 2 * (high - low) > ends[1] - ends[0] else (low, high)
        )  # the next pixels may be like the last
    found, scale = None, RootScale.of(noise_model, low, max(high, low + 1e-6 * (1 + abs(low))), signal.double())
    for num_rows, num_columns in SIZES[:-1]:
        if num_rows * num_columns > max(LARGE, signal.numel()):
            break
        table = Table(scale, num_rows, *columns(scale, num_columns), unit)
        missing = share_missing(table)
        found = table if missing <= many else found
        if missing <= few:
            break
    if found is not None:
        kept[key] = found
    for old in [each for each in kept if each[1] != key[1]]:  # of earlier parameters
        del kept[old]
    return found


def _exact_where_missing(found: Tensor, exact: Callable[[Tensor], Tensor]) -> Tensor:
    missing = torch.nonzero(torch.isnan(found))[:, 0]
    for at in torch.split(missing, LARGE // 2):
        found[at] = exact(at).to(found)
    return found


Values = Callable[[Tensor], Tensor]


class Table:
    """Values on a grid: rows are signals, evenly spaced on a scale; columns are another coordinate.

    The error of linear interpolation is at most an eighth of the second difference where the function is smooth, and half of it
    at a kink. Nodes where half of the second difference exceeds the tolerance are NaN, and so are all values interpolated from
    them.

    Args:
        num_rows: rows between the ends of the scale.
        columns: (C,) evenly spaced coordinates; a single one if there is no second coordinate.
        values: function from (rows, 1) signals, float64, to (rows, C) values.
        unit: function from (rows, 1) signals to the unit of the tolerance, (rows, 1); 1 by default.
    """

    def __init__(
        self, scale: RootScale, num_rows: int, columns: Tensor, values: Values, unit: Values | None = None
    ) -> None:
        self.scale, self.columns, self._num_rows = scale, columns, num_rows
        start, stop = scale.ends
        self.step = (stop - start) / (num_rows - 1)
        self.first = (
            start - 2 * self.step
        )  # two rows beyond the signals on each side are needed to estimate the curvature
        count = num_rows + 2 + 2
        places = self.first + self.step * torch.arange(count, dtype=torch.float64, device=columns.device)
        signals = scale.inverse(places)[:, None]
        rows = torch.cat([values(some) for some in torch.split(signals, max(1, PIECE // columns.numel()))])
        allowed = 2 * TOLERANCE * (torch.ones_like(rows[:, :1]) if unit is None else unit(signals).to(rows))
        curved = _bends(rows) + (_bends(rows.T).T if columns.numel() > 2 else 0)
        good = torch.isfinite(rows) & (curved <= allowed)
        self._checked = torch.where(good, rows, torch.full_like(rows, math.nan))[None, None]
        self._beside: dict[Any, Table] = {}

    def beside(self, key: Any, values: Values) -> Table:
        """A one-column table with the same rows."""
        if key not in self._beside:
            self._beside[key] = Table(self.scale, self._num_rows, self.columns[:1], values)
        return self._beside[key]

    def look_up(self, signal: Tensor, column: Callable[[slice], Tensor] | None) -> Tensor:
        """Values of (N,) pixels, in pieces that fit in the cache; NaN where the table is not accurate or out of range.

        Args:
            signal: (N,) detector units.
            column: function from a slice of the pixels to their column coordinates; None for a one-column table.
        """
        found = torch.empty_like(signal)
        for start in range(0, signal.numel(), LONG):
            part = slice(start, start + LONG)
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


def _bends(rows: Tensor) -> Tensor:
    """Second differences along the first axis, absolute, or their change between neighbours where that is more: a kink may hide
    behind a smooth curvature of the opposite sign (0.0014 nats off where 0.001 are allowed)."""
    second = F.pad(torch.diff(rows, n=2, dim=0), (0, 0, 1, 1))
    change = torch.diff(second[1:-1], dim=0).abs()
    before, after = F.pad(change, (0, 0, 2, 1)), F.pad(change, (0, 0, 1, 2))
    return torch.maximum(second.abs(), torch.maximum(before, after))


_PLAIN = (bool, int, float, str, type(None))


@torch.no_grad()
def fingerprint(model: nn.Module) -> str:
    """Hash all parameters and buffers with their data types and devices, and the plain settings of all submodules."""
    digest = hashlib.blake2b(digest_size=16)
    for name, tensor in (*model.named_parameters(), *model.named_buffers()):
        digest.update(f"{name}{tuple(tensor.shape)}{tensor.dtype}{tensor.device}".encode())
        digest.update(_bytes(tensor))
    for name, module in model.named_modules():
        settings = {key: value for key, value in vars(module).items() if not key.startswith("_")}
        plain = {key: value for key, value in settings.items() if isinstance(value, _PLAIN)}
        digest.update(f"{name}{type(module).__qualname__}{sorted(plain.items(), key=str)}".encode())
        for key, value in settings.items():
            if isinstance(value, (Tensor, np.ndarray)):
                digest.update(key.encode() + _bytes(torch.as_tensor(value)))
    return digest.hexdigest()


def _bytes(tensor: Tensor) -> Any:
    return tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data if tensor.numel() else b""
