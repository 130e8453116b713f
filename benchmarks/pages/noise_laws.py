"""Noises whose law is known exactly and that no model of the library contains: half to develop on, half to judge on.

    python -m benchmarks.pages.noise_laws [--law telegraph rice] [--model Mixture8 select] [--pixels 50000] [--again]

prints the Kullback-Leibler divergence of each fitted model from each law, nats per pixel, by quadrature, and the processor time.
Rows of default settings are kept in results/noise_laws.json, from which `noise_models page` writes the table of the page.

Each is a family of laws p(observation | signal), with draws, and nodes and exact log-densities (or log-probabilities of levels)
for the divergence of a fitted model by quadrature.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special, stats
from torch import nn

import noiseflow
from benchmarks.pages import FOLDER, noise_rivals
from benchmarks.provenance import origin
from noiseflow.io import atomic_path

RESULTS = FOLDER / "results" / "noise_laws.json"
PIXELS = 50_000
Array = NDArray[np.float64]
_PANELS, _ORDER, _TAIL = 400, 6, 1e-10


@dataclass(frozen=True)
class Law:
    """A conditional law.

    Args:
        title: what it is.
        draw: function from signals and a NumPy generator to observations.
        log_prob: function from a signal and (Q,) observations to log-densities or log-probabilities.
        ends: function from a signal to the range of observations; or for discrete laws, to all their levels.
        levels: whether the law is discrete.
        signals: range of the signals.
        masses: observations with a probability of their own beside a density, such as clipping limits.
        steep: whether the density may be infinite at both ends of the range.
    """

    title: str
    draw: Callable[[Array, np.random.Generator], Array]
    log_prob: Callable[[float, Array], Array]
    ends: Callable[[float], Any]
    levels: bool = False
    signals: tuple[float, float] = (0.2, 1.0)
    masses: tuple[float, ...] = ()
    steep: bool = False

    def data(self, count: int, seed: int) -> tuple[Array, Array]:
        """Signals, uniform over their range, and observations."""
        random = np.random.default_rng(seed)
        signal = random.uniform(*self.signals, count)
        return signal, self.draw(signal, random)

    def nodes(self, signal: float) -> tuple[Array, Array, Array]:
        """Observations, their exact log-probabilities or log-densities, and the weights of the integral over the law."""
        if self.levels:
            value = np.asarray(self.ends(signal), float)
            log_prob = self.log_prob(signal, value)
            return value, log_prob, np.exp(log_prob)
        low, high = self.ends(signal)
        node, weight = np.polynomial.legendre.leggauss(_ORDER)
        place = ((2 * np.arange(_PANELS)[:, None] + 1 + node) / (2 * _PANELS)).ravel()
        length = np.tile((high - low) / (2 * _PANELS) * weight, _PANELS)
        if self.steep:
            place, length = np.sin(np.pi / 2 * place) ** 2, length * np.pi / 2 * np.sin(np.pi * place)
        value = low + (high - low) * place
        log_prob = self.log_prob(signal, value)
        share = np.exp(log_prob) * length
        if self.masses:
            limits = np.array(self.masses)
            mass = self.log_prob(signal, limits)
            return np.append(value, limits), np.append(log_prob, mass), np.append(share, np.exp(mass))
        return value, log_prob, share


@torch.no_grad()
def divergence(law: Law, model: nn.Module, *, num_signals: int = 48) -> float:
    """Kullback–Leibler divergence of a model from the law, nats per pixel, by quadrature: the mean over evenly spaced signals."""
    low, high = law.signals
    total = []
    for signal in low + (high - low) * (np.arange(num_signals) + 0.5) / num_signals:
        value, log_prob, share = law.nodes(float(signal))
        at = torch.full((value.size,), float(signal), dtype=torch.float64)
        found = model(at.float()).log_prob(torch.from_numpy(value).float()).double().numpy()
        inside = share > 0
        total.append(float(np.sum(share[inside] * (log_prob - found)[inside]) / share.sum()))
    return float(np.mean(total))


def _scipy(
    title: str, at: Callable[[Any], Any], *, levels: bool = False, signals: tuple[float, float] = (0.2, 1.0)
) -> Law:
    """A law of `scipy.stats`, frozen at each signal."""

    def ends(signal: float) -> Any:
        first, last = at(signal).ppf([_TAIL, 1 - _TAIL])
        return np.arange(first, last + 1) if levels else (first, last)

    def log_prob(signal: float, value: Array) -> Array:
        frozen = at(signal)
        return np.asarray(frozen.logpmf(value) if levels else frozen.logpdf(value))

    return Law(title, lambda s, random: at(s).rvs(random_state=random), log_prob, ends, levels, signals)


def _mixed(title: str, parts: Callable[[Any], list[tuple[float, Any]]]) -> Law:
    """A continuous mixture of laws of `scipy.stats`; `parts` gives shares and frozen laws at each signal."""

    def draw(signal: Array, random: np.random.Generator) -> Array:
        found = parts(signal)
        chosen = random.choice(len(found), signal.size, p=[share for share, _ in found])
        return np.choose(chosen, [law.rvs(size=signal.size, random_state=random) for _, law in found])

    def log_prob(signal: float, value: Array) -> Array:
        return np.asarray(np.logaddexp.reduce([np.log(share) + law.logpdf(value) for share, law in parts(signal)]))

    def ends(signal: float) -> tuple[float, float]:
        ends = [law.ppf([_TAIL, 1 - _TAIL]) for _, law in parts(signal)]
        return min(first for first, _ in ends), max(last for _, last in ends)

    return Law(title, draw, log_prob, ends)


def _coded(title: str, code: Callable[[Any], Any], decode: Callable[[Any], Any], signals: tuple[float, float]) -> Law:
    """Poisson counts that are coded, rounded, and decoded: levels that are not equidistant."""

    def log_prob(signal: float, value: Array) -> Array:
        count = np.arange(int(signal + 12 * np.sqrt(signal) + 30))
        level = np.round(code(count))
        masses = stats.poisson.pmf(count, signal)
        return np.log(np.array([masses[level == each].sum() for each in np.round(code(value))]) + 1e-300)

    def ends(signal: float) -> Array:
        count = np.arange(*stats.poisson.ppf([_TAIL, 1 - _TAIL], signal) + np.array([0, 1]))
        return np.asarray(decode(np.unique(np.round(code(count)))))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return np.asarray(decode(np.round(code(random.poisson(signal)))))

    return Law(title, draw, log_prob, ends, levels=True, signals=signals)


def _rounded(title: str, log_cdf_below: Callable[[float, Array], Array], draw: Any, reach: Any, signals: Any) -> Law:
    """Rounded to whole numbers; `log_cdf_below` is the distribution function before."""

    def log_prob(signal: float, value: Array) -> Array:
        return np.log(np.maximum(log_cdf_below(signal, value + 0.5) - log_cdf_below(signal, value - 0.5), 1e-300))

    return Law(title, lambda s, random: np.round(draw(s, random)), log_prob, reach, levels=True, signals=signals)


def _growing(signal: Any) -> Any:
    """A standard deviation that grows like shot noise over read noise."""
    return np.sqrt(0.03**2 + 0.07**2 * signal)


def _clipped(low: float, high: float) -> Law:
    def log_prob(signal: float, value: Array) -> Array:
        inside = stats.norm(signal, 2 * _growing(signal))
        density = inside.logpdf(value)
        density = np.where(value <= low, inside.logcdf(low), density)
        return np.asarray(np.where(value >= high, inside.logsf(high), density))

    return Law(
        "clipped at both ends",
        lambda s, random: (s + 2 * _growing(s) * random.standard_normal(s.size)).clip(low, high),
        log_prob,
        lambda s: (low, high),
        signals=(0.0, 1.0),
        masses=(low, high),
    )


def _zero_inflated(share: float) -> Law:
    def log_prob(signal: float, value: Array) -> Array:
        return np.log((1 - share) * stats.poisson.pmf(value, signal) + share * (value == 0))

    return Law(
        "zero-inflated Poisson",
        lambda s, random: random.poisson(s) * (random.random(s.size) > share),
        log_prob,
        lambda s: np.arange(0, stats.poisson.ppf(1 - _TAIL, s) + 1),
        levels=True,
        signals=(1.0, 15.0),
    )


def _electron_cdf(gain: float, read_noise: float) -> Callable[[float, Array], Array]:
    def cdf(signal: float, value: Array) -> Array:
        rate = signal / gain
        count = np.arange(int(rate + 12 * np.sqrt(rate) + 30))
        return np.asarray(
            stats.norm.cdf((value[:, None] - gain * count) / (gain * read_noise)) @ stats.poisson.pmf(count, rate)
        )

    return cdf


def _low_counts(gain: float = 8.0, read_noise: float = 0.25) -> Law:
    return _rounded(
        "low counts, rounded",
        _electron_cdf(gain, read_noise),
        lambda s, random: gain * (random.poisson(s / gain) + read_noise * random.standard_normal(s.size)),
        lambda s: np.arange(-20, s + 12 * np.sqrt(gain * s) + 200),
        (2.0, 40.0),
    )


def _eight_bits(gain: float = 2.0, read_noise: float = 1.5) -> Law:
    """Shot and read noise, rounded and clipped at both ends."""
    cdf = _electron_cdf(gain, read_noise)

    def log_prob(signal: float, value: Array) -> Array:
        below = np.where(value <= 0, 0, cdf(signal, value - 0.5))
        return np.log(np.maximum(np.where(value >= 255, 1, cdf(signal, value + 0.5)) - below, 1e-300))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        electrons = random.poisson(signal / gain) + read_noise * random.standard_normal(signal.size)
        return (gain * electrons).round().clip(0, 255)

    return Law("8-bit camera", draw, log_prob, lambda s: np.arange(256), levels=True, signals=(1.0, 240.0))


def _multiplied(gain: float = 10.0, shape: float = 2.0) -> Law:
    """Photoelectrons, each multiplied by a gamma-distributed gain."""

    def cdf(signal: float, value: Array) -> Array:
        count = np.arange(1, int(signal / gain + 12 * np.sqrt(signal / gain) + 30))
        parts = stats.gamma.cdf(value[:, None], shape * count, scale=gain / shape)
        return np.asarray(parts @ stats.poisson.pmf(count, signal / gain) + (value > 0) * np.exp(-signal / gain))

    return _rounded(
        "photoelectrons, multiplied and rounded",
        cdf,
        lambda s, random: gain * random.gamma(shape * random.poisson(s / gain)) / shape,
        lambda s: np.arange(0, s + 16 * np.sqrt(1.5 * gain * s) + 100),
        (20.0, 200.0),
    )


def _uneven_codes() -> Law:
    """A converter whose odd codes are a third wider than its even ones."""

    def edge(code: Any) -> Any:
        return code - 0.5 - np.where(np.mod(code, 2) == 1, 1 / 6, -1 / 6) / 2 * 1.0

    def log_prob(signal: float, value: Array) -> Array:
        law = stats.norm(signal, 2 + 0.02 * signal)
        return np.log(np.maximum(law.cdf(edge(value + 1)) - law.cdf(edge(value)), 1e-300))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        value = signal + (2 + 0.02 * signal) * random.standard_normal(signal.size)
        code = np.round(value)
        return code - (value < edge(code)) + (value >= edge(code + 1))

    return Law(
        "uneven codes",
        draw,
        log_prob,
        lambda s: np.arange(np.floor(s - 8 * (2 + 0.02 * s)), s + 8 * (2 + 0.02 * s)),
        levels=True,
        signals=(20.0, 200.0),
    )


def _crosstalk(share: float) -> Law:
    """Each detected photon triggers a second count with the probability `share`."""

    def log_prob(signal: float, value: Array) -> Array:
        second = np.arange(value.max() // 2 + 1)[:, None]
        photons = value - second
        masses = stats.poisson.pmf(photons, signal / (1 + share)) * stats.binom.pmf(
            second, np.maximum(photons, 0), share
        )
        return np.log(np.where(photons >= second, masses, 0).sum(0))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        photons = random.poisson(signal / (1 + share))
        return np.asarray(photons + random.binomial(photons, share))

    return Law(
        "photon counter with crosstalk",
        draw,
        log_prob,
        lambda s: np.arange(0, s + 14 * np.sqrt(s) + 20),
        levels=True,
        signals=(1.0, 20.0),
    )


def _saturated(most: int = 60) -> Law:
    """Negative binomial counts of a register that stops at `most`."""

    def log_prob(signal: float, value: Array) -> Array:
        law = stats.nbinom(6, 6 / (6 + signal))
        return np.asarray(np.where(value == most, law.logsf(most - 1), law.logpmf(value)))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return np.minimum(random.negative_binomial(6, 6 / (6 + signal)), most)

    levels = np.arange(most + 1)
    return Law("saturating negative binomial", draw, log_prob, lambda s: levels, levels=True, signals=(3.0, 45.0))


def _log_normal_counts(width: float = 0.15) -> Law:
    """Log-normal, rounded."""

    def cdf(signal: float, value: Array) -> Array:
        return np.asarray(stats.lognorm(width, scale=signal * np.exp(-(width**2) / 2)).cdf(value))

    return _rounded(
        "log-normal, rounded",
        cdf,
        lambda s, random: s * np.exp(width * random.standard_normal(s.size) - width**2 / 2),
        lambda s: np.arange(0, 3 * s + 20),
        (10.0, 150.0),
    )


def _logit_normal(width: float = 0.4) -> Law:
    """A Gaussian before a saturating response between 0 and 1."""

    def log_prob(signal: float, value: Array) -> Array:
        return stats.norm.logpdf(_logit(value), _logit(signal), width) - np.log(value * (1 - value))

    return Law(
        "logit-normal",
        lambda s, random: 1 / (1 + np.exp(-_logit(s) - width * random.standard_normal(s.size))),
        log_prob,
        lambda s: tuple(1 / (1 + np.exp(-_logit(s) - width * stats.norm.ppf([_TAIL, 1 - _TAIL])))),
        signals=(0.1, 0.9),
    )


def _logit(value: Any) -> Any:
    return np.log(value / (1 - value))


def _landau(gain: float = 10.0, width: float = 1.5, read_noise: float = 3.0, size: int = 2048) -> Law:
    """An integrating electron detector: the energy that each electron deposits has Moyal's law, with mean `gain`."""
    place = gain - width * (np.euler_gamma + np.log(2))
    turn = 2 * np.pi * np.fft.fftfreq(size)
    pulse = np.exp(
        1j * turn * place - 1j * turn * width * np.log(2) + special.loggamma(0.5 - 1j * turn * width)
    ) / np.sqrt(np.pi)

    def log_prob(signal: float, value: Array) -> Array:
        whole = np.exp(signal / gain * (pulse - 1) - (turn * read_noise) ** 2 / 2) * np.sinc(turn / (2 * np.pi))
        masses = np.fft.fft(whole).real / size
        return np.log(np.maximum(masses[value.astype(int) % size], 1e-300))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        electrons = random.poisson(signal / gain)
        energy = place - width * np.log(random.standard_normal(electrons.sum()) ** 2)
        total = np.bincount(np.repeat(np.arange(signal.size), electrons), energy, signal.size)
        return np.round(total + read_noise * random.standard_normal(signal.size))

    levels = np.arange(-30, 700)
    return Law(
        "deposited energies (Landau tails)", draw, log_prob, lambda s: levels, levels=True, signals=(10.0, 150.0)
    )


