"""A direct detector whose electrons deposit Landau-distributed energies: its exact density."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ..simulators import landau_pulse, landau_straggled

GAIN, SCALE, OFFSET, READ = 20.0, 2.0, 20.0, 2.0
STEP, CELLS = 0.125, 2**15
BELOW = CELLS // 8


def exact_log_mass(electrons: NDArray[np.float64], observed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log-mass of rounded pixel values, from the characteristic function exp(electrons·(φ − 1)) of compound Poisson pulses."""
    grid = (np.arange(CELLS) - BELOW) * STEP
    edges = np.append(grid, grid[-1] + STEP) - STEP / 2
    pulse = np.fft.rfft(np.roll(np.diff(landau_pulse(GAIN, SCALE).cdf(edges)), -BELOW))
    turn = 2 * np.pi * np.fft.rfftfreq(CELLS, STEP)
    detector = np.exp(-0.5 * (turn * READ) ** 2) * np.sinc(turn / (2 * np.pi))  # read noise and the cell of a code
    place = np.round((observed - OFFSET) / STEP).astype(int) % CELLS
    mass = [
        np.fft.irfft(np.exp(rate * (pulse - 1)) * detector, CELLS)[cell] / STEP
        for rate, cell in zip(electrons, place, strict=True)
    ]
    return np.log(np.maximum(mass, 1e-300))


def test_exact_mass_sums_to_one_and_is_that_of_the_simulator():
    codes = np.arange(-10.0, 1500.0)
    mass = np.exp(exact_log_mass(np.full(codes.shape, 2.0), codes))
    assert mass.sum() == pytest.approx(1.0, abs=1e-6)
    drawn = landau_straggled(
        np.random.default_rng(1), np.full(40_000, 2.0), gain=GAIN, scale=SCALE, offset=OFFSET, read=READ
    )
    assert drawn.mean() == pytest.approx(OFFSET + 2 * GAIN, abs=1.0)
    below = np.cumsum(mass)
    place = np.linspace(20, 90, 8)
    share = np.mean(drawn[:, None] <= place, axis=0)
    assert np.abs(share - np.interp(place, codes, below)).max() < 4 * 0.5 / np.sqrt(drawn.size)
