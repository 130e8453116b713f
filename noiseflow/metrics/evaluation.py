"""Evaluation of a noise model on held-out data: NLL, Jensen–Shannon, Bhattacharyya and PIT, with finite-sample floors.

Divergences compare a histogram of residuals with the *exact* bin probabilities of the model. They are biased: even under the true
model they are not zero. Each is therefore returned with its floor, its mean if the data come from the model.
"""

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from noiseflow.arguments import check, check_order, check_shapes
from noiseflow.arrays import Given, alike, as_tensor, floating, is_lazy
from noiseflow.described import described
from noiseflow.distributions.numerics.elementwise import LONG, PIECE
from noiseflow.distributions.pixels import needs_image, require_image
from noiseflow.distributions.wrappers.numerical import as_noise_distribution
from noiseflow.fitting.stream import judged_pixels, without_gaps
from noiseflow.metrics.distances import Tails, tails_of_bins
from noiseflow.metrics.distances import bhattacharyya as bhattacharyya
from noiseflow.metrics.distances import jensen_shannon as jensen_shannon
from noiseflow.metrics.distances import kolmogorov_smirnov as kolmogorov_smirnov
from noiseflow.models.baselines import Gaussian
from noiseflow.models.wrapper import as_noise_model
from noiseflow.statistics import bulk, own_random

_NUM_BINS = 64
_SIGNAL_GROUPS = 256


@described(jsd="nats", jsd_floor="nats", jsd_interval="nats", bd="nats", bd_floor="nats")
@dataclass(frozen=True)
class Divergence:
    """Distances between a histogram and a model, in nats.

    Attributes:
        jsd: Jensen–Shannon divergence.
        jsd_floor: mean of `jsd` if the data come from the model.
        jsd_interval: 90 % bootstrap interval.
        bc: Bhattacharyya coefficient, 1 for equal distributions.
        bc_floor: mean of `bc` if the data come from the model.
        bd: Bhattacharyya distance, −log bc.
        bd_floor: mean of `bd` if the data come from the model.
    """

    jsd: float
    jsd_floor: float
    jsd_interval: tuple[float, float]
    bc: float
    bc_floor: float
    bd: float
    bd_floor: float