def _logarithmic(shot: float = 0.05, slope: float = 0.4, dark: float = 0.1) -> Law:
    """Gamma-distributed currents behind a logarithmic amplifier."""

    def current(value: Any) -> Any:
        return dark * np.expm1(value / slope)

    def log_prob(signal: float, value: Array) -> Array:
        inside = stats.gamma.logpdf(current(value), current(signal) / shot, scale=shot)
        return np.asarray(inside + np.log(dark / slope) + value / slope)

    def amplified(current: Any) -> Any:
        return slope * np.log1p(current / dark)

    return Law(
        "logarithmic amplifier",
        lambda s, random: amplified(shot * random.gamma(current(s) / shot)),
        log_prob,
        lambda s: tuple(amplified(stats.gamma.ppf([_TAIL, 1 - _TAIL], current(s) / shot, scale=shot))),
        signals=(0.4, 1.0),
    )


def _dual_gain(switch: float = 0.5) -> Law:
    """A low-noise read-out, replaced by a noisier one where its value exceeds a threshold."""

    def low(signal: Any) -> Any:
        return np.sqrt(0.01**2 + 0.03**2 * signal)

    def high(signal: Any) -> Any:
        return np.sqrt(0.04**2 + 0.03**2 * signal)

    def log_prob(signal: float, value: Array) -> Array:
        kept, replaced = stats.norm(signal, low(signal)), stats.norm(signal, high(signal))
        return np.logaddexp(
            np.where(value < switch, kept.logpdf(value), -np.inf), kept.logsf(switch) + replaced.logpdf(value)
        )

    def draw(signal: Array, random: np.random.Generator) -> Array:
        first = signal + low(signal) * random.standard_normal(signal.size)
        return np.where(first < switch, first, signal + high(signal) * random.standard_normal(signal.size))

    # the switch in the middle, at an edge of the panels
    return Law("two gains, chosen by value", draw, log_prob, lambda s: (switch - 1, switch + 1), signals=(0.1, 1.0))


