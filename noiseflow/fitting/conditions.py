"""Fits of noise that depends on named conditions: one model at each place of a grid of their values."""

from __future__ import annotations

import copy
import math
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

    The place with most pixels is fitted first, and the others start from its weights, so that weights can be interpolated.

    Args:
        fit: `noiseflow.fit`.
        noise_model: the model at one condition, with its converter; not changed.
        signal, observation: (N,) pixels.
        condition: (N,) values by name.
        weights: (N,) weights of the pixels; 1 by default.
        result: filled in and returned, with a `Conditioned` model.
        options: further arguments of the fits.

    Raises:
        ValueError: a combination of values has too few pixels.
    """
    values = {name: _grid(each.cpu().numpy()) for name, each in condition.items()}
    places = [_nearest(values[name], each) for name, each in condition.items()]
    sizes = [len(each) for each in values.values()]
    number = sum((place * math.prod(sizes[i + 1 :]) for i, place in enumerate(places)), torch.zeros_like(places[0]))
    counts = torch.bincount(number, minlength=math.prod(sizes))
    if int(counts.min()) < _LEAST_PIXELS:
        raise ValueError(
            f"some combination of {', '.join(values)} has {int(counts.min())} pixels, fewer than {_LEAST_PIXELS}; give more "
            "pixels at every combination of values, or fewer conditions"
        )
    found, nll, start = None, 0.0, noise_model
    for place in torch.argsort(counts, descending=True).tolist():
        chosen = number == place
        given = {} if weights is None else {"weights": weights[chosen]}
        one = fit(copy.deepcopy(start), signal[chosen], observation[chosen], **given, **options)
        fitted = as_noise_model(one.noise_model)
        if found is None:
            start, found = fitted, Conditioned(fitted, values)
        found.set(tuple(int(i) for i in np.unravel_index(place, sizes)), fitted)
        nll += one.held_out_nll * int(counts[place]) / int(counts.sum())
        result.num_steps, result.seconds = result.num_steps + one.num_steps, result.seconds + one.seconds
    assert found is not None
    result.noise_model, result.held_out_nll = found, nll
    return result


def _grid(values: np.ndarray[Any, Any]) -> tuple[float, ...]:
    own = np.unique(values)
    if own.size > _MOST_VALUES:
        own = np.unique(np.quantile(values, (np.arange(_MOST_VALUES) + 0.5) / _MOST_VALUES))
    return tuple(own.tolist())


def _nearest(values: tuple[float, ...], given: Tensor) -> Tensor:
    grid = torch.tensor(values, dtype=torch.float64, device=given.device)
    return torch.bucketize(given, (grid[1:] + grid[:-1]) / 2)
