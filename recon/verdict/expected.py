"""The images that a volume and its noise model lead one to expect: a detector that clips moves the mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow import Digitised
from recon.verdict.verdict import Result

_LEVELS = 256  # signals at which the mean is computed; between them it is interpolated


def expected_images(result: Result, rows: slice = slice(None)) -> NDArray[np.float32]:
    """Means of the noise model at the projections (tilt, y, u) of some rows, detector units; else the projections."""
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
    """The model without a rounding too fine to move its mean: its levels, which are added up, may be countless."""
    if not isinstance(model, Digitised):
        return model
    fine = model.step < float(levels[1] - levels[0]) or model.step**2 < float(model.model(levels).variance.median())
    return Digitised(model.model, 0.0, model.low, model.high) if fine else model
