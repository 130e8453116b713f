"""Metrics: exact where a formula exists, on their floor when the model is the truth, above it when it is not."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import noiseflow
from noiseflow import metrics


def test_divergences_of_known_vectors() -> None:
    p, q = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    assert float(metrics.jensen_shannon(p, q)) == pytest.approx(math.log(2))
    assert float(metrics.bhattacharyya(p, q)) == 0
    half = np.array([0.5, 0.5])
    assert float(metrics.jensen_shannon(p, half)) == pytest.approx(0.75 * math.log(4 / 3), rel=1e-12)
    assert float(metrics.jensen_shannon(half, half)) == 0
    assert float(metrics.bhattacharyya(half, half)) == pytest.approx(1)


def noisy(seed: int, scale: float = 0.1) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    signal = torch.rand(40_000, generator=generator)
    return signal, signal + scale * torch.randn(signal.shape, generator=generator)


def test_true_model_sits_on_its_floors() -> None:
    found = [metrics.evaluate(noiseflow.Gaussian(0.1), *noisy(seed)) for seed in range(6)]
    assert np.mean([e.overall.jsd for e in found]) == pytest.approx(
        np.mean([e.overall.jsd_floor for e in found]), rel=0.2
    )
    assert np.mean([1 - e.overall.bc for e in found]) == pytest.approx(
        np.mean([1 - e.overall.bc_floor for e in found]), rel=0.2
    )
    assert np.mean([e.mean_jsd for e in found]) == pytest.approx(np.mean([e.mean_jsd_floor for e in found]), rel=0.1)
    entropy = 0.5 * math.log(2 * math.pi * math.e * 0.01)
    assert all(abs(e.nll - entropy) < 4 * e.nll_error for e in found)
    assert sum(e.ks > e.ks_floor for e in found) <= 2


@pytest.mark.parametrize("step", [0.0, 1 / 255, 1 / 40])
def test_true_digitised_model_sits_on_its_floor(step: float) -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(0.06), step=step, low=0.0, high=1.0)
    found = []
    for seed in range(4):
        signal, observation = noisy(seed, 0.06)
        found.append(metrics.divergence(model, signal, model(signal).digitise(observation)))
    ratio = np.mean([each.jsd for each in found]) / np.mean([each.jsd_floor for each in found])
    assert ratio == pytest.approx(1, abs=0.2)


def test_floor_is_the_chi_squared_one() -> None:
    masses = np.full(32, 1 / 32)
    counts = np.random.default_rng(0).multinomial(100_000, masses)
    divergence = metrics.compare_histogram(counts, masses, np.random.default_rng(1))
    assert divergence.jsd_floor == pytest.approx(31 / (8 * 100_000), rel=0.15)


def test_wrong_model_is_far_above_its_floor() -> None:
    found = metrics.evaluate(noiseflow.Gaussian(0.12), *noisy(0))
    assert found.overall.jsd > 5 * found.overall.jsd_floor
    assert found.overall.jsd_interval[0] <= found.overall.jsd <= found.overall.jsd_interval[1]
    assert found.ks > 3 * found.ks_floor


def test_pit_of_rounded_data_is_uniform() -> None:
    signal, observation = noisy(0)
    model = noiseflow.Digitised(noiseflow.Gaussian(0.1), step=1 / 16, low=0.0, high=1.0)
    rounded = (observation * 16).round().clamp(0, 16) / 16
    u = metrics.probability_integral_transform(model, signal, rounded, np.random.default_rng(0))
    assert metrics.kolmogorov_smirnov(u) < 2 / math.sqrt(u.size)


def test_empty_input_is_refused() -> None:
    with pytest.raises(ValueError, match="non-zero"):
        metrics.evaluate(noiseflow.Gaussian(), torch.zeros(0), torch.zeros(0))


def test_non_finite_pixels_are_refused_or_left_out() -> None:
    signal, observation = noisy(0)
    expected = metrics.evaluate(noiseflow.Gaussian(0.1), signal[2:], observation[2:])
    observation = observation.clone()
    observation[0], observation[1] = math.nan, math.inf
    with pytest.raises(ValueError, match=r"2 of 40000 pixels .* skip_non_finite"):
        metrics.evaluate(noiseflow.Gaussian(0.1), signal, observation)
    found = metrics.evaluate(noiseflow.Gaussian(0.1), signal, observation, skip_non_finite=True)
    assert found.num_pixels == 39_998
    assert found.nll == expected.nll
    assert found.overall == expected.overall
    with pytest.raises(ValueError, match="4 of 4"):
        metrics.evaluate(noiseflow.Gaussian(), torch.zeros(4), torch.full((4,), math.nan), skip_non_finite=True)


def probabilities(seed: int, num_bins: int) -> np.ndarray:
    """Two probability vectors of very different sizes of entries, some zero, (2, num_bins)."""
    random = np.random.default_rng(seed)
    weight = random.random((2, num_bins)) ** random.integers(1, 12) * (random.random((2, num_bins)) < 0.8)
    weight[:, 0] += 1e-3
    return np.asarray(weight / weight.sum(1, keepdims=True))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 40))
def test_laws_of_the_divergences(seed: int, num_bins: int) -> None:
    p, q = probabilities(seed, num_bins)
    jsd, bc = float(metrics.jensen_shannon(p, q)), float(metrics.bhattacharyya(p, q))
    assert -1e-12 <= jsd <= math.log(2) + 1e-12
    assert 0 <= bc <= 1 + 1e-12
    assert jsd == pytest.approx(float(metrics.jensen_shannon(q, p)), abs=1e-12)
    total = np.abs(p - q).sum() / 2
    assert 1 - bc <= total + 1e-12  # Hellinger's and Lin's bounds by the total variation
    assert jsd <= math.log(2) * total + 1e-12
    merged = [np.add.reduceat(each, np.arange(0, num_bins, 2)) for each in (p, q)]
    assert float(metrics.jensen_shannon(*merged)) <= jsd + 1e-12  # coarser bins tell less
    assert float(metrics.bhattacharyya(*merged)) >= bc - 1e-12


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 64), st.integers(20_000, 500_000))
def test_floors_are_met_by_the_truth_and_follow_the_number_of_bins(seed: int, num_bins: int, total: int) -> None:
    random = np.random.default_rng(seed)
    masses = random.dirichlet(np.full(num_bins, 20.0))
    found = [metrics.compare_histogram(random.multinomial(total, masses), masses, random) for _ in range(40)]
    expected = (num_bins - 1) / (8 * total)
    for values, floors in (
        ([d.jsd for d in found], [d.jsd_floor for d in found]),
        ([1 - d.bc for d in found], [1 - d.bc_floor for d in found]),
        ([d.bd for d in found], [d.bd_floor for d in found]),
    ):
        assert np.mean(floors) == pytest.approx(expected, rel=0.15)
        assert np.mean(values) == pytest.approx(expected, rel=5 * math.sqrt(2 / (num_bins - 1) / 40) + 0.05)


def test_bins_beyond_the_rails_have_no_mass():
    edges = torch.tensor([-math.inf, -0.6, -0.5, 0.1, 0.7, 0.9, math.inf])
    for model in (noiseflow.PhysicsFlow(), noiseflow.PoissonGaussian(), noiseflow.SplineFlow(), noiseflow.Mixture()):
        railed = noiseflow.Digitised(model, step=0.0, low=0.0, high=1.0)
        masses = metrics.residual_masses(railed, torch.full((5,), 0.4), edges)
        assert masses[[0, 1, 4, 5]] == pytest.approx(0.0, abs=1e-12)
        assert masses.sum() == pytest.approx(1.0)
