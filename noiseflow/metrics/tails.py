"""Tails of residuals: the share of pixels beyond three, four and five standard deviations, against that of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.described import described
from noiseflow.distributions.wrappers.numerical import as_noise_distribution

BEYOND = (3.0, 4.0, 5.0)
"""Distances from the mean, standard deviations of the model."""

# Signals that represent all pixels; within one, the mean moves by less than a tenth of the range.
_LEVELS = 32
# Signals that represent one of several bins, which are narrow.
_LEVELS_OF_A_BIN = 8


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
        p_value: (3,) two-sided probabilities, under the model, of counts as far from the expected ones as the observed: twice the
            smaller of those of at most and of at least the observed count, as of a Poisson distribution.
    """

    signal: float
    observed: tuple[float, ...]
    expected: tuple[float, ...]
    p_value: tuple[float, ...]


def tails(noise_model: nn.Module, signal: Tensor, observation: Tensor) -> Tails:
    """Compare the tails of (N,) observations with those of a noise model."""
    return tails_of_bins(noise_model, signal, observation, [torch.arange(signal.numel(), device=signal.device)])[0]


@torch.no_grad()
def tails_of_bins(
    noise_model: nn.Module, signal: Tensor, observation: Tensor, bins: Sequence[Tensor]
) -> tuple[Tails, ...]:
    """Compare the tails in several bins, (M,) indices of pixels each; the model is asked once for all of them."""
    number = _LEVELS if len(bins) == 1 else _LEVELS_OF_A_BIN
    parts = [
        [one[part] for part in torch.tensor_split(torch.argsort(signal[one]), min(number, one.numel()))] for one in bins
    ]
    level = torch.stack([signal[part].double().mean() for one in parts for part in one])[:, None]
    given = as_noise_distribution(noise_model(level))
    mean, spread = given.mean.double(), given.variance.double().sqrt()
    reach = spread * torch.tensor(BEYOND, dtype=torch.float64, device=spread.device)
    infinity = torch.full_like(reach, torch.inf)
    outside = sum(
        given.log_interval_prob(low, high).double().exp()
        for low, high in ((-infinity, mean - reach), (mean + reach, infinity))
    )
    found, rows = [], iter(zip(mean - level, spread, torch.as_tensor(outside).cpu(), strict=True))
    for one in parts:
        seen, expected = np.zeros(len(BEYOND)), np.zeros(len(BEYOND))
        for part, (off, scale, beyond) in zip(one, rows, strict=False):
            # residuals are taken from their own signal, so that only the scale is that of the part
            distance = ((observation[part].double() - signal[part].double() - off) / scale).abs().cpu().numpy()
            seen += [(distance > k).sum() for k in BEYOND]
            expected += part.numel() * beyond.numpy()
        pixels = torch.cat(one)
        expected = expected.clip(0, pixels.numel())
        shares = (seen / pixels.numel(), expected / pixels.numel(), _two_sided(seen, expected))
        found.append(Tails(float(signal[pixels].double().mean()), *(tuple(map(float, each)) for each in shares)))
    return tuple(found)


def _two_sided(counts: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    seen, mean = torch.from_numpy(counts).double(), torch.from_numpy(expected)
    at_most = torch.special.gammaincc(seen + 1, mean)
    at_least = torch.where(seen > 0, torch.special.gammainc(seen.clamp(min=1), mean), 1.0)
    return np.asarray((2 * torch.minimum(at_most, at_least)).clamp(max=1.0))
