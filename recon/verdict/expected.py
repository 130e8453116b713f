"""Expected images of a volume under its noise model, whose mean is shifted by clipping."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised
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
    tensors: list[Any] = [*model.parameters(), *model.buffers()]
    levels = torch.linspace(low, high, _LEVELS, device=tensors[0].device if tensors else None)
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
