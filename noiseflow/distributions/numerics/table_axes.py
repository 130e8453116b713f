"""Table layout for a likelihood, a function of two scalars: scale of signals, rows and columns; and a hash of the model it is of.

Lookups are bilinear, in one fused pass over the pixels (``grid_sample``), at about the cost of a normal log-density.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from noiseflow.distributions.numerics.elementwise import LONG

SIZES = [(64 << doubled, 1024 << doubled) for doubled in range(4)]
_LEAST_SHIFT, _MOST_SHIFT = 1e-6, 0.1
COARSE = 65


@dataclass(frozen=True)
class RootScale:
    """A scale of pixel values on which the noise has about constant width: √((value − low)/(high − low) + shift). Below `low` it
    continues linearly, because observations can be below every signal."""

    low: float
    high: float
    shift: float

    @staticmethod
    def of(noise_model: nn.Module, low: float, high: float, like: Tensor) -> RootScale:
        """The scale for signals from `low` to `high`, if the noise variance is linear between its values at the ends."""
        variance = _variance(noise_model, low, high, like)
        least, most = float(variance.min()), float(variance.max())
        found = least / (most - least) if most > least else math.inf
        return RootScale(low, high, min(max(found, _LEAST_SHIFT), _MOST_SHIFT))

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


def _variance(noise_model: nn.Module, low: float, high: float, like: Tensor) -> Tensor:
    coarse = torch.linspace(low, high, COARSE, dtype=like.dtype, device=like.device)
    variance: Tensor = getattr(noise_model, "model", noise_model)(coarse).variance.detach()
    return variance


@dataclass(frozen=True)
class Rows:
    """Signals spaced evenly on a scale."""

    scale: RootScale
    count: int

    def signals(self, like: Tensor) -> Tensor:
        """Signals of the rows, (rows, 1)."""
        root = torch.linspace(*self.scale.ends, self.count, dtype=torch.float64)
        return self.scale.inverse(root).to(like)[:, None]

    def position(self, root: Tensor, out: Tensor) -> Tensor:
        """Row coordinates in [−1, 1] of positions on the scale, written to `out`."""
        start, stop = self.scale.ends
        return torch.add(root * (2 / (stop - start)), -2 * start / (stop - start) - 1, out=out)


@dataclass(frozen=True)
class Columns:
    """Equally spaced residuals on a scale, with a column at each end for observations on a clipping limit. In texture coordinates
    the column of an observation is offset − rate · (position of the signal); on a clipping limit the rate is 0."""

    scale: RootScale
    start: float
    stop: float
    count: int
    rail_low: float
    rail_high: float
    wide: bool

    @property
    def step(self) -> float:
        return (self.stop - self.start) / (self.count - 1)

    def values(self, signals: Tensor) -> Tensor:
        """Observations tabulated for signals (rows, 1), (rows, columns)."""
        residuals = self.start + self.step * torch.arange(self.count, dtype=torch.float64, device=signals.device)
        roots = torch.split(self.scale.signal(signals.double()), max(1, LONG // self.count))
        inner = torch.cat([self.scale.inverse(part + residuals[None, :]).to(signals) for part in roots])
        ends = [
            torch.full_like(signals, rail if math.isfinite(rail) else 0.0) for rail in (self.rail_low, self.rail_high)
        ]
        return torch.cat([ends[0], inner, ends[1]], dim=1)

    def position(self, observation: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor] | None]:
        """Offset and rate, and, if some residuals may lie outside the columns, the bounds that keep them away from the
        clipping limits."""
        unit = 2 / (self.count + 1)
        root = self.scale.observation(observation)
        offset = root * (unit / self.step) + ((1 - self.start / self.step) * unit - 1)
        rate = torch.full_like(offset, unit / self.step)
        low, high = torch.full_like(offset, unit - 1), torch.full_like(offset, 1 - unit)
        if math.isfinite(self.rail_low) or math.isfinite(self.rail_high):
            on_low, on_high = observation <= self.rail_low, observation >= self.rail_high
            offset = torch.where(on_low, -1.0, torch.where(on_high, 1.0, offset))
            on_rail = on_low | on_high
            rate = rate.masked_fill_(on_rail, 0.0)
            low, high = torch.where(on_rail, offset, low), torch.where(on_rail, offset, high)
        return offset, rate, (low, high) if self.wide else None

    @staticmethod
    def of(noise_model: nn.Module, observation: Tensor, scale: RootScale, count: int) -> Columns:
        """Columns for the residuals between given observations and the signals of the scale."""
        rail_low, rail_high = (
            getattr(noise_model, name, limit) for name, limit in (("low", -math.inf), ("high", math.inf))
        )
        inside = observation[(observation > rail_low) & (observation < rail_high)]
        inside = inside if inside.numel() else observation
        root = scale.observation(torch.stack(torch.aminmax(inside)))
        start, stop = float(root[0]) - scale.ends[1], float(root[1]) - scale.ends[0]
        coarse = torch.linspace(scale.low, scale.high, COARSE, dtype=observation.dtype, device=observation.device)
        width = _variance(noise_model, scale.low, scale.high, observation).sqrt() * scale.slope(coarse)
        reach = 100 * float(width.max())
        wide = stop - start > reach  # a few extreme outliers must not reduce the resolution for all others
        if wide:
            start, stop = max(start, -reach / 2), min(stop, reach / 2)
        return Columns(scale, start, max(stop, start + 1e-9), count, rail_low, rail_high, wide)


def interpolate(table: Tensor, grid: Tensor) -> Tensor:
    """Bilinear lookup in a (1, C, rows, columns) table at (N, 2) coordinates; (C, N)."""
    return F.grid_sample(table, grid[None, None], align_corners=True, padding_mode="border")[0, :, 0]


def log_likelihood(noise_model: nn.Module, signals: Tensor, values: Tensor, *, between_rails: bool) -> Tensor:
    """Log-likelihood on a table, some rows at a time, because a mixture needs several arrays for each component. With
    `between_rails` only the outer columns include clipping, so that interpolation near a clipping limit is accurate."""
    if len(signals) > (together := max(1, LONG // values.shape[1])):
        parts = zip(torch.split(signals, together), torch.split(values, together), strict=True)
        return torch.cat([log_likelihood(noise_model, *part, between_rails=between_rails) for part in parts])
    if between_rails and hasattr(noise_model, "without_rails"):
        free, ends = noise_model.without_rails(), (values[:, :1], values[:, -1:])  # type: ignore[operator]
        outer = [noise_model(signals).log_prob(end) for end in ends]
        value = torch.cat([outer[0], free(signals).log_prob(values[:, 1:-1]), outer[1]], dim=1)
    else:
        value = noise_model(signals).log_prob(values)
    return torch.nan_to_num(value, nan=-1e5, neginf=-1e5, posinf=1e5).clamp(-1e5, 1e5)


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