def _flicker(width: float = 0.1) -> Law:
    """Counts from a source whose brightness fluctuates log-normally."""
    node, weight = np.polynomial.hermite_e.hermegauss(60)
    bright = np.exp(width * node - width**2 / 2)

    def log_prob(signal: float, value: Array) -> Array:
        return np.log(np.maximum(stats.poisson.pmf(value[:, None], signal * bright) @ weight / weight.sum(), 1e-300))

    return Law(
        "counts of a flickering source",
        lambda s, random: random.poisson(s * np.exp(width * random.standard_normal(s.size) - width**2 / 2)),
        log_prob,
        lambda s: np.arange(0, s + 12 * np.sqrt(s + (width * s) ** 2) + 30),
        levels=True,
        signals=(5.0, 100.0),
    )


def _averaged(frames: int = 4) -> Law:
    """The mean of frames that are each rounded and clipped at 0."""

    def width(signal: Any) -> Any:
        return np.sqrt(2.0**2 + 0.5 * signal)

    def log_prob(signal: float, value: Array) -> Array:
        edges = np.arange(256) + 0.5
        below = np.concatenate([stats.norm.cdf(edges[:-1], signal, width(signal)), [1.0]])
        masses = one = np.diff(below, prepend=0.0)
        for _ in range(frames - 1):
            masses = np.convolve(masses, one)
        return np.log(np.maximum(masses[np.round(frames * value).astype(int)], 1e-300))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        noise = width(signal) * random.standard_normal((frames, signal.size))
        return np.asarray(np.round(signal + noise).clip(0, 255).mean(0))

    levels = np.arange(frames * 130) / frames
    return Law("mean of four clipped frames", draw, log_prob, lambda s: levels, levels=True, signals=(1.0, 60.0))


def _missing_codes(most: int = 4095) -> Law:
    """A 12-bit converter that never gives a code of remainder 3 by 4, of shot and read noise that is cut off at 0."""

    def width(signal: Any) -> Any:
        return np.sqrt(2.0**2 + 0.5 * signal)

    def log_prob(signal: float, value: Array) -> Array:
        law = stats.norm(signal, width(signal))
        top = value + np.where(np.mod(value, 4) == 2, 1.5, 0.5)
        return np.log(np.maximum((law.cdf(top) - law.cdf(np.maximum(value - 0.5, 0))) / law.sf(0), 1e-300))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        value = stats.truncnorm.rvs(-signal / width(signal), np.inf, signal, width(signal), random_state=random)
        code = np.round(value).clip(0, most)
        return np.asarray(code - (np.mod(code, 4) == 3))

    return Law(
        "12 bits with missing codes",
        draw,
        log_prob,
        lambda s: (lambda code: code[np.mod(code, 4) != 3])(np.arange(0, np.ceil(s + 8 * width(s)))),
        levels=True,
        signals=(5.0, 200.0),
    )


def _laplace_over_shot(gain: float = 0.02, width: float = 0.03) -> Law:
    """Shot noise with Laplace-distributed read noise."""

    def log_prob(signal: float, value: Array) -> Array:
        count = np.arange(int(signal / gain + 12 * np.sqrt(signal / gain) + 30))[:, None]
        inside = stats.poisson.logpmf(count, signal / gain) + stats.laplace.logpdf(value, gain * count, width)
        return np.asarray(special.logsumexp(inside, 0))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return np.asarray(gain * random.poisson(signal / gain) + random.laplace(0, width, signal.size))

    def ends(signal: float) -> tuple[float, float]:
        low, high = stats.poisson.ppf([_TAIL, 1 - _TAIL], signal / gain) * gain
        return low - 20 * width, high + 20 * width

    return Law("Laplace read noise over shot noise", draw, log_prob, ends)


def _hum(swing: float = 0.06, width: float = 0.03) -> Law:
    """Gaussian noise and a sinusoidal interference of random phase."""
    shift = swing * np.sin(np.pi * (np.arange(200) + 0.5) / 200 - np.pi / 2)[:, None]

    def log_prob(signal: float, value: Array) -> Array:
        inside = stats.norm.logpdf(value, signal + shift, width * (0.5 + signal))
        return np.asarray(special.logsumexp(inside, 0) - np.log(shift.size))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        phase = random.uniform(0, 2 * np.pi, signal.size)
        return np.asarray(signal + swing * np.sin(phase) + width * (0.5 + signal) * random.standard_normal(signal.size))

    return Law("mains hum over Gaussian noise", draw, log_prob, lambda s: (s - 0.5, s + 0.5))


def _two_slopes(knee: float = 64.0, coarse: float = 4.0) -> Law:
    """Shot and read noise behind a converter with steps of 1 below the knee and `coarse` steps above it."""

    def width(signal: Any) -> Any:
        return np.sqrt(1.5**2 + 0.8 * signal)

    def code(value: Any) -> Any:
        return np.where(value < knee, np.floor(value), knee + coarse * np.floor((value - knee) / coarse))

    def log_prob(signal: float, value: Array) -> Array:
        law = stats.norm(signal, width(signal))
        return np.log(np.maximum(law.cdf(value + np.where(value < knee, 1, coarse)) - law.cdf(value), 1e-300))

    return Law(
        "converter of two slopes",
        lambda s, random: code(s + width(s) * random.standard_normal(s.size)),
        log_prob,
        lambda s: np.unique(code(np.arange(np.floor(s - 9 * width(s)), s + 9 * width(s)))),
        levels=True,
        signals=(10.0, 150.0),
    )


def _clusters(mean: float = 2.0) -> Law:
    """Neyman's type A: a Poisson number of events, each of which gives a Poisson number of counts."""

    def log_prob(signal: float, value: Array) -> Array:
        events = np.arange(int(signal / mean + 14 * np.sqrt(signal / mean) + 40))[:, None]
        inside = stats.poisson.logpmf(events, signal / mean) + stats.poisson.logpmf(value, mean * events)
        return np.asarray(special.logsumexp(inside, 0))

    return Law(
        "clusters of counts (Neyman)",
        lambda s, random: random.poisson(mean * random.poisson(s / mean)),
        log_prob,
        lambda s: np.arange(0, s + 16 * np.sqrt((1 + mean) * s) + 40),
        levels=True,
        signals=(5.0, 60.0),
    )


def _wrapped(title: str, noise: Any, low: float, period: float, signals: tuple[float, float]) -> Law:
    """Values that start again at the end of a period; `noise` gives a frozen law of `scipy.stats` at each signal."""

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return np.asarray(low + np.mod(noise(signal).rvs(random_state=random) - low, period))

    def log_prob(signal: float, value: Array) -> Array:
        turns = period * np.arange(-8, 9)[:, None]
        return np.asarray(special.logsumexp(noise(signal).logpdf(value + turns), 0))

    return Law(title, draw, log_prob, lambda s: (low, low + period), signals=signals)


