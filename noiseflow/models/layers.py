"""Layers of flows: maps with unconstrained parameters. Any real parameters give a valid map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from noiseflow.distributions.numerics.monotone_maps import Affine, Radial, Spline, StudentTail, Transform


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


def radial_layer(centre: float = 0.0, *, conditional: bool = True) -> Layer:
    """One radial map; widths from 0.05 to 20 and central slopes from 0.05 to 20 standard deviations."""
    return Layer((centre, 0.0, 0.0), _radial, conditional)


def _radial(raw: Tensor) -> Transform:
    return Radial(bounded(raw[..., 0], 10), bounded(raw[..., 1], 3), bounded(raw[..., 2], 3))


def spline_layer(num_bins: int = 16, *, reach: float = 5.0) -> Layer:
    """A monotone rational-quadratic spline over ±`reach` standard deviations, with linear tails of learnt slope."""
    return Layer((0.0,) * (3 * num_bins + 1), partial(_spline, num_bins=num_bins, reach=reach))


def _spline(raw: Tensor, *, num_bins: int, reach: float) -> Transform:
    widths, heights, slopes = torch.split(raw, [num_bins, num_bins, num_bins + 1], dim=-1)
    return Spline(_knots(widths, reach), _knots(heights, reach), torch.exp(bounded(slopes, 5)))


def _tail(raw: Tensor) -> Transform:
    weight = 0.4 * torch.sigmoid(bounded(raw, 10))
    return StudentTail(weight[..., 0], weight[..., 1])


def bounded(raw: Tensor, limit: float) -> Tensor:
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
