"""Moments, entropy and quantiles of a law against closed forms, and of a rescaled law against the law of scaled draws."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import noiseflow
from noiseflow.distributions.law import NoiseDistribution

SCALE, SHIFT = 2.5, -0.75


def gaussian() -> NoiseDistribution:
    return noiseflow.Gaussian(0.1).double()(torch.tensor([0.25, 0.5], dtype=torch.float64))


def rescaled() -> NoiseDistribution:
    scale = torch.full((2,), SCALE, dtype=torch.float64)
    return gaussian().rescaled(scale, torch.full((2,), SHIFT, dtype=torch.float64))


def test_entropy_is_that_of_the_normal_law() -> None:
    expected = 0.5 * math.log(2 * math.pi * math.e) + math.log(0.1)
    assert_close(gaussian().entropy(), torch.full((2,), expected, dtype=torch.float64), atol=1e-6, rtol=0)
    assert_close(rescaled().entropy(), gaussian().entropy() + math.log(SCALE), atol=1e-6, rtol=0)


def test_expectations_of_a_rescaled_law_are_those_of_scaled_values() -> None:
    signal = gaussian().mean
    mean = SCALE * signal + SHIFT
    assert_close(rescaled().expectation(lambda o: o), mean, atol=1e-7, rtol=0)
    assert_close(rescaled().expectation(lambda o: torch.ones_like(o)), torch.ones_like(mean))
    spread = torch.full_like(mean, (SCALE * 0.1) ** 2)
    assert_close(rescaled().expectation(lambda o: (o - mean) ** 2), spread, atol=1e-7, rtol=0)
    assert_close(rescaled().mean, mean)
    assert_close(rescaled().variance, spread)


def test_probabilities_of_a_rescaled_law_are_those_of_the_interval_scaled_back() -> None:
    law, normal = rescaled(), torch.distributions.Normal(rescaled().mean, SCALE * 0.1)
    low, high = (normal.mean + step * normal.stddev for step in (-0.7, 1.1))
    between = normal.cdf(high) - normal.cdf(low)
    assert_close(law.log_interval_prob(low, high).exp(), between)
    assert_close(law.cdf(high), normal.cdf(high))
    assert_close(law.icdf(normal.cdf(high)), high)
    assert_close(law.log_prob(high), normal.log_prob(high))
    everything = torch.full_like(low, math.inf)
    assert_close(law.log_interval_prob(-everything, everything), torch.zeros_like(low))


def test_mode_is_where_the_density_is_greatest() -> None:
    assert_close(rescaled().mode, rescaled().mean, atol=2e-3, rtol=0)


@pytest.mark.parametrize("count", [1, 7])
def test_draws_of_a_rescaled_law_are_scaled_draws(count: int) -> None:
    drawn = rescaled().sample((count,), generator=torch.Generator().manual_seed(0))
    plain = gaussian().sample((count,), generator=torch.Generator().manual_seed(0))
    assert_close(drawn, plain * SCALE + SHIFT)