def _stored(title: str, code: Callable[[Any], Any], rates: tuple[float, float]) -> Law:
    """Poisson counts that are stored as an increasing function of theirs; the signal is that function of the rate."""
    every = code(np.arange(1.0 + 4 * rates[1] + 60))
    even = np.linspace(*rates, 4096)

    def rate(signal: Any) -> Any:
        return np.interp(signal, code(even), even)

    def count(value: Array) -> Array:
        return np.asarray(np.searchsorted((every[1:] + every[:-1]) / 2, value))

    def ends(signal: float) -> Array:
        first, last = stats.poisson.ppf([_TAIL, 1 - _TAIL], rate(signal))
        return np.asarray(code(np.arange(first, last + 1)))

    return Law(
        title,
        lambda s, random: np.asarray(code(random.poisson(rate(s)).astype(float))),
        lambda s, value: np.asarray(stats.poisson.logpmf(count(value), rate(s))),
        ends,
        levels=True,
        signals=tuple(code(np.array(rates))),
    )


def _table(size: int = 48, width: float = 3.0) -> Law:
    """A converter with a table of levels at random distances."""
    levels = np.cumsum(np.random.default_rng(5).uniform(0.5, 6, size))
    edges = (levels[1:] + levels[:-1]) / 2

    def log_prob(signal: float, value: Array) -> Array:
        below = stats.norm.cdf(np.r_[-np.inf, edges, np.inf], signal, width + 0.02 * signal)
        return np.log(np.maximum(np.diff(below)[np.searchsorted(edges, value)], 1e-300))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        value = signal + (width + 0.02 * signal) * random.standard_normal(signal.size)
        return np.asarray(levels[np.searchsorted(edges, value)])

    return Law("levels of a random table", draw, log_prob, lambda s: levels, levels=True, signals=(20.0, 140.0))


def _orientation(period: float = 180.0) -> Law:
    """Orientations of dipoles, a von Mises law of the doubled angle whose concentration depends on the orientation."""

    turn = 2 * np.pi / period

    def concentration(signal: Any) -> Any:
        return 6 + 4 * np.cos(turn * signal)

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return np.asarray(np.mod(signal + random.vonmises(0, concentration(signal)) / turn, period))

    def log_prob(signal: float, value: Array) -> Array:
        return np.asarray(stats.vonmises.logpdf(turn * (value - signal), concentration(signal)) + np.log(turn))

    return Law("orientation in [0, 180°), von Mises", draw, log_prob, lambda s: (0.0, period), signals=(0.0, period))


def _blinking(on: float = 4.0, off: float = 1.5) -> Law:
    """Counts of an emitter that is dark for a beta-distributed share of the exposure."""
    node, weight = special.roots_jacobi(80, off - 1, on - 1)
    bright = (node + 1) / 2 * (on + off) / on

    def log_prob(signal: float, value: Array) -> Array:
        return np.log(np.maximum(stats.poisson.pmf(value[:, None], signal * bright) @ weight / weight.sum(), 1e-300))

    return Law(
        "counts of a blinking emitter (Poisson-beta)",
        lambda s, random: random.poisson(s * random.beta(on, off, s.size) * (on + off) / on),
        log_prob,
        lambda s: np.arange(0, s * (on + off) / on + 12 * np.sqrt(1.5 * s) + 30),
        levels=True,
        signals=(5.0, 80.0),
    )


def _projection(slices: int = 8) -> Law:
    """The maximum of slices of equal signal, each with shot and read noise."""

    def log_prob(signal: float, value: Array) -> Array:
        one = stats.norm(signal, _growing(signal))
        return np.asarray(np.log(slices) + (slices - 1) * one.logcdf(value) + one.logpdf(value))

    return Law(
        "maximum projection of eight slices",
        lambda s, random: (s + _growing(s) * random.standard_normal((slices, s.size))).max(0),
        log_prob,
        lambda s: (s - 5 * _growing(s), s + 8 * _growing(s)),
    )


def _ratio(counts: float = 200.0, read_noise: float = 5.0) -> Law:
    """The ratio of two channels with shot and read noise, of which the second has as many expected counts as given."""
    below = np.linspace(-9, 9, 721)

    def widths(signal: Any) -> tuple[Any, float]:
        return np.sqrt(signal * counts + read_noise**2), float(np.sqrt(counts + read_noise**2))

    def log_prob(signal: float, value: Array) -> Array:
        first, second = widths(signal)
        other = counts + second * below
        parts = stats.norm.logpdf(value[:, None] * other, signal * counts, first) + stats.norm.logpdf(below)
        return np.asarray(special.logsumexp(parts, 1, b=other * (below[1] - below[0])))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        first, second = widths(signal)
        above = signal * counts + first * random.standard_normal(signal.size)
        return np.asarray(above / (counts + second * random.standard_normal(signal.size)))

    return Law("ratio of two channels", draw, log_prob, lambda s: (s - 0.8, s + 1.6), signals=(0.2, 1.5))


def _through_response(title: str, decode: Callable[[Any], Any], width: Any, low: float, high: float) -> Law:
    """Gaussian noise of a width given by the value, stored as whole codes of an increasing response; the signal is the code of
    the mean, and `decode` gives the value of a code."""
    values, bounds = decode(np.arange(high + 1)), decode(np.arange(high) + 0.5)

    def log_prob(signal: float, value: Array) -> Array:
        law = stats.norm(decode(signal), width(decode(signal)))
        below, above = np.r_[-np.inf, bounds], np.r_[bounds, np.inf]
        upper = below > decode(signal)
        masses = np.where(upper, law.sf(below) - law.sf(above), law.cdf(above) - law.cdf(below))
        return np.log(np.maximum(masses, 1e-300))[value.astype(int)]

    def draw(signal: Array, random: np.random.Generator) -> Array:
        value = decode(signal) + width(decode(signal)) * random.standard_normal(signal.size)
        return np.searchsorted(bounds, value).astype(float)

    return Law(title, draw, log_prob, lambda s: np.arange(values.size), levels=True, signals=(low * high, 0.9 * high))


def _dithered(width: float = 0.2) -> Law:
    """Noise finer than a step, with triangular dither, rounded."""
    node, weight = np.polynomial.legendre.leggauss(64)
    shift = np.r_[(node - 1) / 2, (node + 1) / 2]
    share = np.r_[weight, weight] / 2 * (1 - abs(shift))

    def cdf(signal: float, value: Array) -> Array:
        return np.asarray(stats.norm.cdf((value[:, None] - signal - shift) / (width + 0.004 * signal)) @ share)

    return _rounded(
        "triangular dither, rounded",
        cdf,
        lambda s, random: (
            s + (width + 0.004 * s) * random.standard_normal(s.size) + random.triangular(-1, 0, 1, s.size)
        ),
        lambda s: np.arange(np.floor(s - 8), s + 9),
        (20.0, 120.0),
    )


def _shares_by_signal(width: float = 0.03, apart: float = 0.12) -> Law:
    """Two peaks; the share of the upper one grows from 0.05 to 0.95."""

    def share(signal: Any) -> Any:
        return 0.05 + 0.9 * (signal - 0.2) / 0.8

    def log_prob(signal: float, value: Array) -> Array:
        lower, upper = (stats.norm.logpdf(value, signal + shift, width) for shift in (0, apart))
        return np.logaddexp(np.log(1 - share(signal)) + lower, np.log(share(signal)) + upper)

    def draw(signal: Array, random: np.random.Generator) -> Array:
        noise = width * random.standard_normal(signal.size)
        return signal + apart * (random.random(signal.size) < share(signal)) + noise

    ends = 7 * width
    return Law("two peaks, shares by signal", draw, log_prob, lambda s: (s - ends, s + apart + ends))


