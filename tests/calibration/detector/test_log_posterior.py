"""The posterior's density is that of its priors: flat where it says so, with the Jacobian of its own coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from calibration.detector.levels import collect_levels
from calibration.detector.log_posterior import READ_NOISE_RANGE, LogPosterior
from calibration.detector.posterior import potential_scale_reduction

from .test_detector import readings


@pytest.fixture(scope="module")
def levels():
    electrons = np.random.default_rng(2).gamma(2.0, 20.0, 20_000)
    return [collect_levels([readings(np.random.default_rng(3), electrons, step=1.0)])]


SETS = np.array([[2.0, 100.0, 1.5], [1.9, 96.0, 1.2], [2.1, 103.0, 2.5]])


def test_the_offset_is_flat_though_its_coordinate_is_the_log_variance(levels):
    posterior = LogPosterior(levels)
    assert not posterior.by_offset
    coordinates = posterior.coordinates(*SETS.T)
    np.testing.assert_allclose(np.stack(posterior.parameters(coordinates), -1), SETS, rtol=1e-9)
    step = np.array([0.0, 1e-5, 0.0])
    upper, lower = (posterior.parameters(coordinates + sign * step)[1] for sign in (1, -1))
    jacobian = np.log(np.abs(upper - lower) / 2e-5)
    np.testing.assert_allclose(posterior(coordinates), posterior.likelihood(*SETS.T) + jacobian, rtol=1e-7)


def test_a_measured_offset_is_a_normal_prior(levels):
    posterior = LogPosterior(levels, offset=(99.0, 0.7))
    coordinates = posterior.coordinates(*SETS.T)
    prior = stats.norm.logpdf(SETS[:, 1], 99.0, 0.7) - stats.norm.logpdf(99.0, 99.0, 0.7)
    np.testing.assert_allclose(posterior(coordinates), posterior.likelihood(*SETS.T) + prior, rtol=1e-9)


def test_nothing_outside_the_priors_is_possible(levels):
    posterior = LogPosterior(levels, offset=(99.0, 0.7))
    low, high = READ_NOISE_RANGE
    sets = np.array([[2.0, 99.0, 0.99 * low], [2.0, 99.0, 1.01 * high], [2.0, posterior.brightest + 1, 1.5]])
    assert np.isneginf(posterior(posterior.coordinates(*sets.T))).all()
    assert np.isfinite(posterior(posterior.coordinates(2.0, 99.0, 1.01 * low))).all()


def test_scale_reduction_is_that_of_its_formula_on_chains_that_agree_and_that_do_not():
    generator = np.random.default_rng(0)
    chain = generator.standard_normal((400, 6, 2))
    assert 0.999 < potential_scale_reduction(chain) < 1.02
    apart = chain.copy()
    apart[:, :3, 1] += 1.0  # half the walkers elsewhere
    drifting = chain.copy()
    drifting[200:, :, 0] += 1.0  # every walker moved between the halves
    for one in (apart, drifting):
        found, values = [], []
        for parameter in range(2):
            halves = np.concatenate([one[:200, :, parameter], one[200:, :, parameter]], axis=1)
            ranks = stats.rankdata(halves).reshape(halves.shape)
            z = stats.norm.ppf((ranks - 3 / 8) / (halves.size + 1 / 4))
            means = [z[:, walker].mean() for walker in range(12)]
            within = np.mean([z[:, walker].var(ddof=1) for walker in range(12)])
            between = 200 * np.var(means, ddof=1)
            values.append(np.sqrt((199 / 200 * within + between / 200) / within))
        found = potential_scale_reduction(one)
        assert found == pytest.approx(max(values), rel=1e-9)
        assert found > 1.05
