"""Probabilities of cells from the characteristic function are those of the exact distribution, to the accuracy stated."""

import numpy as np
import pytest
import torch
from scipy import stats

import noiseflow
from noiseflow.distributions.electrons.spectrum import LEAST_SIZE, CellTransform, of_residuals, of_values

GAIN, OFFSET, CELLS = 2.0, 100.0, 128
PARAMETERS = np.array([[GAIN]]), np.array([[OFFSET]])


def cells(signal: float, reach: float, *, number: int = CELLS, low: float = -np.inf, high: float = np.inf, **options):
    places = np.array([2 * reach / number]), np.array([signal - reach])
    rails = {"low": np.array([low]), "high": np.array([high])}
    return CellTransform(*places, number, **rails, dither=np.zeros(1), **({"sharp": True} | options))


def masses(one: CellTransform, rate: float, read_noise: float, spread: float = 0.0):
    noise, light = np.array([[read_noise]]), (np.array([[rate]]), np.array([[spread]]))
    found, slope = one.transform(
        lambda frequency: of_values(frequency, *PARAMETERS, noise, *light, slope=True), *(PARAMETERS[0][0], noise[0])
    )
    return one.masses(found)[0, 0], one.masses(slope * found)[0, 0]


@pytest.mark.parametrize("rate", [0.3, 3.0, 60.0, 3000.0])
@pytest.mark.parametrize("read_noise", [0.2, 0.7, 4.0])
def test_masses_and_their_slopes_are_those_of_the_exact_distribution(rate, read_noise):
    signal = OFFSET + GAIN * rate
    reach = GAIN * (6 * float(np.hypot(np.sqrt(rate), read_noise)) + 8)
    one = cells(signal, reach, number=max(CELLS, 2 * int(reach / GAIN)))  # cells no wider than an electron
    edges = torch.from_numpy(one.origin[0] + one.width[0] * np.arange(one.number + 1))

    def exact(mean: float):
        level = torch.full((one.number,), mean, dtype=torch.float64)
        noise = noiseflow.PoissonGaussian(GAIN, OFFSET, read_noise).double()(level)
        return noise.log_interval_prob(edges[:-1], edges[1:]).exp().detach().numpy()

    found, slope = masses(one, rate, read_noise)
    np.testing.assert_allclose(found, exact(signal), atol=2 * LEAST_SIZE)
    step = 1e-3 * GAIN * np.sqrt(rate)
    difference = (exact(signal + step) - exact(signal - step)) / (2 * step)
    np.testing.assert_allclose(slope, difference, atol=1e-5 * np.abs(difference).max() + LEAST_SIZE)


def test_gamma_distributed_signals_give_the_negative_binomial_distribution():
    rate, spread, read_noise, counts = 5.0, 8.0, 0.8, np.arange(200)
    one = cells(OFFSET + GAIN * rate, 80.0)
    electrons = stats.nbinom.pmf(counts, rate**2 / spread, 1 / (1 + spread / rate))
    edges = one.origin[0] + one.width[0] * np.arange(CELLS + 1)
    below = stats.norm.cdf((edges[:, None] - OFFSET - GAIN * counts) / (GAIN * read_noise)) @ electrons
    np.testing.assert_allclose(masses(one, rate, read_noise, spread)[0], np.diff(below), atol=2 * LEAST_SIZE)


def test_cells_at_the_clipping_limits_hold_all_beyond():
    rate, read_noise, reach = 60.0, 4.0, 160.0
    free, clipped = (cells(220.0, reach, **limits) for limits in ({}, {"low": 210.0, "high": 230.0}))
    whole, found = masses(free, rate, read_noise)[0], masses(clipped, rate, read_noise)[0]
    first, last = np.flatnonzero(found)[[0, -1]]
    np.testing.assert_allclose(found[first + 1 : last], whole[first + 1 : last], atol=1e-15)
    assert found[first] == pytest.approx(whole[: first + 1].sum())
    assert found[last] == pytest.approx(whole[last:].sum())


@pytest.mark.parametrize("rates", [{3.0: 1.0}, {1.0: 0.75, 9.0: 0.25}])
def test_residuals_are_differences_of_two_values(rates):
    read_noise, share, mean = 1.5, 0.25, 3.0
    one = cells(0.0, 64.0, sharp=False)
    shares = {"shot_share": np.array([share]), "read_share": np.array([share])}
    parts = np.array([[[[weight, rate - mean, 0.0] for rate, weight in rates.items()]]])
    noise = np.array([[read_noise]])
    transform, _ = one.transform(
        lambda t: (of_residuals(t, PARAMETERS[0], noise, np.array([[mean]]), parts, **shares), None),
        PARAMETERS[0][0],
        noise[0],
    )
    counts = np.arange(80)
    both = sum(
        weight * np.outer(stats.poisson.pmf(counts, rate), stats.poisson.pmf(counts, rate / share))
        for rate, weight in rates.items()
    )
    apart = GAIN * (counts[:, None] - share * counts[None, :])
    edges = one.origin[0] + one.width[0] * np.arange(CELLS + 1)
    spread = GAIN * read_noise * np.sqrt(1 + share)
    below = np.einsum("ijk,ij->k", stats.norm.cdf((edges - apart[..., None]) / spread), both)
    np.testing.assert_allclose(one.masses(transform)[0, 0], np.diff(below), atol=2 * LEAST_SIZE)


@pytest.mark.parametrize(("rate", "spread"), [(0.02, 0.1), (0.5, 0.2), (2.0, 30.0), (5.0, 8.0)])
def test_slopes_by_the_mean_hold_where_the_spread_is_bounded(rate, spread):
    one, change = cells(OFFSET + GAIN * rate, 80.0), 1e-3 * rate
    up, down = (masses(one, rate + sign * change, 2.0, spread)[0] for sign in (1, -1))
    slope = masses(one, rate, 2.0, spread)[1]
    np.testing.assert_allclose(slope, (up - down) / (2 * change * GAIN), atol=1e-4)