def _interferogram(looks: int = 3) -> Law:
    """The phase of an interferogram of some looks (Lee et al. 1994, doi:10.1109/36.312890), whose coherence depends on it."""

    def coherence(signal: Any) -> Any:
        return 0.75 + 0.15 * np.cos(signal)

    def log_prob(signal: float, value: Array) -> Array:
        square = coherence(signal) ** 2
        beta = coherence(signal) * np.cos(value - signal)
        first = special.gamma(looks + 0.5) / (2 * np.sqrt(np.pi) * special.gamma(looks)) * beta
        first = first / (1 - beta**2) ** (looks + 0.5)
        return np.log((1 - square) ** looks * (first + special.hyp2f1(looks, 1, 0.5, beta**2) / (2 * np.pi)))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        one, other = random.standard_normal((2, looks, signal.size, 2)) @ [1, 1j]
        rest = np.sqrt(1 - coherence(signal) ** 2)
        phase = np.angle((one.conj() * (coherence(signal) * one + rest * other)).sum(0))
        return np.mod(signal + phase + np.pi, 2 * np.pi) - np.pi

    ends = -np.pi, np.pi
    return Law("interferometric phase, three looks", draw, log_prob, lambda s: ends, signals=ends)


def _dead_time(dead: float = 0.05) -> Law:
    """Counts of a detector that does not respond for a twentieth of the exposure after each count."""

    def at_least(count: Array, rate: float) -> Array:
        left = 1 - (count - 1) * dead
        found = stats.gamma.cdf(np.maximum(left, 0), np.maximum(count, 1), scale=1 / rate)
        return np.where(count <= 0, 1.0, np.where(left <= 0, 0.0, found))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        count, time_ = np.zeros(signal.size), random.exponential(1 / signal)
        while (time_ <= 1).any():
            count += time_ <= 1
            time_ += dead + random.exponential(1 / signal)
        return count

    return Law(
        "counter with dead time",
        draw,
        lambda s, value: np.log(np.maximum(at_least(value, s) - at_least(value + 1, s), 1e-300)),
        lambda s: np.arange(22),
        levels=True,
        signals=(1.0, 30.0),
    )


def _inverse_gaussian_counts(shape: float = 8.0) -> Law:
    """Counts of a source whose brightness has an inverse Gaussian law."""
    node, weight = np.polynomial.legendre.leggauss(400)
    bright = np.exp(4 * node)
    share = stats.invgauss(1 / shape, scale=shape).pdf(bright) * bright * weight

    def log_prob(signal: float, value: Array) -> Array:
        return np.log(np.maximum(stats.poisson.pmf(value[:, None], signal * bright) @ share / share.sum(), 1e-300))

    return Law(
        "counts of inverse Gaussian brightness",
        lambda s, random: random.poisson(s * random.wald(1.0, shape, s.size)),
        log_prob,
        lambda s: np.arange(0, 8 * s + 60),
        levels=True,
        signals=(3.0, 60.0),
    )


def _beta_binomial(most: int = 64, spread: float = 40.0) -> Law:
    """A number of 64 trials whose chance fluctuates."""

    def chances(signal: Any) -> tuple[Any, Any]:
        return spread * signal / most, spread * (1 - signal / most)

    return Law(
        "beta-binomial of 64",
        lambda s, random: random.binomial(most, random.beta(*chances(s))),
        lambda s, value: stats.betabinom.logpmf(value, most, *chances(s)),
        lambda s: np.arange(most + 1),
        levels=True,
        signals=(4.0, 60.0),
    )


def _kumaraswamy(power: float = 4.0) -> Law:
    """A law on [0, 1] with the signal as its median."""

    def other(signal: Any) -> Any:
        return np.log(0.5) / np.log1p(-(signal**power))

    def quantile(signal: Any, share: Any) -> Any:
        return (1 - (1 - share) ** (1 / other(signal))) ** (1 / power)

    def log_prob(signal: float, value: Array) -> Array:
        steep = np.log(power * other(signal)) + (power - 1) * np.log(value)
        return np.asarray(steep + (other(signal) - 1) * np.log1p(-(value**power)))

    return Law(
        "Kumaraswamy in [0, 1]",
        lambda s, random: quantile(s, random.random(s.size)),
        log_prob,
        lambda s: (quantile(s, _TAIL), quantile(s, 1 - _TAIL)),
        signals=(0.3, 0.85),
    )


def _rectified() -> Law:
    """Shot and read noise of which negative values are stored as 0."""

    def law(signal: Any) -> Any:
        return stats.norm(signal, 2 * _growing(signal))

    return Law(
        "rectified at 0",
        lambda s, random: law(s).rvs(random_state=random).clip(0),
        lambda s, value: np.where(value <= 0, law(s).logcdf(0), law(s).logpdf(value)),
        lambda s: (1e-12, s + 16 * _growing(s)),
        signals=(0.0, 0.7),
        masses=(0.0,),
    )


def _median(impulses: float = 0.1, low: float = -0.2, high: float = 1.4) -> Law:
    """The median of five frames with shot and read noise and with impulses."""

    def log_prob(signal: float, value: Array) -> Array:
        law, even = stats.norm(signal, _growing(signal)), stats.uniform(low, high - low)
        below = (1 - impulses) * law.cdf(value) + impulses * even.cdf(value)
        above = (1 - impulses) * law.sf(value) + impulses * even.sf(value)
        density = (1 - impulses) * law.pdf(value) + impulses * even.pdf(value)
        return np.log(30 * np.maximum(below * above, 1e-140) ** 2 * density)

    def draw(signal: Array, random: np.random.Generator) -> Array:
        frames = signal + _growing(signal) * random.standard_normal((5, signal.size))
        impulse = random.random(frames.shape) < impulses
        return np.asarray(np.median(np.where(impulse, random.uniform(low, high, frames.shape), frames), 0))

    return Law("median of five frames with impulses", draw, log_prob, lambda s: (low, high))


def _dropped_bits(step: int = 4, gain: float = 2.0, read_noise: float = 2.0) -> Law:
    """Shot and read noise whose two lowest bits are cut off."""
    cdf = _electron_cdf(gain, read_noise)

    def draw(signal: Array, random: np.random.Generator) -> Array:
        electrons = random.poisson(signal / gain) + read_noise * random.standard_normal(signal.size)
        return step * np.floor(gain * electrons / step)

    return Law(
        "two lowest bits dropped",
        draw,
        lambda s, value: np.log(np.maximum(cdf(s, value + step) - cdf(s, value), 1e-300)),
        lambda s: step * np.arange(-12.0, np.ceil((s + 14 * np.sqrt(gain * s) + 60) / step)),
        levels=True,
        signals=(5.0, 200.0),
    )


def _cascades(share: float = 0.15) -> Law:
    """Each count triggers a Poisson number of further ones, and so on (Borel)."""

    def log_prob(signal: float, value: Array) -> Array:
        first = signal * (1 - share)
        rate = first + share * value
        return np.asarray(np.log(first) + (value - 1) * np.log(rate) - rate - special.gammaln(value + 1))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        total = new = random.poisson(signal * (1 - share))
        while new.any():
            new = random.poisson(share * new)
            total = total + new
        return np.asarray(total)

    return Law(
        "counts with cascades of crosstalk (Borel)",
        draw,
        log_prob,
        lambda s: np.arange(0, s + 16 * np.sqrt(s / (1 - share) ** 2) + 40),
        levels=True,
        signals=(1.0, 25.0),
    )


def _gain_speckle(looks: float = 6.0, width: float = 0.2) -> Law:
    """Speckle times a log-normal gain."""
    node, weight = np.polynomial.hermite_e.hermegauss(80)
    gain = np.exp(width * node - width**2 / 2)[:, None]

    def log_prob(signal: float, value: Array) -> Array:
        parts = stats.gamma.logpdf(value, looks, scale=signal * gain / looks)
        return np.asarray(special.logsumexp(parts, 0, b=weight[:, None] / weight.sum()))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        gains = np.exp(width * random.standard_normal(signal.size) - width**2 / 2)
        return np.asarray(signal * gains * random.gamma(looks, size=signal.size) / looks)

    return Law("speckle of fluctuating gain", draw, log_prob, lambda s: (0.02 * s, 9 * s))


