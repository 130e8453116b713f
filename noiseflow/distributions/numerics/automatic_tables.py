"""Likelihoods and samples of large inputs from cached tables, used when no gradient is required.

The key of a table is a hash of the model's parameters (`fingerprint`), the data type and the device, so that it is never stale.
A table is extended when signals leave its range. The error of each pixel is bounded: nodes where the function is too curved for
linear interpolation are NaN, and pixels beside them or outside the table are evaluated exactly.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow.distributions.image_pixels import needs_image
from noiseflow.distributions.numerics.signal_table import Table, Values
from noiseflow.distributions.numerics.table_axes import SIZES, RootScale, fingerprint
from noiseflow.distributions.pixel_batch import is_traced

LARGE = 2**18
"""Smallest number of pixels for which a table is used, if no gradient is required."""

TOLERANCE = 1e-3
"""Largest interpolation error: nats for a log-likelihood, standard deviations for a sample."""

_LATENT_LIMIT = 6.5  # one standard normal draw in 10¹⁰ lies beyond and is computed exactly
_TAIL = 1e-6  # probability outside the columns on each side, under the model
_SAMPLE = 2**14  # pixels on which a table is checked before all are looked up
# Shares of pixels evaluated exactly: below the first, stop refining; above the second, use no table
_FEW, _MANY = 0.02, 0.3
_KEPT = 4  # tables kept per model, for different data types, likelihood and quantiles

_tables: weakref.WeakKeyDictionary[nn.Module, dict[Any, Table]] = weakref.WeakKeyDictionary()


def is_large(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> bool:
    """Whether a table may replace the exact likelihood: many pixels, no gradient required, and the model allows it."""
    if observation.numel() < LARGE or signal.shape != observation.shape or is_traced(observation):
        return False
    differentiable = torch.is_grad_enabled() and (
        signal.requires_grad or observation.requires_grad or any(p.requires_grad for p in noise_model.parameters())
    )
    return not differentiable and may_tabulate(noise_model)


def may_tabulate(noise_model: nn.Module) -> bool:
    """Whether all parts of the model allow tables and none needs images."""
    return all(getattr(module, "tabulate", True) for module in noise_model.modules()) and not needs_image(noise_model)


@torch.no_grad()
def log_prob(
    noise_model: nn.Module, signal: Tensor, observation: Tensor, *, tolerance: float = TOLERANCE
) -> Tensor | None:
    """Log-likelihood of each pixel, accurate to `tolerance`, shaped like `observation`; None if no table is accurate.

    Args:
        noise_model: the noise model.
        signal, observation: equal shapes, detector units.
        tolerance: bound of the interpolation error of each pixel, nats.
    """
    kind = torch.promote_types(torch.promote_types(signal.dtype, observation.dtype), torch.float32)
    s, o = signal.reshape(-1).to(kind), observation.reshape(-1).to(kind)
    free, low, high = _without_limits(noise_model)
    clipped = math.isfinite(low) or math.isfinite(high)
    slack = _slack(noise_model, o.dtype)
    inner = (o > low + slack) & (o < high - slack) if clipped else None
    judged = _spread(torch.nonzero(inner)[:, 0] if inner is not None else torch.arange(o.numel(), device=o.device))
    if judged.numel() == 0:
        return None

    def columns(scale: RootScale, count: int) -> tuple[Tensor, Values]:
        start, stop = _residuals(free, scale, s)
        across = torch.linspace(start, stop, count, dtype=torch.float64, device=s.device)

        def values(signals: Tensor) -> Tensor:
            found: Tensor = free(signals).log_prob(scale.inverse(scale.observation(signals) + across))
            return found

        return across, values

    def place(scale: RootScale, some: Tensor, seen: Tensor) -> Tensor:
        return scale.observation(seen) - scale.observation(some)

    kept = _table_of(
        noise_model, ("log_prob", tolerance), s, judged, columns, lambda scale, at: place(scale, s[at], o[at])
    )
    if kept is None:
        return None
    found = kept.look_up(s, lambda part: place(kept.scale, s[part], o[part]))
    if inner is not None:
        found = torch.where(inner, found, torch.full_like(found, math.nan))
        for limit in (low, high):
            _on_limit(noise_model, kept, s, torch.nonzero((o - limit).abs() <= slack)[:, 0], limit, found)
    exact = _exact_where_missing(found, lambda at: noise_model(s[at]).log_prob(o[at]))
    return exact.reshape(observation.shape)


def _slack(noise_model: nn.Module, dtype: torch.dtype) -> float:
    """Distance from a clipping limit within which an observation counts as clipped; see `DigitisedDistribution`."""
    limits = [abs(getattr(noise_model, name, 0.0)) for name in ("low", "high")]
    largest = max((limit for limit in limits if math.isfinite(limit)), default=0.0)
    return max(1e-3 * float(getattr(noise_model, "step", 0.0)), 8 * torch.finfo(dtype).eps * largest)


def _on_limit(noise_model: nn.Module, table: Table, s: Tensor, on: Tensor, limit: float, found: Tensor) -> None:
    """Fill in the likelihood of clipped pixels, which depends on the signal alone."""
    if not (math.isfinite(limit) and on.numel()):
        return
    beside = table.beside(limit, lambda at: noise_model(at).log_prob(torch.full_like(at, limit)))
    found[on] = beside.look_up(s[on], None)


def _without_limits(noise_model: nn.Module) -> tuple[nn.Module, float, float]:
    """The model without clipping, whose likelihood is smooth, and its clipping limits."""
    low, high = (getattr(noise_model, name, limit) for name, limit in (("low", -math.inf), ("high", math.inf)))
    free = noise_model.without_rails() if hasattr(noise_model, "without_rails") else noise_model  # type: ignore[operator]
    return free, low, high


def _residuals(free: nn.Module, scale: RootScale, like: Tensor) -> tuple[float, float]:
    """Range of the residuals, on the scale, between extreme quantiles of the model."""
    signals = torch.linspace(scale.low, scale.high, 65, dtype=torch.float64).to(like)
    distribution = free(signals)
    tails = [distribution.icdf(torch.full_like(signals, q, dtype=torch.float64)) for q in (_TAIL, 1 - _TAIL)]
    low, high = (scale.observation(tail.double()) - scale.observation(signals.double()) for tail in tails)
    return float(low.min()), float(high.max())


@torch.no_grad()
def sample(
    noise_model: nn.Module, signal: Tensor, generator: torch.Generator | None, *, tolerance: float = TOLERANCE
) -> Tensor | None:
    """Draw one observation per pixel from a table of quantiles over (signal, normal latent); None if no table is accurate.

    Args:
        noise_model: noise model whose distribution has ``from_latent``.
        signal: any shape.
        generator: source of the random numbers.
        tolerance: bound of the interpolation error of each draw, in standard deviations of the noise.
    """
    flat = signal.reshape(-1).to(torch.promote_types(signal.dtype, torch.float32))
    judged = _spread(torch.arange(flat.numel(), device=flat.device))
    tried = torch.randn(judged.shape, generator=torch.Generator().manual_seed(0)).to(flat)

    def columns(scale: RootScale, count: int) -> tuple[Tensor, Values]:
        nodes = torch.linspace(-_LATENT_LIMIT, _LATENT_LIMIT, count // 2, dtype=torch.float64, device=flat.device)

        def values(signals: Tensor) -> Tensor:
            found: Tensor = noise_model(signals).from_latent(nodes.expand(signals.shape[0], -1)) - signals
            return found

        return nodes, values

    def unit(signals: Tensor) -> Tensor:
        width: Tensor = noise_model(signals).stddev
        return width

    kept = _table_of(noise_model, ("sample", tolerance), flat, judged, columns, lambda scale, at: tried, unit)
    if kept is None:
        return None
    latent = torch.randn(flat.shape, generator=generator, dtype=flat.dtype, device=flat.device)
    drawn = kept.look_up(flat, lambda part: latent[part]).add_(flat)
    return _exact_where_missing(drawn, lambda at: noise_model(flat[at]).from_latent(latent[at])).reshape(signal.shape)


def _spread(index: Tensor) -> Tensor:
    return index[:: max(1, index.numel() // _SAMPLE)]


def _table_of(
    noise_model: nn.Module,
    kind: tuple[Any, ...],
    signal: Tensor,
    judged: Tensor,
    columns: Callable[[RootScale, int], tuple[Tensor, Values]],
    place: Callable[[RootScale, Tensor], Tensor],
    unit: Values | None = None,
) -> Table | None:
    """The cached table, extended to the signals, or a new one; None if too many pixels would need exact evaluation."""
    low, high = (float(bound) for bound in torch.aminmax(signal))
    if not math.isfinite(low + high):
        return None
    key = (*kind, fingerprint(noise_model), signal.dtype, signal.device)
    kept = _tables.setdefault(noise_model, {})

    def share_missing(table: Table) -> float:
        return float(
            torch.isnan(table.look_up(signal[judged], lambda part: place(table.scale, judged)[part])).float().mean()
        )

    table = kept.get(key)
    if table is not None:
        across, values = columns(
            table.scale, table.columns.numel() if kind[0] == "log_prob" else 2 * table.columns.numel()
        )
        if table.cover(low, high, values, unit):
            return table if share_missing(table) <= _MANY else None
    found = None
    for num_rows, num_columns in SIZES[:-1]:
        if num_rows * num_columns > max(LARGE, signal.numel()):
            break
        scale = RootScale.of(noise_model, low, max(high, low + 1e-6 * (1 + abs(low))), signal.double())
        across, values = columns(scale, num_columns)
        table = Table(scale, num_rows, across, tolerance=kind[1])
        table.cover(low, high, values, unit)
        missing = share_missing(table)
        found = table if missing <= _MANY else found
        if missing <= _FEW:
            break
    if found is not None:
        kept[key] = found
    while len(kept) > _KEPT:
        kept.pop(next(iter(kept)))
    return found


def _exact_where_missing(found: Tensor, exact: Callable[[Tensor], Tensor]) -> Tensor:
    missing = torch.nonzero(torch.isnan(found))[:, 0]
    for at in torch.split(missing, LARGE // 2):
        found[at] = exact(at).to(found)
    return found
