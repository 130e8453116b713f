"""Metrics: exact where a formula exists, on their floor when the model is the truth, above it when it is not."""

import math

import numpy as np
import pytest
import torch

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