def _with_masses(
    title: str,
    masses: dict[float, Callable[[Any], Any]],
    rest: Callable[[Any], Any],
    ends: Callable[[float], Any],
    signals: tuple[float, float] = (0.2, 1.0),
) -> Law:
    """A law of `scipy.stats` of which shares, functions of the signal, are values instead."""

    def draw(signal: Array, random: np.random.Generator) -> Array:
        found, place = rest(signal).rvs(size=signal.size, random_state=random), random.random(signal.size)
        for value, share in masses.items():
            found = np.where((place >= 0) & (place < share(signal)), value, found)
            place = place - share(signal)
        return np.asarray(found)

    def log_prob(signal: float, value: Array) -> Array:
        left = 1 - sum(share(signal) for share in masses.values())
        found = np.log(left) + rest(signal).logpdf(value)
        for each, share in masses.items():
            found = np.where(value == each, np.log(share(signal)), found)
        return np.asarray(found)

    return Law(title, draw, log_prob, ends, signals=signals, masses=tuple(masses))


def _compound(title: str, shape: float, scale: float, signals: tuple[float, float]) -> Law:
    """A Poisson number of gamma-distributed energies, 0 without any (Tweedie)."""

    def rate(signal: Any) -> Any:
        return signal / (shape * scale)

    def log_prob(signal: float, value: Array) -> Array:
        count = np.arange(1, int(rate(signal) + 12 * np.sqrt(rate(signal)) + 40))[:, None]
        parts = stats.poisson.logpmf(count, rate(signal)) + stats.gamma.logpdf(
            np.maximum(value, 1e-300), shape * count, scale=scale
        )
        return np.asarray(np.where(value == 0, -rate(signal), np.logaddexp.reduce(parts)))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return scale * random.standard_gamma(shape * random.poisson(rate(signal)))

    def ends(signal: float) -> tuple[float, float]:
        most = stats.poisson.isf(_TAIL, rate(signal))
        return 1e-9, float(stats.gamma.isf(_TAIL, shape * most, scale=scale))

    return Law(title, draw, log_prob, ends, signals=signals, masses=(0.0,))


def _thresholded(title: str, threshold: float, *, shrunk: bool, signals: tuple[float, float]) -> Law:
    """Shot and read noise of which values within the threshold of 0 are 0, and others are moved towards 0 by it if `shrunk`."""
    move = threshold if shrunk else 0.0

    def law(signal: Any) -> Any:
        return stats.norm(signal, _growing(np.abs(signal)))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        value = law(signal).rvs(random_state=random)
        return np.where(np.abs(value) <= threshold, 0.0, value - np.sign(value) * move)

    def log_prob(signal: float, value: Array) -> Array:
        before = value + np.sign(value) * move
        density = np.where(np.abs(before) > threshold, law(signal).logpdf(before), -np.inf)
        upper, lower = (law(signal).logcdf(each) for each in (threshold, -threshold))
        mass = upper + np.log1p(-np.exp(lower - upper))
        return np.asarray(np.where(value == 0, mass, density))

    # the jumps of the density lie at edges of the panels: 0 and both thresholds are multiples of 1/100 of the range
    reach = 10 * threshold
    return Law(title, draw, log_prob, lambda s: (-reach, reach), signals=signals, masses=(0.0,))


def _by_value(title: str, switches: tuple[float, float], widths: tuple[float, float, float]) -> Law:
    """Three read-outs of which the value of the first chooses one."""

    def chances(signal: Any) -> list[Any]:
        first = stats.norm(signal, widths[0])
        return [first.cdf(switches[1]) - first.cdf(switches[0]), first.sf(switches[1])]

    def log_prob(signal: float, value: Array) -> Array:
        kept = np.where(value < switches[0], stats.norm.logpdf(value, signal, widths[0]), -np.inf)
        others = (
            np.log(np.maximum(chance, 1e-300)) + stats.norm.logpdf(value, signal, width)
            for chance, width in zip(chances(signal), widths[1:], strict=True)
        )
        return np.asarray(np.logaddexp.reduce([kept, *others]))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        first = signal + widths[0] * random.standard_normal(signal.size)
        width = np.where(first < switches[1], widths[1], widths[2])
        return np.where(first < switches[0], first, signal + width * random.standard_normal(signal.size))

    return Law(title, draw, log_prob, lambda s: (switches[0] - 1.5, switches[0] + 1.5), signals=(0.1, 1.0))


def _crossing(width: float = 0.03) -> Law:
    """Two peaks, one of which moves through the other as the signal grows while the shares change fast in the middle."""

    def parts(signal: Any) -> list[tuple[Any, Any]]:
        share = 1 / (1 + np.exp(-(signal - 0.6) / 0.04))
        moved = signal + 0.4 * (signal - 0.6)
        return [(1 - share, stats.norm(signal, width)), (share, stats.norm(moved, 1.5 * width))]

    def draw(signal: Array, random: np.random.Generator) -> Array:
        (_, first), (share, second) = parts(signal)
        upper = random.random(signal.size) < share
        return np.where(upper, second.rvs(random_state=random), first.rvs(random_state=random))

    def log_prob(signal: float, value: Array) -> Array:
        return np.asarray(np.logaddexp.reduce([np.log(share) + law.logpdf(value) for share, law in parts(signal)]))

    return Law("two peaks that cross", draw, log_prob, lambda s: (s - 0.5, s + 0.5))


def _counts_with_zeros(title: str, value: float, share: Callable[[Any], Any], signals: tuple[float, float]) -> Law:
    """Poisson counts of which a share, a function of the signal, is one value instead."""

    def log_prob(signal: float, found: Array) -> Array:
        return np.log((1 - share(signal)) * stats.poisson.pmf(found, signal) + share(signal) * (found == value))

    def draw(signal: Array, random: np.random.Generator) -> Array:
        return np.where(random.random(signal.size) < share(signal), value, random.poisson(signal))

    def ends(signal: float) -> Array:
        return np.unique([*np.arange(stats.poisson.isf(_TAIL, signal) + 1), value])

    return Law(title, draw, log_prob, ends, levels=True, signals=signals)


