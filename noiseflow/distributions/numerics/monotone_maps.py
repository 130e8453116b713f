"""Monotone scalar maps in closed form: affine, radial, rational-quadratic spline, Student tail.

``forward`` returns the value and ``ladj``, the log of the derivative *at its input*; ``inverse`` does the same for the inverse
map. Parameters are tensors that broadcast with the input. Layers of flows make maps from unconstrained parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from noiseflow.distributions.pixels import broadcast_shapes


class Transform(Protocol):
    """An increasing map of the real line."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """``(y, log dy/dx)`` at `x`."""
        ...

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """``(x, log dx/dy)`` at `y`."""
        ...

    def between_rows(self, row: Tensor, weight: Tensor) -> Transform:
        """Interpolate the parameters linearly between the rows `row` and `row` + 1, with `weight` in [0, 1]. The parameters of
        this map have a first axis of rows; those of the result have the shape of `row` and `weight`."""
        ...


def through(maps: Sequence[Transform], value: Tensor) -> tuple[Tensor, Tensor]:
    """The value after all maps in turn, and the log-derivative."""
    total = torch.zeros_like(value)
    for each in maps:
        value, ladj = each.forward(value)
        total = total + ladj
    return value, total


def back_through(maps: Sequence[Transform], value: Tensor) -> Tensor:
    """The value before all maps."""
    for each in reversed(maps):
        value = each.inverse(value)[0]
    return value


class _OfTensors:
    """Maps whose fields are all parameters."""

    def between_rows(self, row: Tensor, weight: Tensor) -> Any:
        return type(self)(*between_rows(torch.stack(list(vars(self).values()), 1), row, weight).unbind(row.ndim))


@dataclass(frozen=True)
class Affine(_OfTensors):
    """y = (x − loc)·exp(−log_scale): standardises its input."""

    loc: Tensor
    log_scale: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return (x - self.loc) * torch.exp(-self.log_scale), -self.log_scale.expand_as(x)

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return self.loc + y * torch.exp(self.log_scale), self.log_scale.expand_as(y)


@dataclass(frozen=True)
class Radial(_OfTensors):
    """y = x + β d/(α + |d|), d = x − centre (Rezende & Mohamed 2015, arXiv:1505.05770, in one dimension), some maps in turn.

    It is parametrised by its slope at the centre, 1 + β/α = exp(log_slope), so that every parameter gives a monotone map.

    Args:
        centre: (..., L) positions where the slope of each map differs most from one.
        log_width: (..., L) log α, the range of the change.
        log_slope: (..., L) log of the slope at the centre.
    """

    centre: Tensor
    log_width: Tensor
    log_slope: Tensor

    def _maps(self) -> list[tuple[Tensor, ...]]:
        """Centre, width, and slope at the centre minus one of each map."""
        parts = self.centre, torch.exp(self.log_width), torch.expm1(self.log_slope)
        return list(zip(*(each.movedim(-1, 0).contiguous().unbind() for each in parts), strict=True))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        total = torch.zeros_like(x)
        for centre, width, rise in self._maps():
            d = x - centre
            near = width / (width + d.abs())
            x, total = torch.addcmul(x, rise * near, d), total + torch.log1p(rise * near * near)
        return x, total

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        total = torch.zeros_like(y)
        for centre, width, rise in reversed(self._maps()):
            u = (y - centre).abs()
            q = torch.addcmul(width - u, width, rise)
            root = torch.sqrt(q * q + 4 * width * u)
            # both forms are the positive root of d² + q d − width·u; each is used where it does not cancel
            distance = torch.where(q > 0, 2 * width * u / (q.clamp(min=0) + root), (root - q) / 2)
            y, near = centre + torch.sign(y - centre) * distance, width / (width + distance)
            total = total - torch.log1p(rise * near * near)
        return y, total


@dataclass(frozen=True)
class StudentTail(_OfTensors):
    """y = sign(x)·√(log(1 + h x²)/h): turns power-law tails into Gaussian ones, and is the identity where h = 0. With h = 1/ν it
    normalises Student's t with ν degrees of freedom closely (Wallace 1959, doi:10.1214/aoms/1177706148). The left and right tails
    have separate parameters."""

    left: Tensor
    right: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        weight = torch.where(x < 0, self.left, self.right)
        t = weight * x * x
        log_ratio = torch.log(_log1p_ratio(t))
        return x * torch.exp(log_ratio / 2), -log_ratio / 2 - torch.log1p(t)

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        weight = torch.where(y < 0, self.left, self.right)
        t = (weight * y * y).clamp(max=80.0)
        log_ratio = torch.log(_expm1_ratio(t))
        return y * torch.exp(log_ratio / 2), t - log_ratio / 2


def _log1p_ratio(t: Tensor) -> Tensor:
    """log(1 + t)/t for t ≥ 0, continued to 1 at 0."""
    small = t < 1e-3
    near, far = torch.where(small, t, torch.zeros_like(t)), torch.where(small, torch.ones_like(t), t)
    return torch.where(small, 1 - near / 2 + near**2 / 3 - near**3 / 4, torch.log1p(far) / far)


def _expm1_ratio(t: Tensor) -> Tensor:
    """(exp(t) − 1)/t for t ≥ 0, continued to 1 at 0."""
    small = t < 1e-3
    near, far = torch.where(small, t, torch.zeros_like(t)), torch.where(small, torch.ones_like(t), t)
    return torch.where(small, 1 + near / 2 + near**2 / 6 + near**3 / 24, torch.expm1(far) / far)


@dataclass(frozen=True)
class Spline:
    """Monotone rational-quadratic spline with linear tails of free slope (Durkan et al. 2019, arXiv:1906.04032).

    Args:
        x: (..., K+1) increasing knots.
        y: (..., K+1) increasing values at the knots.
        slope: (..., K+1) positive derivatives at the knots; the outermost ones are the slopes of the tails.
        between: rows and weights for linear interpolation of the knots between each row and the next.
    """

    x: Tensor
    y: Tensor
    slope: Tensor
    between: tuple[Tensor, Tensor] | None = None

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        inside, tail_slope = self._clamped(self.x, x)
        x0, width, y0, height, d0, d1 = self._bin(self.x, inside)
        secant = height / width
        xi = (inside - x0) / width
        rest = xi * (1 - xi)
        denominator = secant + (d0 + d1 - 2 * secant) * rest
        y = y0 + height * (secant * xi * xi + d0 * rest) / denominator
        return y + (x - inside) * tail_slope, _spline_ladj(secant, xi, rest, d0, d1, denominator)

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        inside, tail_slope = self._clamped(self.y, y)
        x0, width, y0, height, d0, d1 = self._bin(self.y, inside)
        secant = height / width
        rise = inside - y0
        curve = rise * (d0 + d1 - 2 * secant)
        a, b, c = height * (secant - d0) + curve, height * d0 - curve, -secant * rise
        root = torch.sqrt((b * b - 4 * a * c).clamp(min=0))
        xi = (2 * c / (-b - root)).clamp(0, 1)
        rest = xi * (1 - xi)
        denominator = secant + (d0 + d1 - 2 * secant) * rest
        return x0 + xi * width + (y - inside) / tail_slope, -_spline_ladj(secant, xi, rest, d0, d1, denominator)

    def between_rows(self, row: Tensor, weight: Tensor) -> Spline:
        return Spline(self.x, self.y, self.slope, (row, weight))

    def _clamped(self, knots: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """The value clamped to the range of the knots, and the slope of the tail on its side."""
        first = torch.zeros((), dtype=torch.long, device=value.device)
        last = first + knots.shape[-1] - 1
        low, high = self._knot(knots, first), self._knot(knots, last)
        side = torch.where(value < low, first, last)
        return torch.minimum(torch.maximum(value, low), high), self._knot(self.slope, side)

    def _bin(self, knots: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        inner = knots.detach()[..., 1:-1]
        if self.between is not None:
            row, weight = self.between
            inner = between_rows(inner, row, weight.detach())
        index = (value[..., None] >= inner).sum(-1)
        pairs = [(self._knot(each, index), self._knot(each, index + 1)) for each in (self.x, self.y, self.slope)]
        (x0, x1), (y0, y1), (d0, d1) = pairs
        return x0, x1 - x0, y0, y1 - y0, d0, d1

    def _knot(self, knots: Tensor, index: Tensor) -> Tensor:
        if self.between is not None:
            (row, weight), (_, count) = self.between, knots.shape
            return between_rows(knots.reshape(-1), row * count + index, weight, step=count)
        index = index.broadcast_to(broadcast_shapes(index.shape, knots.shape[:-1]))
        return knots.expand(*index.shape, knots.shape[-1]).gather(-1, index[..., None]).squeeze(-1)


def between_rows(table: Tensor, row: Tensor, weight: Tensor, *, step: int = 1) -> Tensor:
    """Linear interpolation between table[row] and table[row + step]; (*row.shape, …) for tables with more axes."""
    flat, shape = row.reshape(-1), (*row.shape, *table.shape[1:])
    left, right = (table.index_select(0, at).reshape(shape) for at in (flat, flat + step))
    return left + weight.reshape((*weight.shape, *(1,) * (table.ndim - 1))) * (right - left)


def _spline_ladj(secant: Tensor, xi: Tensor, rest: Tensor, d0: Tensor, d1: Tensor, denominator: Tensor) -> Tensor:
    numerator = d1 * xi * xi + 2 * secant * rest + d0 * (1 - xi) ** 2
    return 2 * torch.log(secant) + torch.log(numerator) - 2 * torch.log(denominator)


@dataclass(frozen=True)
class Layer:
    """One map of a flow: initial values of its raw parameters, and how they are converted to a transform.

    Args:
        initial: initial values of the raw parameters.
        build: function from raw parameters (..., P) to a transform; any real parameters must be valid. It must be defined at
            module level so that models can be pickled.
        conditional: whether the parameters depend on the signal.
    """

    initial: tuple[float, ...]
    build: Callable[[Tensor], Transform]
    conditional: bool = True


def _affine(raw: Tensor) -> Transform:
    return Affine(bounded(raw[..., 0], 10), bounded(raw[..., 1], 5))


def _scale(raw: Tensor) -> Transform:
    return Affine(torch.zeros_like(raw[..., 0]), bounded(raw[..., 0], 5))


def radial_layer(*centres: float, conditional: bool = True) -> Layer:
    """Radial maps in turn; widths from 0.05 to 20 and central slopes from 0.05 to 20 standard deviations."""
    return Layer(tuple(value for centre in centres for value in (centre, 0.0, 0.0)), _radial, conditional)


def _radial(raw: Tensor) -> Transform:
    limits = raw.new_tensor([10.0, 3.0, 3.0])
    return Radial(*bounded(raw.reshape(*raw.shape[:-1], -1, len(limits)), limits).unbind(-1))


def spline_layer(num_bins: int, *, reach: float = 5.0) -> Layer:
    """A monotone rational-quadratic spline over ±`reach` standard deviations, with linear tails of learnt slope."""
    return Layer((0.0,) * (3 * num_bins + 1), partial(_spline, num_bins=num_bins, reach=reach))


def _spline(raw: Tensor, *, num_bins: int, reach: float) -> Transform:
    widths, heights, slopes = torch.split(raw, [num_bins, num_bins, num_bins + 1], dim=-1)
    return Spline(_knots(widths, reach), _knots(heights, reach), torch.exp(bounded(slopes, 5)))


def _tail(raw: Tensor) -> Transform:
    weight = 0.4 * torch.sigmoid(bounded(raw, 10))
    return StudentTail(weight[..., 0], weight[..., 1])


def bounded(raw: Tensor, limit: float | Tensor) -> Tensor:
    """Map any real number to the range ±limit."""
    return limit * torch.tanh(raw / limit)


def _knots(raw: Tensor, reach: float) -> Tensor:
    least = 0.02 / raw.shape[-1]
    steps = least + (1 - least * raw.shape[-1]) * torch.softmax(raw, -1)
    inner = 2 * reach * torch.cumsum(steps, -1)[..., :-1] - reach
    end = torch.full_like(raw[..., :1], reach)
    return torch.cat([-end, inner, end], -1)


AFFINE = Layer((0.0, 0.0), _affine)
"""Location and scale of the standardised residual."""
SCALE = Layer((0.0,), _scale)
"""Scale of the standardised residual alone."""
TAIL = Layer((-4.0, -4.0), _tail, conditional=False)
"""Weights of the two tails, up to that of Student's t with 2.5 degrees of freedom."""
