"""Detectors whose electrons give pulses of random height: their exact density, and what the automatic choice loses to it.

A direct detector's electrons straggle (Landau); those of a photomultiplier, as in an integrating STEM detector, give heights
that a gamma law describes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats

import calibration
import noiseflow
from calibration.pipeline import measure_exposures

from ..simulators import landau_pulse, landau_straggled, photomultiplied

GAIN, SCALE, SHAPE, OFFSET, READ = 20.0, 2.0, 4.0, 20.0, 2.0
STEP, CELLS = 0.125, 2**15
BELOW = CELLS // 8
Array = NDArray[np.float64]


def drawn(kind: str, generator: np.random.Generator, electrons: Array) -> Array:
    detector = {"gain": GAIN, "offset": OFFSET, "read": READ}
    if kind == "straggling":
        return landau_straggled(generator, electrons, scale=SCALE, **detector)
    return photomultiplied(generator, electrons, shape=SHAPE, **detector)


def pulse_cdf(kind: str) -> Callable[[Array], Array]:
    return landau_pulse(GAIN, SCALE).cdf if kind == "straggling" else stats.gamma(SHAPE, scale=GAIN / SHAPE).cdf


def exact_log_mass(kind: str, electrons: Array, observed: Array) -> Array:
    """Log-mass of rounded pixel values, from the characteristic function exp(electrons·(φ − 1)) of compound Poisson pulses."""
    grid = (np.arange(CELLS) - BELOW) * STEP
    edges = np.append(grid, grid[-1] + STEP) - STEP / 2
    pulse = np.fft.rfft(np.roll(np.diff(pulse_cdf(kind)(edges)), -BELOW))
    turn = 2 * np.pi * np.fft.rfftfreq(CELLS, STEP)
    detector = np.exp(-0.5 * (turn * READ) ** 2) * np.sinc(turn / (2 * np.pi))  # read noise and the cell of a code
    place = np.round((observed - OFFSET) / STEP).astype(int) % CELLS
    mass = np.empty(observed.shape)
    for rate in np.unique(electrons):
        here = electrons == rate
        mass[here] = np.fft.irfft(np.exp(rate * (pulse - 1)) * detector, CELLS)[place[here]] / STEP
    return np.log(np.maximum(mass, 1e-300))


@pytest.mark.parametrize("kind", ["straggling", "photomultiplier"])
def test_exact_mass_sums_to_one_and_is_that_of_the_simulator(kind):
    codes = np.arange(-10.0, 1500.0)
    mass = np.exp(exact_log_mass(kind, np.full(codes.shape, 2.0), codes))
    assert mass.sum() == pytest.approx(1.0, abs=1e-6)
    values = drawn(kind, np.random.default_rng(1), np.full(40_000, 2.0))
    assert values.mean() == pytest.approx(OFFSET + 2 * GAIN, abs=1.0)
    place = np.linspace(20, 90, 8)
    share = np.mean(values[:, None] <= place, axis=0)
    assert np.abs(share - np.interp(place, codes, np.cumsum(mass))).max() < 4 * 0.5 / np.sqrt(values.size)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["straggling", "photomultiplier"])
def test_automatic_choice_loses_at_most_0_005_nats_to_the_exact_density(kind):
    generator = np.random.default_rng(0)
    electrons = generator.choice(np.linspace(1.0, 20.0, 96), 100_000)
    observed = drawn(kind, generator, electrons)
    held_out = np.arange(electrons.size) % 4 == 0
    signal, observation = (
        torch.tensor(values, dtype=torch.float32) for values in (OFFSET + GAIN * electrons, observed)
    )
    chosen = noiseflow.select(signal, observation, held_out=held_out, refit=False).chosen.model
    with torch.no_grad():
        found = chosen(signal[held_out]).log_prob(observation[held_out]).double().numpy()
    assert np.mean(exact_log_mass(kind, electrons[held_out], observed[held_out]) - found) < 0.005


@pytest.mark.slow
def test_a_dark_subtracted_stack_of_a_multiplying_detector_gives_its_gain_and_excess_factor_if_the_offset_is_given():
    generator, light = np.random.default_rng(0), np.linspace(5, 115, 64)
    electrons = generator.poisson(light, (60, 64, 64))
    frames = generator.gamma(np.maximum(electrons, 1), 6.0) * (electrons > 0) + generator.normal(0, 20, electrons.shape)
    told, untold = (measure_exposures(calibration.Burst(frames), offset=offset) for offset in (0.0, None))
    assert told.figures is not None
    assert told.figures.linear.median == pytest.approx(12.0, rel=0.03)
    assert told.figures.excess.q05 < 2 < told.figures.excess.q95
    assert untold.verdict.grade != "good"