def laws() -> dict[str, Law]:
    """Every law by name; those of `JUDGED` were not used to develop the models."""
    normal = stats.norm
    return {
        "log-normal": _scipy("log-normal", lambda s: stats.lognorm(0.2, scale=s * np.exp(-0.02))),
        "rice": _scipy("Rice", lambda s: stats.rice(s / 0.15, scale=0.15), signals=(0.0, 1.0)),
        "generalised": _scipy("generalised Gaussian", lambda s: stats.gennorm(1.3, s, 0.05 + 0.1 * s)),
        "skewed-t": _scipy("skewed t", lambda s: stats.jf_skew_t(3, 6, s, 0.03 + 0.06 * s)),
        "clipped": _clipped(0.1, 0.9),
        "root-coded": _coded("√-coded Poisson", lambda k: 2 * np.sqrt(k), lambda c: c**2 / 4, (20.0, 400.0)),
        "zero-inflated": _zero_inflated(0.1),
        "negative-binomial": _scipy(
            "negative binomial", lambda s: stats.nbinom(8, 8 / (8 + s)), levels=True, signals=(3.0, 40.0)
        ),
        "spikes": _mixed("cosmic spikes", lambda s: [(0.99, normal(s, _growing(s))), (0.01, stats.expon(s, 0.5))]),
        "x-rays": _mixed(
            "X-rays, of one mean at all signals",
            lambda s: [(0.98, normal(s, _growing(s))), (0.02, stats.exponnorm(0.8 / _growing(s), s, _growing(s)))],
        ),
        "low-counts": _low_counts(),
        "telegraph": _mixed(
            "telegraph (two peaks)",
            lambda s: [(0.7, normal(s, 0.03 + 0 * s)), (0.3, normal(s + 0.08 + 0.05 * s, 0.03 + 0 * s))],
        ),
        "laplace": _scipy("Laplace", lambda s: stats.laplace(s, 0.02 + 0.05 * s)),
        "speckle": _scipy("speckle (4 looks)", lambda s: stats.gamma(4, scale=s / 4)),
        "gumbel": _scipy("Gumbel", lambda s: stats.gumbel_r(s, 0.03 + 0.05 * s)),
        "t-by-signal": _scipy(
            "Student t, 3 to 20 degrees", lambda s: stats.t(3 + 17 * s, s, 0.05 + 0 * s), signals=(0.0, 1.0)
        ),
        "binomial": _scipy(
            "saturating counter (binomial)", lambda s: stats.binom(100, s / 100), levels=True, signals=(5.0, 90.0)
        ),
        "log-coded": _coded(
            "log-coded Poisson", lambda k: 8 * np.log1p(k / 10), lambda c: 10 * np.expm1(c / 8), (20.0, 400.0)
        ),
        "uneven-codes": _uneven_codes(),
        "inverse-gaussian": _scipy("inverse Gaussian", lambda s: stats.invgauss(0.05 / s, scale=s**2 / 0.05)),
        "three-peaks": _mixed(
            "three peaks",
            lambda s: [
                (0.5, normal(s, 0.02 + 0.01 * s)),
                (0.3, normal(s + 0.1, 0.02 + 0.01 * s)),
                (0.2, normal(s - 0.08, 0.02 + 0.01 * s)),
            ],
        ),
        "logistic-outliers": _mixed(
            "logistic with dead pixels",
            lambda s: [(0.98, stats.logistic(s, 0.04 + 0 * s)), (0.02, normal(0.0 * s, 0.02))],
        ),
        "maxwell": _scipy("Maxwell", lambda s: stats.maxwell(scale=s / 1.596)),
        "beta": _scipy("bounded (beta)", lambda s: stats.beta(15 * s, 15 * (1 - s)), signals=(0.15, 0.85)),
        "crosstalk": _crosstalk(0.2),
        "decay": _scipy("exponentially modified Gaussian", lambda s: stats.exponnorm(2.0, s - 0.06, 0.03 + 0.02 * s)),
        "impulses": _mixed(
            "impulse noise", lambda s: [(0.95, normal(s, _growing(s))), (0.05, stats.uniform(0 * s - 0.1, 1.3))]
        ),
        "weibull": _scipy("Weibull", lambda s: stats.weibull_min(1.8, scale=1.12 * s)),
        "secant": _scipy("hyperbolic secant", lambda s: stats.hypsecant(s, 0.03 + 0.04 * s)),
        "asymmetric-laplace": _scipy("asymmetric Laplace", lambda s: stats.laplace_asymmetric(1.5, s, 0.02 + 0.05 * s)),
        "thermal": _scipy(
            "thermal light (Bose-Einstein)", lambda s: stats.nbinom(1, 1 / (1 + s)), levels=True, signals=(1.0, 10.0)
        ),
        "gain-switching": _mixed(
            "switching gain",
            lambda s: [(0.5, normal(s, 0.02 + 0.02 * s)), (0.5, normal(1.15 * s, 0.03 + 0.03 * s))],
        ),
        "two-gains": _scipy("two read-outs, switched at 0.6", lambda s: normal(s, np.where(s < 0.6, 0.02, 0.06))),
        "eight-bits": _eight_bits(),
        "multiplied": _multiplied(),
        "triangular": _scipy("triangular dither", lambda s: stats.triang(0.5, 0.9 * s - 0.05, 0.1 + 0.2 * s)),
        "dark-subtracted": _scipy(
            "counts minus dark counts (Skellam)",
            lambda s: stats.skellam(s + 4, 4 + 0 * s),
            levels=True,
            signals=(1.0, 30.0),
        ),
        "saturated": _saturated(),
        "two-detectors": _mixed(
            "two detectors, unlabelled",
            lambda s: [
                (0.6, normal(s, np.sqrt(0.02**2 + 0.05**2 * s))),
                (0.4, normal(0.97 * s + 0.01, 0.05 + 0.04 * s)),
            ],
        ),
        "log-normal-counts": _log_normal_counts(),
        "logit-normal": _logit_normal(),
        "landau": _landau(),
        "logarithmic": _logarithmic(),
        "dual-gain": _dual_gain(),
        "flicker": _flicker(),
        "averaged": _averaged(),
        "weibull-speckle": _scipy(
            "Weibull speckle, shape by signal",
            lambda s: stats.weibull_min(1.5 + 3 * s, scale=s / special.gamma(1 + 1 / (1.5 + 3 * s))),
        ),
        "three-gains": _mixed(
            "three gains, unlabelled",
            lambda s: [
                (0.5, normal(s, 0.02 + 0.03 * s)),
                (0.3, normal(0.85 * s, 0.02 + 0.03 * s)),
                (0.2, normal(1.2 * s, 0.03 + 0.03 * s)),
            ],
        ),
        "missing-codes": _missing_codes(),
        "laplace-shot": _laplace_over_shot(),
        "hum": _hum(),
        "two-slopes": _two_slopes(),
        "clusters": _clusters(),
        "log-speckle": _scipy(
            "logarithm of speckle", lambda s: stats.loggamma(3, s - 0.1 * special.digamma(3), 0.1 + 0 * s)
        ),
        "phase": _wrapped("phase in [-π, π)", lambda s: normal(s, 0.4), -np.pi, 2 * np.pi, (-np.pi, np.pi)),
        "log1p-counts": _stored("counts stored as log(1 + n)", np.log1p, (1.0, 300.0)),
        "uniform": _scipy("uniform", lambda s: stats.uniform(s - 0.1, 0.2)),
        "exponential": _scipy("exponential above an edge", lambda s: stats.expon(s - 0.1, 0.1)),
        "angle": _wrapped(
            "angle in [0, 2π), scatter by signal",
            lambda s: stats.logistic(s, 0.15 + 0.1 * s),
            0.0,
            2 * np.pi,
            (0.0, 2 * np.pi),
        ),
        "anscombe-counts": _stored(
            "counts of gain 1.7 in Anscombe's scale", lambda n: 2 * np.sqrt(1.7 * n + 3 / 8), (2.0, 200.0)
        ),
        "half-normal": _scipy("half-normal", lambda s: stats.halfnorm(s - 0.08, 0.05 + 0.1 * s)),
        "shifted-gamma": _scipy(
            "gamma of shape 1.3 above an edge", lambda s: stats.gamma(1.3, s**2 - 0.1, 0.03 + 0.08 * s)
        ),
        "widening-uniform": _scipy(
            "uniform, width by signal", lambda s: stats.uniform(s - np.sqrt(0.01 * s), 2 * np.sqrt(0.01 * s))
        ),
        "arcsine": replace(
            _scipy("sinusoid of random phase", lambda s: stats.arcsine(s - 0.1 * s, 0.2 * s)),
            ends=lambda s: (0.9 * s, 1.1 * s),
            steep=True,
        ),
        "table": _table(),
        "orientation": _orientation(),
        "blinking": _blinking(),
        "projection": _projection(),
        "ratio": _ratio(),
        "gamma-coded": _through_response(
            "8 bits, gamma-coded",
            lambda code: (code / 255) ** 2.2,
            lambda value: np.sqrt(0.01**2 + 0.03**2 * value),
            0.25,
            255,
        ),
        "dithered": _dithered(),
        "shape-by-signal": _scipy(
            "generalised Gaussian, shape by signal", lambda s: stats.gennorm(1 + 3.75 * (s - 0.2), s, 0.05 + 0.1 * s)
        ),
        "shares-by-signal": _shares_by_signal(),
        "interferogram": _interferogram(),
        "log-coded-12": _through_response(
            "12 bits, log-coded",
            lambda code: 16 * (2 ** (code / 512) - 1),
            lambda value: np.sqrt(4 + value),
            0.2,
            3600,
        ),
        "dead-time": _dead_time(),
        "nakagami": _scipy("Nakagami amplitude, shape by signal", lambda s: stats.nakagami(0.7 + 3 * s, scale=s)),
        "inverse-gaussian-counts": _inverse_gaussian_counts(),
        "beta-binomial": _beta_binomial(),
        "kumaraswamy": _kumaraswamy(),
        "johnson": _scipy(
            "Johnson SU, skew by signal", lambda s: stats.johnsonsu(3.75 * (s - 0.2) - 1.5, 1.8, s, 0.06 + 0.06 * s)
        ),
        "rectified": _rectified(),
        "median": _median(),
        "dropped-bits": _dropped_bits(),
        "merging": _mixed(
            "two peaks that merge",
            lambda s: [(0.5, normal(s - 0.1 * (1 - s), 0.03)), (0.5, normal(s + 0.1 * (1 - s), 0.03))],
        ),
        "cascades": _cascades(),
        "gain-speckle": _gain_speckle(),
        "hue": _wrapped(
            "hue in [0, 360), triangular",
            lambda s: stats.triang(0.5, s - 60 + 20 * np.cos(np.pi * s / 180), 120 - 40 * np.cos(np.pi * s / 180)),
            0.0,
            360.0,
            (0.0, 360.0),
        ),
        "rain": _compound("compound Poisson-gamma (Tweedie)", 2.0, 0.25, (0.2, 2.0)),
        "dropouts": _with_masses(
            "log-normal with zeros, share by signal",
            {0.0: lambda s: 1 / (1 + np.exp(1 + 4 * (s - 0.6)))},
            lambda s: stats.lognorm(0.25, scale=s),
            lambda s: (1e-9, s * np.exp(0.25 * stats.norm.isf(_TAIL))),
        ),
        "blanks": _with_masses(
            "blanks, flagged as -1",
            {-1.0: lambda s: 0.02 + 0.2 * (s - 0.2)},
            lambda s: normal(s, _growing(s)),
            lambda s: (s - 7 * _growing(s), s + 7 * _growing(s)),
        ),
        "hard-threshold": _thresholded("hard threshold", 0.1, shrunk=False, signals=(-0.1, 0.4)),
        "flags": _counts_with_zeros("counts, flagged as 4095 by signal", 4095.0, lambda s: 0.01 + s / 300, (2.0, 60.0)),
        "energies": _compound("sum of exponential energies", 1.0, 0.3, (0.1, 2.0)),
        "dead-zone": _thresholded("dead zone (soft threshold)", 0.08, shrunk=True, signals=(-0.3, 0.3)),
        "filled": _with_masses(
            "gamma with missing pixels filled by 0.5",
            {0.5: lambda s: 0.04 + 0 * s},
            lambda s: stats.gamma(12, scale=s / 12),
            lambda s: tuple(stats.gamma(12, scale=s / 12).ppf([_TAIL, 1 - _TAIL])),
        ),
        "zero-one": _with_masses(
            "beta with masses at 0 and 1",
            {0.0: lambda s: 0.25 * (1 - s) ** 2, 1.0: lambda s: 0.3 * s**3},
            lambda s: stats.beta(8 * s, 8 * (1 - s)),
            lambda s: (1e-9, 1 - 1e-9),
            signals=(0.25, 0.75),
        ),
        "three-by-value": _by_value("three gains, chosen by value", (0.4, 0.7), (0.02, 0.04, 0.08)),
        "crossing": _crossing(),
        "zeros-by-signal": _counts_with_zeros(
            "counts with zeros, share by signal", 0.0, lambda s: 0.4 * np.exp(-s / 8), (1.0, 25.0)
        ),
        "step-of-width": _scipy(
            "width with a smooth step", lambda s: normal(s, 0.02 + 0.06 / (1 + np.exp(-(s - 0.55) / 0.02)))
        ),
    }


