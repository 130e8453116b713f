"""Structure that a per-pixel noise model cannot have: row, column and neighbour correlation of its residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arrays import floating
from noiseflow.described import described
from noiseflow.distributions.numerical import as_noise_distribution
from noiseflow.distributions.picked import needs_image
from noiseflow.metrics.evaluation import probability_integral_transform
from noiseflow.models.scan_noise import ScanDistribution


@described()
@dataclass(frozen=True)
class SpatialStructure:
    """Correlations that a per-pixel noise model cannot have, of standardised residuals of an image.

    Attributes:
        rows, columns: variance of row and column means over what independent pixels would give; 1 where there is no structure.
        horizontal, vertical: correlation of neighbouring pixels.
        pattern: correlation of equal pixels of different images of a stack; 0 for a single image.
        error: standard error of the correlations under independence.
        suffices: whether the model suffices: nothing stands out by over four standard errors.
        remedies: what would describe what stands out, most telling first.
    """

    rows: float
    columns: float
    horizontal: float
    vertical: float
    pattern: float
    error: float
    suffices: bool
    remedies: tuple[str, ...] = ()

    def in_words(self) -> str:
        """One line for people."""
        figures = (
            f"neighbours correlate by {self.horizontal:+.3f} along x and {self.vertical:+.3f} along y (± {self.error:.3f}), "
            f"row means vary {self.rows:.2f} and column means {self.columns:.2f} times as much as independent pixels' would"
        )
        if self.pattern:
            figures += f", equal pixels of different images correlate by {self.pattern:+.3f}"
        if self.suffices:
            return figures + "; a per-pixel model suffices"
        return figures + "; a per-pixel model does not suffice: " + "; ".join(self.remedies)


@torch.no_grad()
def spatial_structure(
    noise_model: nn.Module, signal: Tensor | NDArray[Any], observation: Tensor | NDArray[Any]
) -> SpatialStructure:
    """Residual row, column, neighbour and fixed-pattern correlation of (y, x) images, or stacks of them, under a noise model.

    NaN and infinite pixels are left out: their residuals count as 0.
    """
    z = _latent(noise_model, floating(signal), floating(observation))
    height, width = z.shape[-2:]
    error = 1 / math.sqrt(z.size)
    rows, columns = float(z.mean(-1).var() * width), float(z.mean(-2).var() * height)
    horizontal, vertical = float((z[..., 1:] * z[..., :-1]).mean()), float((z[..., 1:, :] * z[..., :-1, :]).mean())
    stack = z.reshape(-1, height, width)
    pattern = float((stack[1:] * stack[:-1]).mean()) if len(stack) > 1 else 0.0
    shared = _shared(z), _shared(z.swapaxes(-1, -2))
    neighbours = max(abs(horizontal - shared[0]), abs(vertical - shared[1]))
    excess = {
        "ScanNoise(model) adds an offset of each row": shared[0] * math.sqrt(z.size * width) / 2,
        'ScanNoise(model, along="column") adds an offset of each column': shared[1] * math.sqrt(z.size * height) / 2,
        "WithMaps(model, gain, offset) gives pixels a gain and an offset of their own": pattern / error,
        "no term of the library describes correlated neighbours; bin the image, or fit every second pixel": neighbours
        / error,
    }
    remedies = sorted((name for name in excess if excess[name] > 4), key=lambda name: -excess[name])
    return SpatialStructure(rows, columns, horizontal, vertical, pattern, error, not remedies, tuple(remedies))


def _shared(z: NDArray[np.float64]) -> float:
    """Variance that all pixels of a row share: the covariance of its halves, which neighbours hardly touch."""
    half = z.shape[-1] // 2
    if half == 0:
        return 0.0
    left, right = z[..., :half].mean(-1), z[..., -half:].mean(-1)
    return float(((left - left.mean()) * (right - right.mean())).mean())


def _latent(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> NDArray[np.float64]:
    """Standardised residuals, shaped like the images, standard normal under the model."""
    bad = ~(torch.isfinite(signal) & torch.isfinite(observation))
    random = np.random.default_rng(0)
    if needs_image(noise_model):
        distribution = as_noise_distribution(noise_model(torch.where(bad, signal[~bad].mean(), signal)))
        value = torch.where(bad, observation[~bad].mean(), observation)
        both = (
            distribution.conditional_cdf(value)
            if isinstance(distribution, ScanDistribution)
            else (distribution.cdf_below(value), distribution.cdf(value))
        )
        below, at = (each.double().cpu().numpy() for each in both)
        u = below + random.random(below.shape) * np.maximum(at - below, 0)
    else:
        u = np.full(signal.shape, 0.5)
        good = ~bad
        u[good.cpu().numpy()] = probability_integral_transform(noise_model, signal[good], observation[good], random)
    z = torch.special.ndtri(torch.from_numpy(u).clamp(1e-6, 1 - 1e-6)).numpy()
    z[bad.cpu().numpy()] = 0
    return np.asarray((z - z.mean()) / z.std())
