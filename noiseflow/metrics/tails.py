"""Tails of residuals: the share of pixels beyond three, four and five standard deviations, against that of the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor, nn

from noiseflow.described import described
from noiseflow.distributions.wrappers.numerical import as_noise_distribution

BEYOND = (3.0, 4.0, 5.0)
"""Distances from the mean, standard deviations of the model."""

# Signals that represent a bin; within one, the mean moves by less than a tenth of the bin.
_LEVELS = 32


@described(signal="detector units")
@dataclass(frozen=True)
class Tails:
    """Shares of pixels farther from the mean than 3, 4 and 5 standard deviations, all as the model has them.

    Jensen–Shannon divergences hardly see tails: 0.6 % of the pixels beyond four standard deviations instead of 0.02 % leave them
    at their floor.

    Attributes:
        signal: mean signal of the pixels.
        observed: (3,) shares of the pixels.
        expected: (3,) shares under the model.
        p_value: (3,) two-sided probabilities, under the model, of counts at least as unlikely as the observed ones.
    """

    signal: float
    observed: tuple[float, ...]
    expected: tuple[float, ...]
    p_value: tuple[float, ...]


@torch.no_grad()
def tails(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> Tails:
    """Compare the tails of (N,) observations with those of a noise model.

    Example:
        >>> import noiseflow, torch
        >>> from noiseflow.metrics.tails import tails
        >>> noise = torch.randn(10_000, generator=torch.Generator().manual_seed(0))
        >>> noise[:50] *= 10
        >>> found = tails(noiseflow.Gaussian(noise.std().item()), torch.zeros(10_000), noise)
        >>> found.observed[1] > 20 * found.expected[1]
        True
    """
    order = torch.argsort(signal)
    groups = torch.tensor_split(order, min(_LEVELS, signal.numel()))
    level = torch.stack([signal[group].double().mean() for group in groups])[:, None]
    given = as_noise_distribution(noise_model(level))
    mean, spread = given.mean.double(), given.variance.double().sqrt()
    reach = spread * torch.tensor(BEYOND, dtype=torch.float64, device=spread.device)
    infinity = torch.full_like(reach, torch.inf)
    outside = sum(
        given.log_interval_prob(low, high).double().exp()
        for low, high in ((-infinity, mean - reach), (mean + reach, infinity))
    )
    weight = torch.tensor([group.numel() for group in groups], dtype=torch.float64) / signal.numel()
    expected = (weight @ torch.as_tensor(outside).cpu()).clamp(0, 1).numpy()
    # within a group, residuals are taken from their own signal, so that only the scale is that of the group
    moved = [
        (observation[g].double() - signal[g].double() - (mean - level)[i]) / spread[i] for i, g in enumerate(groups)
    ]
    distance = torch.cat(moved).abs().cpu().numpy()
    counts = np.array([(distance > k).sum() for k in BEYOND])
    p_values = [
        float(stats.binomtest(int(c), distance.size, float(p)).pvalue) for c, p in zip(counts, expected, strict=True)
    ]
    return Tails(
        float(signal.double().mean()), tuple(counts / distance.size), tuple(map(float, expected)), tuple(p_values)
    )
