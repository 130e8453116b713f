"""Fits of noise that depends on named conditions: one model at each place of a grid of their values."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from noiseflow.fitting.result import FitResult
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.conditioned import Conditioned
from noiseflow.models.wrapper import as_noise_model

# Values of one condition up to which each has a place of its own; more are gathered around this many quantiles.
_MOST_VALUES = 8
# Pixels that a place of the grid needs; its standard deviation then has an error of 4 %.
_LEAST_PIXELS = 256
# Nats per pixel, across a gap twice as wide as those of the grid: half of what a wrong offset costs at an unfitted gain where
# signals do not determine it.
_MOST_OFF = 0.03
_JUDGED = 2**14


def fit_by_condition(
    fit: Callable[..., FitResult],
    noise_model: NoiseModelBase,
    signal: Tensor,
    observation: Tensor,
    condition: Mapping[str, Tensor],
    weights: Tensor | None,
    result: FitResult,
    options: Mapping[str, Any],
) -> FitResult:
    """Fit one model to the pixels around each place of a grid of conditions.

    The place with most pixels is fitted first, and the others start from its weights, so that these can be interpolated. Pixels,
    values and weights are (N,), `options` further arguments of `fit`, and `result` is filled in and returned.

    Raises:
        ValueError: a combination of values has too few pixels.
    """
    values = {}
    for name, each in condition.items():
        every = each.cpu().numpy()
        own = np.unique(every)
        if own.size > _MOST_VALUES:
            own = np.unique(np.quantile(every, (np.arange(_MOST_VALUES) + 0.5) / _MOST_VALUES))
        values[name] = tuple(own.tolist())
    places = [_nearest(values[name], each) for name, each in condition.items()]
    sizes = [len(each) for each in values.values()]
    number = sum((place * math.prod(sizes[i + 1 :]) for i, place in enumerate(places)), torch.zeros_like(places[0]))
    counts = torch.bincount(number, minlength=math.prod(sizes))
    if int(counts.min()) < _LEAST_PIXELS:
        raise ValueError(
            f"some combination of {', '.join(values)} has {int(counts.min())} pixels, fewer than {_LEAST_PIXELS}; give more "
            "pixels at every combination of values, or fewer conditions"
        )
    fitted: dict[int, NoiseModelBase] = {}
    nll = 0.0
    for place in torch.argsort(counts, descending=True).tolist():
        chosen = number == place
        start = next(iter(fitted.values()), noise_model)
        given = {} if weights is None else {"weights": weights[chosen]}
        one = fit(copy.deepcopy(start), signal[chosen], observation[chosen], **given, **options)
        fitted[place] = as_noise_model(one.noise_model)
        nll += one.held_out_nll * int(counts[place]) / int(counts.sum())
        result.num_steps, result.seconds = result.num_steps + one.num_steps, result.seconds + one.seconds
    found = Conditioned(next(iter(fitted.values())), values)
    for place, model in fitted.items():
        found.set(tuple(int(i) for i in np.unravel_index(place, sizes)), model)
    inner = [(name, place) for name, each in values.items() for place in range(1, len(each) - 1)]
    off = max((_between(found, *each, signal, observation, places) for each in inner), default=0.0)
    if off > _MOST_OFF:
        warnings.warn(
            f"models at neighbouring conditions do not predict those between them (off by {off:.2g} nats per pixel), so that the "
            "noise between the fitted conditions is uncertain; give closer conditions, or pixels with low and high signals",
            stacklevel=5,
        )
    found.fitted_range = float(signal.min()), float(signal.max())
    result.noise_model, result.held_out_nll = found, nll
    return result


@torch.no_grad()
def _between(
    model: Conditioned, name: str, place: int, signal: Tensor, observation: Tensor, places: list[Tensor]
) -> float:
    """Nats per pixel that the interpolation between the neighbours of one value loses to the fit at this value, at the middle
    place of the other conditions."""
    middle = {other: len(each) // 2 for other, each in model.values.items()} | {name: place}
    chosen = torch.stack([each == at for each, at in zip(places, middle.values(), strict=True)]).all(0)
    chosen = chosen.nonzero()[:_JUDGED, 0]
    condition = {other: each[middle[other]] for other, each in model.values.items()}
    with_, without = model.at(condition), model.without(name, place).at(condition)
    seen, known = observation[chosen], signal[chosen]
    return float(with_(known).log_prob(seen).mean() - without(known).log_prob(seen).mean())


def _nearest(values: tuple[float, ...], given: Tensor) -> Tensor:
    grid = torch.tensor(values, dtype=torch.float64, device=given.device)
    return torch.bucketize(given, (grid[1:] + grid[:-1]) / 2)
