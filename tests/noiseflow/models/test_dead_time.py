"""A counter with dead time: its law is exact, its sampler agrees, and a fit finds the dead time."""

import math
import time
import warnings

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow.models.dead_time import DeadTimeDistribution
from tests.calibration.simulators import counted_with_dead_time

COUNTS = torch.arange(0.0, 120.0, dtype=torch.float64)


def law(dead_time: float, mean: float):
    return DeadTimeDistribution(*(torch.tensor(value, dtype=torch.float64) for value in (mean, dead_time)))


@pytest.mark.parametrize(("dead_time", "mean"), [(1e-4, 15.0), (0.01, 0.3), (0.05, 15.0), (0.3, 2.5)])
def test_masses_sum_to_one_with_the_stated_mean_variance_and_cdf(dead_time, mean):
    distribution = law(dead_time, mean)
    mass = distribution.log_prob(COUNTS).exp()
    assert float(mass.sum()) == pytest.approx(1, abs=1e-12)
    assert float(mass @ COUNTS) == pytest.approx(mean, rel=1e-10)
    assert float(mass @ COUNTS**2) - mean**2 == pytest.approx(float(distribution.variance), rel=1e-9)
    assert torch.allclose(distribution.cdf(COUNTS), mass.cumsum(0), atol=1e-12)


def test_both_tails_keep_their_digits():
    """Far tails against the renewal law in 50 digits."""
    mpmath = pytest.importorskip("mpmath")
    mpmath.mp.dps = 50
    mean, dead_time = mpmath.mpf(40), mpmath.mpf("0.01")
    events = mean / (1 - mean * dead_time)

    def excess(count: int):
        left = 1 - count * dead_time
        if count == 0:
            return left
        return left * mpmath.gammainc(count, 0, events * left, regularized=True) - count / events * mpmath.gammainc(
            count + 1, 0, events * left, regularized=True
        )

    for count in (2, 10, 40, 75, 90):
        exact = mpmath.log(mean * (excess(count - 1) - 2 * excess(count) + excess(count + 1)))
        found = float(law(0.01, 40.0).log_prob(torch.tensor(float(count), dtype=torch.float64)))
        assert found == pytest.approx(float(exact), abs=1e-7)


def test_counts_simulated_event_by_event_have_this_law():
    """The simulator starts alive, the law in the middle of a stream: at a dead time of 0.5 % they differ by 0.002 in the mean."""
    rate, dead_time, number = 20.0, 0.005, 200_000
    counts = counted_with_dead_time(np.random.default_rng(0), np.full(number, rate), dead_time=dead_time)
    distribution = law(dead_time, float(counts.mean()))
    mass = distribution.log_prob(COUNTS).exp().numpy()
    seen = np.bincount(counts.astype(int), minlength=len(mass))
    used = number * mass > 20
    assert np.sum((seen - number * mass)[used] ** 2 / (number * mass)[used]) < used.sum() + 5 * math.sqrt(
        2 * used.sum()
    )
    samples = noiseflow.DeadTimeCounter(dead_time)(torch.full((number,), float(counts.mean()))).sample()
    assert float(samples.var()) == pytest.approx(float(distribution.variance), rel=0.02)


def test_fit_finds_the_dead_time_and_counts_at_once_is_better_than_poisson():
    generator = np.random.default_rng(1)
    rate = generator.uniform(2.0, 60.0, 20_000)
    counts = torch.from_numpy(counted_with_dead_time(generator, rate, dead_time=0.01)).float()
    signal = torch.from_numpy(rate / (1 + 0.01 * rate)).float()
    model = noiseflow.DeadTimeCounter(1e-3)
    noiseflow.fit(model, signal, counts, num_steps=60)
    assert float(model.dead_time.detach()) == pytest.approx(0.01, rel=0.1)
    with torch.no_grad():
        gained = model(signal).log_prob(counts) - noiseflow.Poisson(1.0)(signal).log_prob(counts)
    assert float(gained.mean()) > 0.05


def test_variance_with_a_gradient_warns_of_nothing() -> None:
    signal = torch.tensor([2.0, 10.0], requires_grad=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope = torch.autograd.grad(noiseflow.DeadTimeCounter(0.02)(signal).variance.sum(), signal)[0]
    assert bool((slope > 0).all())


def test_many_counts_are_drawn_in_no_more_time_than_few(monkeypatch: pytest.MonkeyPatch) -> None:
    many = noiseflow.DeadTimeCounter(1e-6)(torch.tensor(3e5, dtype=torch.float64))
    started = time.perf_counter()
    drawn = many.sample((2000,), generator=torch.Generator().manual_seed(0))
    assert time.perf_counter() - started < 5
    assert float(drawn.mean()) == pytest.approx(3e5, abs=4 * (147_000 / 2000) ** 0.5)
    assert float(drawn.var()) == pytest.approx(147_000, rel=0.15)  # 3e5 · (1 − 0.3)²
    some = noiseflow.DeadTimeCounter(0.01)(torch.tensor([3.0, 40.0], dtype=torch.float64))
    events = some.sample((20_000,), generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(DeadTimeDistribution._poisson, "__kwdefaults__", {"many": 0})
    quantiles = some.sample((20_000,), generator=torch.Generator().manual_seed(1))
    assert torch.allclose(events.mean(0), quantiles.mean(0), rtol=0.03)
    assert torch.allclose(events.var(0), quantiles.var(0), rtol=0.06)
