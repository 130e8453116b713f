"""Distances between distributions: of probability vectors, of a sample from the uniform distribution, and in the tails."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its packages load when they are first used
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from noiseflow.arguments import real
from noiseflow.described import described
from noiseflow.distributions.wrappers.numerical import as_noise_distribution


def jensen_shannon(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
    """Jensen–Shannon divergence in nats between probability vectors along the last axis (Lin 1991, doi:10.1109/18.61115). Raises
    ValueError if entries are negative or not finite, vectors do not sum to 1, or their lengths differ."""
    p, q = _probabilities(p, q)
    middle = (p + q) / 2
    entropies = scipy.special.rel_entr(p, middle) + scipy.special.rel_entr(q, middle)
    return np.asarray(entropies.sum(-1) / 2)


def bhattacharyya(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
    """Bhattacharyya coefficient Σ√(pq) along the last axis; the Bhattacharyya distance is its negative logarithm.

    Raises:
        ValueError: as `jensen_shannon`.
    """
    p, q = _probabilities(p, q)
    return np.asarray(np.sqrt(p * q).sum(-1))


def _probabilities(*given: ArrayLike, rounding: float = 1e-4) -> list[NDArray[np.float64]]:
    """The vectors as arrays; rounding errors are those of the sum of a million probabilities in single precision."""
    found = [real(each, "a histogram").double().cpu().numpy() for each in given]
    try:
        whole = np.broadcast_shapes(*(each.shape for each in found))
    except ValueError:
        whole = ()
    if not whole or any(each.shape[-1:] != whole[-1:] for each in found):
        raise ValueError(f"shapes {[each.shape for each in found]} do not agree; give vectors of equally many bins")
    for each in found:
        if not (np.isfinite(each).all() and (each >= 0).all()):
            raise ValueError("some probabilities are negative, NaN or infinite; give a histogram's shares")
        if np.abs(each.sum(-1) - 1).max(initial=0) > rounding:
            raise ValueError("some probabilities do not sum to 1; divide counts by their sum")
    return found


def kolmogorov_smirnov(u: ArrayLike) -> float:
    """Largest distance between the empirical CDF of `u` and the uniform one. Raises ValueError if there are no values, or some
    are outside [0, 1] or NaN."""
    ordered = np.sort(np.asarray(u, dtype=np.float64).ravel())
    if not ordered.size or not (ordered[0] >= 0 and ordered[-1] <= 1):  # NaN sorts last
        raise ValueError("there are no values, or some are not within [0, 1]; give a probability integral transform")
    steps = np.arange(ordered.size + 1) / ordered.size
    return float(max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max()))


BEYOND = range(3, 6)
"""Distances from the mean, standard deviations of the model."""


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


@torch.no_grad()
def tails_of_bins(
    noise_model: nn.Module, signal: Tensor, observation: Tensor, bins: Sequence[Tensor], *, levels: int = 32
) -> tuple[Tails, ...]:
    """Compare the tails in several bins, (M,) indices of pixels each; the model is asked once for all of them. So many signals
    represent the pixels of a bin; if it has all of them, the mean moves by less than a tenth of the range within one."""
    parts = [
        [one[part] for part in torch.tensor_split(torch.argsort(signal[one]), min(levels, one.numel()))] for one in bins
    ]
    level = torch.stack([signal[part].double().mean() for one in parts for part in one])[:, None]
    given = as_noise_distribution(noise_model(level))
    mean, spread = given.mean.double(), given.variance.double().sqrt()
    reach = spread * torch.tensor([*BEYOND], dtype=torch.float64, device=spread.device)
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
        counts, rate = torch.from_numpy(seen), torch.from_numpy(expected)
        at_most = torch.special.gammaincc(counts + 1, rate)
        at_least = torch.where(counts > 0, torch.special.gammainc(counts.clamp(min=1), rate), 1.0)
        two_sided = (2 * torch.minimum(at_most, at_least)).clamp(max=1.0).numpy()
        shares = (seen / pixels.numel(), expected / pixels.numel(), two_sided)
        found.append(Tails(float(signal[pixels].double().mean()), *(tuple(map(float, each)) for each in shares)))
    return tuple(found)
