"""Monotone scalar maps in closed form: affine, radial, rational-quadratic spline, Student tail.

Every map gives its value and ``ladj``, the log of its derivative *at its input*, in one call; ``inverse`` gives the same for the
inverse map. Parameters are tensors that broadcast against the input.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Transform(Protocol):
    """An increasing map of the real line."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """``(y, log dy/dx)`` at `x`."""
        ...

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """``(x, log dx/dy)`` at `y`."""
        ...


@dataclass(frozen=True)
class Affine:
    """y = (x − loc)·exp(−log_scale): standardises its input."""

    loc: Tensor
    log_scale: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return (x - self.loc) * torch.exp(-self.log_scale), -self.log_scale.expand_as(x)

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return self.loc + y * torch.exp(self.log_scale), self.log_scale.expand_as(y)


@dataclass(frozen=True)
class Radial:
    """y = x + β d/(α + |d|), d = x − centre (Rezende & Mohamed 2015, arXiv:1505.05770, in one dimension).

    It is parametrised by its slope at the centre, 1 + β/α = exp(log_slope), so that every parameter gives a monotone map.

    Args:
        centre: where the slope differs most from one.
        log_width: log α, the reach of the change.
        log_slope: log of the slope at the centre.
    """

    centre: Tensor
    log_width: Tensor
    log_slope: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        width = torch.exp(self.log_width)
        d = x - self.centre
        near = width / (width + d.abs())
        y = x + torch.expm1(self.log_slope) * d * near
        return y, self._ladj(near)

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        width = torch.exp(self.log_width)
        u = (y - self.centre).abs()
        q = width * torch.exp(self.log_slope) - u
        root = torch.sqrt(q * q + 4 * width * u)
        # both forms are the positive root of d² + q d − width·u; each is used where nothing cancels
        distance = torch.where(q > 0, 2 * width * u / (q.clamp(min=0) + root), (root - q) / 2)
        x = self.centre + torch.sign(y - self.centre) * distance
        return x, -self._ladj(width / (width + distance))

    def _ladj(self, near: Tensor) -> Tensor:
        # 1 + (slope − 1)·near², written as a sum of positive terms
        return torch.log((1 - near) * (1 + near) + torch.exp(self.log_slope) * near * near)


@dataclass(frozen=True)
class StudentTail:
    """y = sign(x)·√(log(1 + h x²)/h): turns power-law tails into Gaussian ones, and is the identity where h = 0.

    With h = 1/ν it normalises Student's t with ν degrees of freedom closely (Wallace 1959, doi:10.1214/aoms/1177706148).
    The left and right tails have weights of their own.
    """

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
    """

    x: Tensor
    y: Tensor
    slope: Tensor

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        inside = torch.minimum(torch.maximum(x, self.x[..., 0]), self.x[..., -1])
        x0, width, y0, height, d0, d1 = self._bin(self.x, inside)
        secant = height / width
        xi = (inside - x0) / width
        rest = xi * (1 - xi)
        denominator = secant + (d0 + d1 - 2 * secant) * rest
        y = y0 + height * (secant * xi * xi + d0 * rest) / denominator
        ladj = _spline_ladj(secant, xi, rest, d0, d1, denominator)
        return y + self._tail(x, inside), ladj

    def inverse(self, y: Tensor) -> tuple[Tensor, Tensor]:
        inside = torch.minimum(torch.maximum(y, self.y[..., 0]), self.y[..., -1])
        x0, width, y0, height, d0, d1 = self._bin(self.y, inside)
        secant = height / width
        rise = inside - y0
        curve = rise * (d0 + d1 - 2 * secant)
        a, b, c = height * (secant - d0) + curve, height * d0 - curve, -secant * rise
        root = torch.sqrt((b * b - 4 * a * c).clamp(min=0))
        xi = (2 * c / (-b - root)).clamp(0, 1)
        rest = xi * (1 - xi)
        denominator = secant + (d0 + d1 - 2 * secant) * rest
        ladj = _spline_ladj(secant, xi, rest, d0, d1, denominator)
        beyond = y - inside
        tail_slope = torch.where(beyond < 0, self.slope[..., 0], self.slope[..., -1])
        return x0 + xi * width + beyond / tail_slope, -ladj

    def _tail(self, x: Tensor, inside: Tensor) -> Tensor:
        beyond = x - inside
        return beyond * torch.where(beyond < 0, self.slope[..., 0], self.slope[..., -1])

    def _bin(self, knots: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        count = knots.shape[-1] - 1
        index = (value[..., None] >= knots[..., 1:-1]).sum(-1, keepdim=True).clamp(max=count - 1)
        shape = (*value.shape, count + 1)
        x, y, slope = self.x.expand(shape), self.y.expand(shape), self.slope.expand(shape)

        def pick(table: Tensor, at: Tensor) -> Tensor:
            return table.gather(-1, at).squeeze(-1)

        x0, y0 = pick(x, index), pick(y, index)
        return x0, pick(x, index + 1) - x0, y0, pick(y, index + 1) - y0, pick(slope, index), pick(slope, index + 1)


def _spline_ladj(secant: Tensor, xi: Tensor, rest: Tensor, d0: Tensor, d1: Tensor, denominator: Tensor) -> Tensor:
    numerator = d1 * xi * xi + 2 * secant * rest + d0 * (1 - xi) ** 2
    return 2 * torch.log(secant) + torch.log(numerator) - 2 * torch.log(denominator)
