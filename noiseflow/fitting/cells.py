"""Cells of alike pixels: nearly sufficient statistics of pixels with known signals, a tenth as many as the pixels."""

from typing import NamedTuple

import torch
from torch import Tensor

from noiseflow.distributions.numerics.elementwise import PIECE
from noiseflow.models.digitisation import GROUPS, MOST_CODES
from noiseflow.models.standardisation import Standardisation


class Cells(NamedTuple):
    """Means of alike pixels.

    Attributes:
        signal: (C,) signals.
        values: (C,) observations, or (C, K) rows of the fixed part of the likelihood.
        weight: (C,) shares of the pixels, which sum to 1.
    """

    signal: Tensor
    values: Tensor
    weight: Tensor


def count(signal: Tensor, observation: Tensor, weight: Tensor | None = None) -> Cells | None:
    """Count (N,) pixels by level of the observation and narrow range of the signal; None if there are too many levels."""
    levels, level = torch.unique(observation, return_inverse=True)
    if levels.numel() > MOST_CODES:
        return None
    row = torch.floor(in_ranges(signal.double(), observation.double())).long()
    key, cell = torch.unique(row * levels.numel() + level, return_inverse=True)
    if key.numel() > PIECE:
        return None
    share = torch.ones_like(signal, dtype=torch.float64) if weight is None else weight.double()
    total = torch.bincount(cell, share)
    mean = torch.bincount(cell, signal.double() * share) / total
    good = total > 0
    values = levels[key % levels.numel()]
    return Cells(mean[good].to(signal.dtype), values[good], (total[good] / total.sum()).to(signal.dtype))


def in_ranges(signal: Tensor, observation: Tensor, *, width: float = 0.2) -> Tensor:
    """The signals in units of so many standard deviations of the noise there, measured in groups of pixels, from 0: a fifth adds
    0.003 to the variance of the noise. More cells than `PIECE` are as slow as cells by residual."""
    order = torch.argsort(signal)
    groups = torch.tensor_split((observation - signal)[order], min(GROUPS, order.numel()))
    ends = signal[order[torch.linspace(0, order.numel() - 1, len(groups) + 1, dtype=torch.float64).long()]]
    widths = width * torch.stack([group.std(correction=0) for group in groups])
    widths = widths.clamp(min=max(float(ends[-1] - ends[0]) / PIECE, 1e-30))
    number = torch.nn.functional.pad(torch.cumsum(torch.diff(ends) / widths, 0), (1, 0))
    after = torch.searchsorted(ends, signal).clamp(1, len(groups))
    inside = (signal - ends[after - 1]) / (ends[after] - ends[after - 1]).clamp(min=1e-30)
    return torch.lerp(number[after - 1], number[after], inside)


def gather(
    scale: Standardisation,
    signal: Tensor,
    values: Tensor,
    weight: Tensor | None = None,
    *,
    low: float = -torch.inf,
    high: float = torch.inf,
    along: int = GROUPS,
    width: float = 0.05,
) -> Cells:
    """Gather (N,) pixels into cells by signal and by residual, in units of `scale`, or by the first column of (N, K) fixed parts,
    a standard normal latent; `along` is their number along the signal, and `width` theirs along the residual, wider in the tails:
    a twentieth adds 0.0002 to the variance of a cell's mean. Observations at the clipping limits `low` and `high` have cells of
    their own."""
    coordinate = scale.coordinate(signal.double())
    if values.ndim > 1:
        place, at_limit = values[:, 0].double(), torch.isinf(values).any(1)
        side = torch.isposinf(values).any(1).double() - 0.5
        kept = values.double()
    else:
        location, log_scale = scale(coordinate)
        kept = values.double() - signal
        place, at_limit = (kept - location) * torch.exp(-log_scale), (values <= low) | (values >= high)
        side = (values >= high).double() - 0.5
    row = torch.floor(coordinate * along).clamp(max=along - 1)
    place = torch.where(at_limit, 0.0, torch.round(torch.asinh(place) / width))
    far = float(place.abs().max()) + 1 if place.numel() else 1.0
    cell = (row * (2 * far + 1) + torch.where(at_limit, 2 * far * side, place) + far).long()
    share = torch.ones_like(coordinate) if weight is None else weight.double()
    total = torch.bincount(cell, share)
    good = total > 0

    def mean(each: Tensor) -> Tensor:
        return torch.bincount(cell, each * share)[good] / total[good]

    at = mean(signal.double())
    if values.ndim > 1:
        # a limit is infinite in all pixels of its cell; NaN is 0 · ∞ of pixels without weight
        found = torch.stack([mean(column) for column in kept.T], -1)
    else:
        exact = torch.bincount(cell, at_limit.double())[good] > 0
        limit = values.new_tensor([low, high]).double()[(mean(side) > 0).long()]  # their mean would be rounded
        found = torch.where(exact, limit, at + mean(kept))
    return Cells(at.to(signal.dtype), found.to(values.dtype), (total[good] / total.sum()).to(signal.dtype))