UNSEEN = (
    "dark-subtracted",
    "saturated",
    "two-detectors",
    "log-normal-counts",
    "logit-normal",
    "landau",
    "logarithmic",
    "flicker",
    "averaged",
    "weibull-speckle",
    "three-gains",
    "missing-codes",
    "laplace-shot",
    "hum",
    "two-slopes",
    "clusters",
    "log-speckle",
    "angle",
    "anscombe-counts",
    "half-normal",
    "shifted-gamma",
    "widening-uniform",
    "arcsine",
    "table",
    "orientation",
    "blinking",
    "projection",
    "ratio",
    "gamma-coded",
    "dithered",
    "shape-by-signal",
    "shares-by-signal",
    "interferogram",
    "log-coded-12",
    "dead-time",
    "nakagami",
    "inverse-gaussian-counts",
    "beta-binomial",
    "kumaraswamy",
    "johnson",
    "rectified",
    "median",
    "dropped-bits",
    "merging",
    "cascades",
    "gain-speckle",
    "hue",
    "energies",
    "dead-zone",
    "filled",
    "zero-one",
    "three-by-value",
    "crossing",
    "zeros-by-signal",
    "step-of-width",
)
"""Laws defined before any model was fitted to them."""
JUDGED = (
    "laplace",
    "speckle",
    "gumbel",
    "t-by-signal",
    "binomial",
    "log-coded",
    "uneven-codes",
    "inverse-gaussian",
    "three-peaks",
    "logistic-outliers",
    "weibull",
    "secant",
    "asymmetric-laplace",
    "thermal",
    "triangular",
    "gain-switching",
    "two-gains",
    "eight-bits",
    "multiplied",
    *UNSEEN,
)

MODELS: dict[str, Callable[[], nn.Module]] = {
    "Mixture8": lambda: noiseflow.Mixture(8),
    "Mixture4": lambda: noiseflow.Mixture(4),
    "SharedMixture8": lambda: noiseflow.Mixture(8, shared_shape=True),
    "RadialFlow": noiseflow.RadialFlow,
    "SplineFlow": noiseflow.SplineFlow,
    "PhysicsFlow": noiseflow.PhysicsFlow,
}


RIVALS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "zuko NSF": (lambda: noise_rivals.make("zuko", {})[0], 500),
    "zuko GMM-8": (noise_rivals.ZukoMixture, 400),
}
"""Models of zuko with the settings that `noise_models search` found best, and the steps that take some ten seconds."""


def measure(law: Law, name: str, count: int, seed: int) -> tuple[str, float, float]:
    """The fitted model's name, its divergence from the law, and the processor time of the fit (s)."""
    signal, observation = (torch.from_numpy(np.asarray(each, dtype=np.float32)) for each in law.data(count, seed))
    started = time.process_time()
    if name == "select":
        chosen = noiseflow.select(signal, observation, seed=seed).chosen
        label, model = chosen.name, chosen.model
    elif name in RIVALS:
        make, steps = RIVALS[name]
        fitted = noiseflow.fit(
            make(), signal, observation, num_steps=steps, learning_rate=5e-3, generator=_seeded(seed)
        )
        label, model = name, fitted.noise_model
    else:
        label, model = name, noiseflow.fit(MODELS[name](), signal, observation, generator=_seeded(seed)).noise_model
    seconds = time.process_time() - started
    for part in model.modules():
        if isinstance(part, noiseflow.NoiseModelBase) and "tabulate" not in vars(type(part)):
            part.tabulate = False
    return label, divergence(law, model), seconds


def _seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*MODELS, "select", *RIVALS]
    parser.add_argument("--law", nargs="+", choices=laws(), default=list(laws()))
    parser.add_argument("--model", nargs="+", choices=names, default=names)
    parser.add_argument("--pixels", type=int, default=PIXELS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--again", action="store_true", help="measure rows that are in the file, too")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    keep = options.pixels == PIXELS and options.seed == 0
    content = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in options.law:
        for model in options.model:
            row = content.get(f"{name} {model}")
            if row is None or options.again or not keep:
                label, found, seconds = measure(laws()[name], model, options.pixels, options.seed)
                row = {"model": label, "kl": found, "seconds": seconds} | origin()
            judged = "judged" if name in JUDGED else "developed"
            print(
                f"{name:20}{judged:10}{model:16}{row['model']:24}KL {row['kl']:.5f}  {row['seconds']:.1f} s", flush=True
            )
            content[f"{name} {model}"] = row
            if keep:
                with atomic_path(RESULTS) as partial:
                    partial.write_text(json.dumps(content, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
