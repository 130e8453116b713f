"""What a result says of itself: expected images under its noise model, held-out likelihood, weight, lead of its tilt axis."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised
from noiseflow.checks import Effect
from noiseflow.models.wrapper import as_noise_model
from recon.series.alignment import Alignment
from recon.series.tilt_series import Volume

_LEVELS = 256  # number of signals at which the mean is computed; interpolated in between


class Result(Protocol):
    """The parts of a reconstruction that are assessed; every method provides them."""

    @property
    def volume(self) -> Volume: ...
    @property
    def projections(self) -> NDArray[np.float32]: ...
    @property
    def fit_result(self) -> Any: ...
    @property
    def noise_model(self) -> nn.Module | None: ...


def expected_images(result: Result, rows: slice = slice(None)) -> NDArray[np.float32]:
    """Means of the noise model at the projections (tilt, y, u) of some rows; the projections if there is no noise model."""
    model: nn.Module | None = getattr(result, "noise_model", None)
    projections = np.asarray(result.projections, dtype=np.float32)[:, rows]
    if model is None:
        return projections
    low, high = float(projections.min()), float(projections.max())
    if not high > low:
        return projections
    levels = torch.linspace(low, high, _LEVELS, device=as_noise_model(model).device)
    with torch.no_grad():
        means = _unrounded(model, levels)(levels).mean.double().cpu().numpy()
    if not np.isfinite(means).all():
        return projections
    places = np.linspace(low, high, _LEVELS)
    return np.stack([np.interp(image, places, means).astype(np.float32) for image in projections])


def _unrounded(model: nn.Module, levels: Tensor) -> nn.Module:
    """The model without rounding that is too fine to affect the mean, because summing over many levels is slow."""
    if not isinstance(model, Digitised) or model.levels.numel():
        return model
    fine = model.step < float(levels[1] - levels[0]) or model.step**2 < float(model.model(levels).variance.median())
    return Digitised(model.model, 0.0, model.low, model.high) if fine else model


def jump(fit_result: Any) -> Effect:
    """Held-out likelihood at the end minus the best before, nats per pixel."""
    history = [] if fit_result is None else [float(value) for value in dict(fit_result.history).values()]
    if not history:
        return Effect(0.0)
    return Effect(history[-1] - min(history) if all(math.isfinite(value) for value in history) else 1e3)


def weight_at_end(tried: dict[float, float]) -> Effect:
    """1 if the best of the tried weights is the largest, −1 if it is the smallest: a better one may be outside."""
    if len(tried) < 2:
        return Effect(0.0)
    best = min(tried, key=lambda weight: tried[weight])
    end = (best == max(tried)) - (best == min(tried))
    return Effect(end, what=f"{'above the highest' if end > 0 else 'below the lowest'} one tried, {best:.2g}")


def other_axis(alignment: Alignment | None) -> Effect:
    """Two standard errors over the lead of the tilt axis: a smaller lead has a probability of 1 in 40 by chance."""
    if alignment is None or alignment.margin is None:
        return Effect(0.0)
    return Effect(2 / max(alignment.margin, 0.1), what=f"{alignment.margin:.1f}")