@described(nll="nats per pixel", nll_error="nats per pixel")
@dataclass(frozen=True)
class Evaluation:
    """The evaluation of a noise model on held-out pixels.

    Attributes:
        nll: mean negative log-likelihood, nats per pixel; of level probabilities if the model is digitised.
        nll_error: its standard error.
        overall: divergence of the residuals of all pixels.
        per_signal: divergence of the residuals within each signal bin.
        pit: (20,) histogram of the probability integral transform; its density is 1 if the model is calibrated.
        ks: Kolmogorov–Smirnov distance of the PIT from the uniform distribution.
        ks_floor: distance that the true model exceeds with a probability of 5 %.
        num_pixels: number of pixels used.
        num_outside: number of pixels with a signal outside the range of the fit; 0 if the model was not fitted.
        num_improbable: number of impossible observations: not one of 10⁹ pixels is so unlikely under the model.
        tails: shares beyond 3, 4 and 5 standard deviations in each signal bin, observed and under the model.
    """

    nll: float
    nll_error: float
    overall: Divergence
    per_signal: tuple[Divergence, ...]
    pit: NDArray[np.float64]
    ks: float
    ks_floor: float
    num_pixels: int
    num_outside: int
    num_improbable: int
    tails: tuple[Tails, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """Why the figures may not be trusted, in words."""
        found, count = outside_in_words(self.num_outside, self.num_pixels), self.num_improbable
        if count:
            found.append(f"{count} of {self.num_pixels} observations are impossible under the model and decide the NLL")
        return tuple(found)

    @property
    def mean_jsd(self) -> float:
        """Mean Jensen–Shannon divergence over the signal bins."""
        return float(np.mean([divergence.jsd for divergence in self.per_signal]))

    @property
    def mean_jsd_floor(self) -> float:
        """Mean floor of the Jensen–Shannon divergence over the signal bins."""
        return float(np.mean([divergence.jsd_floor for divergence in self.per_signal]))


def evaluate(
    noise_model: nn.Module,
    signal: Tensor | NDArray[Any],
    observation: Tensor | NDArray[Any],
    *,
    num_bins: int = _NUM_BINS,
    num_signal_bins: int = 16,
    skip_non_finite: bool = False,
    seed: int = 0,
) -> Evaluation:
    """Evaluate a noise model on clean signals and observations that it was not fitted to.

    Args:
        signal, observation: tensors or arrays of equal shape, detector units; images (..., y, x) if the model needs them. Masked
            pixels are excluded. Dask arrays are computed block by block; if they have more than 10⁷ pixels, a random sample of
            that size is used.
        num_bins: number of bins of the residual histograms.
        num_signal_bins: number of equally populated bins along the signal.
        skip_non_finite: exclude pixels whose signal or observation is NaN or infinite, instead of raising an error.
        seed: seed of the bootstrap, of the randomised PIT and of the sample of large Dask arrays.

    Raises:
        ValueError: shapes differ, pixels are not finite, there are none, or signal and observation seem exchanged.

    If the model needs images (maps, offsets of rows, neighbours), all figures but the likelihood are those of normal scores
    (quantile residuals, doi:10.1080/10618600.1996.10474708), given the pixels before where they depend on each other.

    Warns of signals outside the range of the fit, and of observations that are impossible under the model.
    """
    check(num_bins=num_bins, num_signal_bins=num_signal_bins, seed=seed)
    random, given = own_random(seed), as_noise_model(noise_model)
    if needs_image(noise_model):
        signal, log_prob, score = _normal_scores(noise_model, signal, observation, skip_non_finite, random)
        noise_model, observation = Gaussian(1.0).double().to(signal.device), signal + score
    else:
        signal, observation = judged_pixels(signal, observation, skip_non_finite=skip_non_finite, seed=seed)
        check_order(signal, observation)
        log_prob = pixel_log_prob(noise_model, signal, observation)
    u = probability_integral_transform(noise_model, signal, observation, random)
    impossible = torch.isneginf(log_prob).to(signal.device)
    # a place in the distribution that single precision distinguishes from the ends is not improbable
    far = torch.from_numpy(np.minimum(u, 1 - u) < 1e-6).to(signal.device) & ~impossible
    groups = torch.tensor_split(torch.argsort(signal), min(num_signal_bins, signal.numel()))
    bins = [(signal[group], observation[group]) for group in groups]
    found = Evaluation(
        nll=-float(log_prob.mean()),
        nll_error=float(log_prob.std(correction=0)) / math.sqrt(log_prob.numel()),
        overall=divergence(noise_model, signal, observation, num_bins=num_bins, random=random),
        per_signal=_divergences(noise_model, bins, num_bins, _SIGNAL_GROUPS // 4, random),
        pit=np.histogram(u, bins=20, range=(0, 1), density=True)[0],
        ks=kolmogorov_smirnov(u),
        ks_floor=1.358 / math.sqrt(u.size),
        num_pixels=signal.numel(),
        num_outside=num_outside(given, signal),
        num_improbable=int(impossible.sum()) + _num_improbable(noise_model, signal[far], observation[far]),
        tails=tails_of_bins(noise_model, signal, observation, groups),
    )
    for note in found.notes:
        warnings.warn(note, stacklevel=2)
    return found


def num_outside(noise_model: nn.Module, signal: Any) -> int:
    """Number of signals, a tensor or array, outside the range of the last fit; 0 if the model was not fitted."""
    low, high = getattr(noise_model, "fitted_range", None) or (-math.inf, math.inf)
    return int(((signal < low) | (signal > high)).sum())


def outside_in_words(outside: int, of: int, *, few: float = 1e-3) -> list[str]:
    """A note if more than a few pixels have signals outside the range of the last fit, which may have seen a part of them."""
    note = (
        f"{outside} of {of} pixels have signals outside those that the model was fitted to; there a learnt model has the "
        "noise of the nearest end, and a physical one is extrapolated"
    )
    return [note] if outside > few * of else []


@torch.no_grad()
def _normal_scores(
    noise_model: nn.Module, signal: Any, observation: Any, skip_non_finite: bool, random: np.random.Generator
) -> tuple[Tensor, ...]:
    """Signals, log-likelihoods and normal scores, (N,) each, of the pixels of images."""
    if is_lazy(signal) or is_lazy(observation):
        raise ValueError(f"{type(noise_model).__name__} needs whole images; give them as arrays in memory")
    judged_pixels(signal, observation, skip_non_finite=skip_non_finite)  # checks them
    bad, *images = without_gaps(noise_model, signal, observation)
    signal, observation = (each.double() for each in images)
    parts = [as_noise_distribution(noise_model(s)).conditional(o) for s, o in _pieces(noise_model, signal, observation)]
    log_prob, below, at = (
        torch.cat([one.double().cpu().reshape(-1) for one in each]) for each in zip(*parts, strict=True)
    )
    u = below + torch.from_numpy(random.random(below.shape)) * (at - below).clamp(min=0)
    score = torch.special.ndtri(u.clamp(torch.finfo(u.dtype).tiny, 1 - torch.finfo(u.dtype).eps / 2))
    found = (signal.cpu(), log_prob, score)
    return tuple(each.reshape(-1)[~bad.cpu().reshape(-1)].to(signal.device) for each in found)


@torch.no_grad()
def _num_improbable(noise_model: nn.Module, signal: Tensor, observation: Tensor, *, least: float = 1e-12) -> int:
    """Number of pixels with P(at most the observation) or P(at least it) below `least`, computed in double precision."""
    count, signal, observation = 0, signal.double(), observation.double()
    for part, value in zip(torch.split(signal, LONG), torch.split(observation, LONG), strict=True):
        distribution, ends = as_noise_distribution(noise_model(part)), torch.full_like(value, math.inf)
        at = torch.log((distribution.cdf(value) - distribution.cdf_below(value)).clamp(min=0))
        above = torch.logaddexp(distribution.log_interval_prob(value, ends), at)
        count += int((torch.minimum(distribution.log_interval_prob(-ends, value), above) < math.log(least)).sum())
    return count


@torch.no_grad()
def pixel_log_prob(noise_model: nn.Module, signal: Given, observation: Given) -> Given:
    """Log-likelihood of each pixel, float64, (N,), computed in pieces; a Dask array for Dask arrays."""
    if is_lazy(signal) or is_lazy(observation):
        lazy = noise_model(signal if is_lazy(signal) else observation * 0 + signal)
        found: Given = lazy.log_prob(observation).astype(float)
        return found
    parts = (as_noise_distribution(noise_model(s)).log_prob(o) for s, o in _pieces(noise_model, signal, observation))
    return alike(torch.cat([part.double().cpu() for part in parts]), signal)


def _pieces(noise_model: nn.Module, *arrays: Any) -> Iterator[tuple[Tensor, ...]]:
    """The arrays in the parts that a model is asked about: image by image if it needs images."""
    given = [floating(each) for each in arrays]
    check_shapes(signal=given[0], observation=given[-1])
    if needs_image(noise_model):
        require_image(given[0], f"{type(noise_model).__name__} needs whole images")
        return zip(*(each.reshape(-1, *each.shape[-2:]) for each in given), strict=True)
    return zip(*(torch.split(each.reshape(-1), LONG) for each in given), strict=True)


def divergence(
    noise_model: nn.Module,
    signal: Tensor | NDArray[Any],
    observation: Tensor | NDArray[Any],
    *,
    num_bins: int = _NUM_BINS,
    num_groups: int = _SIGNAL_GROUPS,
    random: np.random.Generator | None = None,
) -> Divergence:
    """Divergence between the residuals observation − signal and the model's exact probabilities in the same bins.

    The signals, arrays of any shape, are represented by at least `num_groups` signals. Masked pixels are excluded.

    Raises:
        ValueError: as `evaluate`.
    """
    check(num_bins=num_bins, num_groups=num_groups)
    signal, observation = judged_pixels(signal, observation)
    random = random or np.random.default_rng(0)
    return _divergences(noise_model, [(signal, observation)], num_bins, num_groups, random)[0]


def _divergences(
    model: nn.Module, parts: list[tuple[Tensor, Tensor]], num_bins: int, num_groups: int, random: np.random.Generator
) -> tuple[Divergence, ...]:
    """`divergence` of several sets of pixels; the model is asked once for all of them."""
    counts, ends = [], []
    for signal, observation in parts:
        residual = (observation - signal).double().cpu().numpy()
        low, high = bulk(residual)
        if not high > low:  # nearly all residuals are equal, as for low counts: use bins of a few hundredths of a count
            low, high = low - 1.0, low + 2.0
        ends.append(np.concatenate([[-np.inf], np.linspace(low, high, num_bins - 1), [np.inf]]))
        counts.append(np.histogram(residual, ends[-1])[0])
    signals, edges = [signal for signal, _ in parts], [torch.from_numpy(one) for one in ends]
    masses = _bin_masses(model, signals, edges, num_groups)
    return tuple(compare_histogram(number, mass, random) for number, mass in zip(counts, masses, strict=True))


def residual_masses(
    noise_model: nn.Module,
    signal: Tensor | NDArray[Any],
    edges: Tensor | NDArray[Any],
    *,
    num_groups: int = _SIGNAL_GROUPS,
) -> NDArray[np.float64]:
    """Probability of each residual bin from the model's CDF, averaged over signals of any shape; (K,) for (K+1,) edges.

    The signals are represented by at least `num_groups` of them.

    Raises:
        ValueError: the edges do not increase, or signals are not finite.
    """
    signal, edges = judged_pixels(signal, signal)[0], as_tensor(edges)
    if edges.ndim != 1 or edges.numel() < 2 or not bool((edges[1:] > edges[:-1]).all()):
        raise ValueError("edges do not increase; give two or more sorted numbers, of which the outer may be infinite")
    return _bin_masses(noise_model, [signal], [edges], num_groups)[0]


@torch.no_grad()
def _bin_masses(
    noise_model: nn.Module, signals: list[Tensor], edges: list[Tensor], least: int
) -> list[NDArray[np.float64]]:
    """Probability of each residual bin of several sets of signals, with edges of their own but of one number."""
    levels, weights = [], []
    for signal, ends in zip(signals, edges, strict=True):
        values = signal.detach().double().cpu().sort().values.numpy()
        number = min(_num_groups(noise_model, signal, ends, least), len(values))
        starts = np.arange(number) * (len(values) // number) + np.minimum(np.arange(number), len(values) % number)
        weights.append(np.diff(starts, append=len(values)))
        levels.append(torch.from_numpy(np.add.reduceat(values, starts) / weights[-1]).to(signal))
    level = torch.cat(levels)
    bounds = [one[:, None].double() + ends.to(one.device).double() for one, ends in zip(levels, edges, strict=True)]
    parts = zip(torch.split(level, _SIGNAL_GROUPS), torch.split(torch.cat(bounds), _SIGNAL_GROUPS), strict=True)
    # differences of the CDF, absolutely accurate to rounding, take a third of the time of accurate tails
    below = torch.cat([as_noise_distribution(noise_model(s[:, None])).cdf(b).double().cpu() for s, b in parts])
    mass = torch.split(below.diff(dim=1).clamp(min=0), [len(one) for one in weights])
    found = [weight @ one.numpy() for weight, one in zip(weights, mass, strict=True)]
    return [one / one.sum() for one in found]


def _num_groups(
    noise_model: nn.Module,
    signal: Tensor,
    edges: Tensor,
    least: int,
    *,
    half: tuple[float, float] = (0.25, 0.75),
    shift: float = math.sqrt(5) - 2,
) -> int:
    """Number of signals that represent all: discrete pixel values must not cross bin edges within a group. Signals shift within a
    group by a part of the narrowest bin, irrational, so that groups have different phases relative to the levels."""
    if not any(getattr(module, "describes_single_readings", False) for module in noise_model.modules()):
        return least
    bins = edges[torch.isfinite(edges)].diff()
    finest = float(bins.min()) if bins.numel() else math.inf
    low, high = np.quantile(signal.cpu(), half)  # of few bright pixels, phases count little
    wanted = 2 * float(high - low) / (shift * finest)
    return int(min(max(wanted, least), PIECE // 2))


def compare_histogram(
    counts: ArrayLike, masses: ArrayLike, random: np.random.Generator, *, resamples: int = 64
) -> Divergence:
    """Divergence between counts (K,) and exact probabilities (K,), with floors from draws and a bootstrap interval. Raises
    ValueError if counts are not whole, negative or all 0, or the probabilities are none of as many bins."""
    found, expected = np.asarray(counts, np.float64), np.asarray(masses, np.float64)
    whole = np.isfinite(found) & (found >= 0) & (found == np.round(found))
    if found.ndim != 1 or not whole.all() or not found.sum() > 0:
        raise ValueError("counts are not whole numbers of pixels, or all are 0; give those of a histogram (K,)")
    total = int(found.sum())
    frequencies = found / total
    jensen_shannon(frequencies, expected)  # refuses masses that are no probabilities
    expected = expected / expected.sum()
    under_model = random.multinomial(total, expected, size=resamples) / total
    resampled = random.multinomial(total, frequencies, size=resamples) / total
    jsd, floor, spread = (jensen_shannon(each, expected) for each in (frequencies, under_model, resampled))
    # resampling the histogram doubles its bias: subtract the extra bias
    shift = float(spread.mean() - jsd)
    interval = np.quantile(spread - shift, (0.05, 0.95))
    bc, bc_floor = float(bhattacharyya(frequencies, expected)), float(bhattacharyya(under_model, expected).mean())
    return Divergence(
        jsd=float(jsd),
        jsd_floor=float(floor.mean()),
        jsd_interval=(max(0.0, float(interval[0])), float(interval[1])),
        bc=bc,
        bc_floor=bc_floor,
        bd=-math.log(bc) if bc > 0 else math.inf,
        bd_floor=-math.log(bc_floor),
    )


@torch.no_grad()
def probability_integral_transform(
    noise_model: nn.Module,
    signal: Tensor | NDArray[Any],
    observation: Tensor | NDArray[Any],
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """F(observation | signal) of each pixel, uniform under the true model; randomised within jumps of F."""
    pieces = _pieces(noise_model, signal, observation)
    both = (torch.stack(as_noise_distribution(noise_model(s)).conditional_cdf(o)) for s, o in pieces)
    below, at = np.concatenate([each.double().cpu().numpy().reshape(2, -1) for each in both], axis=1)
    return np.reshape(below + random.random(below.shape) * np.maximum(at - below, 0), signal.shape)


TABLE_HEADER = (
    *("model", "NLL (nats/px)", "± s.e.", "JSD ×100", "floor", "JSD/signal bin", "floor"),
    *("1−BC ×100", "floor", "BD ×100", "floor", "KS"),
)


def table_row(name: str, evaluation: Evaluation) -> list[str]:
    """The cells of `TABLE_HEADER` for one model."""
    one = evaluation.overall
    percent = [one.jsd, one.jsd_floor, evaluation.mean_jsd, evaluation.mean_jsd_floor]
    percent += [1 - one.bc, 1 - one.bc_floor, one.bd, one.bd_floor]
    likelihood = [f"{evaluation.nll:.4f}", f"{evaluation.nll_error:.4f}"]
    return [name, *likelihood, *(f"{100 * p:.3f}" for p in percent), f"{evaluation.ks:.4f}"]
