"""Metrics: exact where a formula exists, on their floor when the model is the truth, above it when it is not."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import noiseflow
from benchmarks.divergences import kl_divergence
from noiseflow import metrics
from noiseflow.metrics.evaluation import TABLE_HEADER, _num_groups, pixel_log_prob, table_row
from noiseflow.report import residual_histogram


def test_divergences_of_known_vectors() -> None:
    p, q = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    assert float(metrics.jensen_shannon(p, q)) == pytest.approx(math.log(2))
    assert float(metrics.bhattacharyya(p, q)) == 0
    half = np.array([0.5, 0.5])
    assert float(metrics.jensen_shannon(p, half)) == pytest.approx(0.75 * math.log(4 / 3), rel=1e-12)
    assert float(metrics.jensen_shannon(half, half)) == 0
    assert float(metrics.bhattacharyya(half, half)) == pytest.approx(1)


@pytest.mark.parametrize("model", [noiseflow.Poisson(), noiseflow.Digitised(noiseflow.Gaussian(1e-3), step=1.0)])
def test_residuals_that_are_all_equal_are_told_by_a_model_that_says_so(model: torch.nn.Module) -> None:
    level = torch.zeros(5000) if isinstance(model, noiseflow.Poisson) else torch.full((5000,), 7.0)
    found = metrics.divergence(model, level, level)
    assert found.jsd < 0.01


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
    with pytest.raises(ValueError, match="no pixels"):
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


def normal_cdf(value: np.ndarray) -> np.ndarray:
    return np.asarray(torch.special.ndtr(torch.as_tensor(value)))


class Wide(torch.nn.Module):
    """Normal noise whose width grows with the signal."""

    def forward(self, signal: torch.Tensor) -> torch.distributions.Distribution:
        return torch.distributions.Normal(signal, 0.05 + 0.1 * signal, validate_args=False)


def test_an_evaluation_is_made_of_its_definitions() -> None:
    signal, observation = noisy(3)
    signal, observation = signal[:3000].double(), observation[:3000].double()
    found = metrics.evaluate(Wide(), signal, observation, num_bins=16, num_signal_bins=5)
    width = 0.05 + 0.1 * signal.numpy()
    z = (observation - signal).numpy() / width
    nll = 0.5 * z**2 + np.log(width) + 0.5 * math.log(2 * math.pi)
    assert found.nll == pytest.approx(nll.mean(), rel=1e-9)
    assert found.nll_error == pytest.approx(nll.std() / math.sqrt(3000), rel=1e-9)
    u = np.sort(normal_cdf(z))
    ranks = np.arange(1, 3001) / 3000
    assert found.ks == pytest.approx(max((ranks - u).max(), (u - ranks + 1 / 3000).max()), rel=1e-6)
    assert found.ks_floor == pytest.approx(1.358 / math.sqrt(3000))
    np.testing.assert_allclose(found.pit, 20 * np.histogram(u, np.linspace(0, 1, 21))[0] / 3000, rtol=1e-9)
    assert found.num_pixels == 3000
    assert len(found.per_signal) == 5
    order = np.argsort(signal.numpy())
    for each, group in zip(found.per_signal, np.array_split(order, 5), strict=True):
        alone, finer = (
            metrics.divergence(Wide(), signal[group], observation[group], num_bins=16, num_groups=number)
            for number in (64, 256)
        )
        assert each.jsd == pytest.approx(alone.jsd, rel=1e-9)
        assert each.jsd == pytest.approx(finer.jsd, rel=1e-4)  # 64 signals stand for all of a bin
    assert found.mean_jsd == pytest.approx(np.mean([each.jsd for each in found.per_signal]))
    assert found.mean_jsd_floor == pytest.approx(np.mean([each.jsd_floor for each in found.per_signal]))
    assert len(metrics.evaluate(Wide(), signal[:3], observation[:3]).per_signal) == 3
    judged = metrics.evaluate(Wide(), signal, observation)
    assert metrics.divergence(Wide(), signal, observation).jsd == judged.overall.jsd  # in the same bins by default


def test_one_signal_for_a_lazy_observation_is_that_of_each_of_its_pixels() -> None:
    lazy = pytest.importorskip("dask.array")
    signal, observation = (each[:500].double().numpy() for each in noisy(2))
    found = pixel_log_prob(noiseflow.Gaussian(0.1).double(), signal, lazy.from_array(observation, chunks=200))
    exact = torch.distributions.Normal(torch.from_numpy(signal), 0.1).log_prob(torch.from_numpy(observation))
    np.testing.assert_allclose(np.asarray(found.compute()), exact, atol=1e-6)


@pytest.mark.parametrize("num_bins", [4, 64])
def test_bins_are_even_between_far_quantiles_and_their_masses_exact(num_bins: int) -> None:
    signal, observation = (each[:5000].double() for each in noisy(1))
    found = metrics.divergence(Wide(), signal, observation, num_bins=num_bins)
    residual, width = (observation - signal).numpy(), 0.05 + 0.1 * signal.numpy()
    low, high = np.quantile(residual, (0.001, 0.999))
    edges = np.r_[-np.inf, np.linspace(low, high, num_bins - 1), np.inf]
    counts = np.histogram(residual, edges)[0]
    masses = np.diff(normal_cdf(edges / width[:, None]), axis=1).mean(0)
    expected = metrics.jensen_shannon(counts / 5000, masses)
    assert counts[0] == counts[-1] == 5
    # masses are those of 256 groups of like signal
    assert found.jsd == pytest.approx(float(expected), rel=1e-3)
    assert found.bc == pytest.approx(float(metrics.bhattacharyya(counts / 5000, masses)), rel=1e-4)
    assert found.bd == pytest.approx(-math.log(found.bc))
    assert found.bd_floor == pytest.approx(-math.log(found.bc_floor))
    np.testing.assert_allclose(metrics.residual_masses(Wide(), signal, edges), masses, rtol=3e-3)


@torch.no_grad()
def test_masses_of_many_signals_are_those_of_each() -> None:
    """More groups of signals than are evaluated at once, of a model whose single readings have mass."""
    model = noiseflow.Digitised(noiseflow.Gaussian(0.3), step=0.01, low=-1.0, high=9.0).double()
    signal = torch.linspace(0.0, 5.0, 3000, dtype=torch.float64)
    edges = torch.tensor([-math.inf, -0.5, 0.004, 0.011, 0.5, math.inf], dtype=torch.float64)
    bounds = signal[:, None] + edges
    exact = model(signal[:, None]).log_interval_prob(bounds[:, :-1], bounds[:, 1:]).exp().mean(0)
    # readings a step apart move across an edge by no more than a sixteenth of a step within a group
    np.testing.assert_allclose(metrics.residual_masses(model, signal, edges), exact, rtol=0.02, atol=1e-9)


@pytest.mark.parametrize("middle", [-3.0, 0.0, 40.0])
def test_signals_are_told_apart_by_their_range_wherever_it_lies(middle: float) -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(0.5), step=0.1)
    signal, edges = middle + torch.linspace(-2, 2, 100), torch.linspace(-1, 1, 21)
    here, there = (_num_groups(model, each, edges, 16) for each in (signal, signal - middle + 100))
    assert here == there > 16


def test_residuals_that_are_all_equal_have_a_divergence() -> None:
    signal = torch.zeros(500, dtype=torch.float64)
    found = metrics.divergence(noiseflow.Gaussian(1.0).double(), signal, signal, num_bins=8)
    assert math.isfinite(found.jsd)
    assert found.jsd > 0.1


def test_the_bootstrap_interval_is_as_wide_as_chance_makes_the_divergence() -> None:
    random = np.random.default_rng(0)
    truth, model = random.dirichlet(np.full(16, 5.0)), random.dirichlet(np.full(16, 5.0))
    draws = random.multinomial(5000, truth, size=(100, 64)) / 5000  # 64 resamples of the histogram make an interval
    found = metrics.jensen_shannon(draws, model)
    intervals = [
        metrics.compare_histogram(random.multinomial(5000, truth), model, random).jsd_interval for _ in range(400)
    ]
    low, high = np.array(intervals).T
    expected = np.quantile(found, (0.05, 0.95), axis=1).mean(1)
    assert (high - low).mean() == pytest.approx(expected[1] - expected[0], rel=0.03)
    exact = float(metrics.jensen_shannon(truth, model))
    assert ((low <= exact) & (exact <= high)).mean() == pytest.approx(0.9, abs=0.045)


def test_the_interval_takes_off_what_resampling_adds() -> None:
    """Under the truth the divergence is all chance, and a resample of the counts has twice of it."""
    random, masses = np.random.default_rng(1), np.full(32, 1 / 32)
    found = [metrics.compare_histogram(random.multinomial(20_000, masses), masses, random) for _ in range(200)]
    middle = np.mean([np.mean(each.jsd_interval) for each in found])
    assert middle == pytest.approx(np.mean([each.jsd for each in found]), rel=0.05)
    assert min(each.jsd_interval[0] for each in found) >= 0


def test_counts_where_the_model_has_nothing_are_infinitely_far() -> None:
    found = metrics.compare_histogram(np.array([7, 0]), np.array([0.0, 1.0]), np.random.default_rng(0))
    assert (found.bc, found.bd) == (0.0, math.inf)
    assert found.jsd == pytest.approx(math.log(2))


def test_pieces_of_many_pixels_are_joined_in_order() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(70_000, generator=generator, dtype=torch.float64)
    observation = signal + 0.1 * torch.randn(70_000, generator=generator, dtype=torch.float64)
    assert torch.equal(pixel_log_prob(Wide(), signal, observation), Wide()(signal).log_prob(observation))
    u = metrics.probability_integral_transform(Wide(), signal, observation, np.random.default_rng(0))
    np.testing.assert_allclose(u, Wide()(signal).cdf(observation), atol=1e-12)


def test_the_place_of_a_reading_with_mass_is_anywhere_within_its_jump() -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(0.5), step=1.0).double()
    signal = torch.zeros(20_000, dtype=torch.float64)
    u = metrics.probability_integral_transform(model, signal, signal + 1, np.random.default_rng(0))
    below, at = normal_cdf(np.array([1.0, 3.0]))
    assert u.min() == pytest.approx(below, abs=1e-4)
    assert u.max() == pytest.approx(at, abs=1e-4)
    assert metrics.kolmogorov_smirnov((u - below) / (at - below)) < 2 / math.sqrt(20_000)


def test_relative_entropy_from_a_known_truth() -> None:
    signal = torch.linspace(0, 1, 40_000, dtype=torch.float64)
    truth, model = noiseflow.Gaussian(0.1).double(), noiseflow.Gaussian(0.13).double()
    found, error = kl_divergence(truth, model, signal)
    ratio = (0.1 / 0.13) ** 2
    # of (z²/2)(1 − ratio) the standard deviation is (1 − ratio)/√2
    assert error == pytest.approx((1 - ratio) / math.sqrt(2) / 200, rel=0.05)
    assert abs(found - 0.5 * (ratio - 1 - math.log(ratio))) < 4 * error
    assert kl_divergence(truth, truth, signal) == (0.0, 0.0)


def test_a_row_of_the_table_holds_its_evaluation_in_percent() -> None:
    found = metrics.evaluate(noiseflow.Gaussian(0.12), *noisy(0))
    name, *cells = table_row("mine", found)
    assert name == "mine"
    assert len(cells) + 1 == len(TABLE_HEADER)
    overall = found.overall
    for cell, value, places in zip(
        cells,
        [
            found.nll,
            found.nll_error,
            100 * overall.jsd,
            100 * overall.jsd_floor,
            100 * found.mean_jsd,
            100 * found.mean_jsd_floor,
            100 - 100 * overall.bc,
            100 - 100 * overall.bc_floor,
            100 * overall.bd,
            100 * overall.bd_floor,
            found.ks,
        ],
        [4, 4, *(8 * [3]), 4],
        strict=True,
    ):
        assert float(cell) == pytest.approx(value, abs=0.51 * 10**-places)


@pytest.mark.parametrize("counts", [[-1, 5, 10], [0, 0, 0], [math.nan, 1, 2], [1, 2], [0.5, 1, 2], [[1, 2, 3]]])
def test_counts_that_are_no_histogram_are_refused(counts: list[float]) -> None:
    random = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"counts|shapes"):
        metrics.compare_histogram(counts, [0.2, 0.3, 0.5], random)
    with pytest.raises(ValueError, match=r"probabilities|shapes"):
        metrics.compare_histogram([5, 5, 10], counts, random)
    assert metrics.compare_histogram([4, 6, 10], [0.2, 0.3, 0.5], random).jsd == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("edges", [[0.0, math.nan, 1.0], [1.0, 0.0], [0.0], [[0.0, 1.0]]])
def test_edges_that_do_not_increase_are_refused(edges: list[float]) -> None:
    with pytest.raises(ValueError, match="edges"):
        metrics.residual_masses(noiseflow.Gaussian(), torch.zeros(3), edges)


@pytest.mark.parametrize(
    "signal", [torch.tensor([0.0, math.nan]), torch.zeros(0), torch.zeros(2, dtype=torch.complex64)]
)
def test_signals_without_noise_are_refused(signal: torch.Tensor) -> None:
    with pytest.raises(ValueError, match=r"signal|real"):
        metrics.residual_masses(noiseflow.Gaussian(), signal, [0.0, 1.0])


def test_vectors_that_do_not_broadcast_are_refused() -> None:
    with pytest.raises(ValueError, match="shapes"):
        metrics.jensen_shannon(np.full((3, 2), 0.5), np.full((4, 2), 0.5))


def camera() -> noiseflow.Digitised:
    return noiseflow.Digitised(noiseflow.PoissonGaussian(2.0, 100.0, 1.5), 1.0, 0.0, 160.0)


def clipped() -> noiseflow.Digitised:
    """Clipped where every millionth value is."""
    return noiseflow.Digitised(noiseflow.Gaussian(2.0), 0.0, 90.0, 150.0)


@pytest.mark.parametrize("kind", [noiseflow.Gaussian, noiseflow.Poisson, noiseflow.Mixture, camera, clipped])
@pytest.mark.filterwarnings("ignore:.*impossible under the model")
def test_impossible_observations_are_counted_and_others_not(kind: Callable[[], torch.nn.Module]) -> None:
    signal = 100 + 40 * torch.rand(20_000, generator=torch.Generator().manual_seed(0))
    model, random = kind(), torch.Generator().manual_seed(1)
    if isinstance(model, noiseflow.Mixture):
        known = signal + 3 * torch.randn(20_000, generator=random)
        model = noiseflow.fit(model, signal, known, num_steps=30).noise_model
    with torch.no_grad():
        own = model(signal).sample(generator=random)
    found = metrics.evaluate(model, signal, own)
    assert found.num_improbable == 0
    assert not found.notes
    few = torch.arange(20_000) % 1000 == 0
    for far in (-900.0, 900.0):
        found = metrics.evaluate(model, signal, torch.where(few, own + far, own))
        assert found.num_improbable == 20
        assert "20 of 20000" in found.notes[0]


def test_every_fitted_model_knows_its_range_and_evaluation_warns_beyond_it(tmp_path: Path) -> None:
    signal = torch.linspace(10, 50, 5000)
    observation = signal + torch.randn(5000, generator=torch.Generator().manual_seed(0))
    for model in (noiseflow.Gaussian(), noiseflow.SplineFlow(), noiseflow.AtLevel(noiseflow.PoissonGaussian(), 5.0)):
        assert not metrics.evaluate(noiseflow.Gaussian(1.0), signal + 1000, observation + 1000).notes
        fitted = noiseflow.fit(model, signal, observation, num_steps=5).noise_model
        fitted = noiseflow.load(noiseflow.save(fitted, tmp_path / f"{type(model).__name__}.safetensors"))
        assert fitted.fitted_range == pytest.approx((10, 50), abs=0.1)
        assert not metrics.evaluate(fitted, signal, observation).notes
        with pytest.warns(UserWarning, match="5000 of 5000 pixels have signals outside"):
            metrics.evaluate(fitted, signal + 1000, observation + 1000)


def camera_of_maps() -> noiseflow.WithMaps:
    """A camera whose pixels have their own gain, offset and read noise."""
    random = torch.Generator().manual_seed(3)
    gain, offset, variance = (torch.randn(96, 96, generator=random) for _ in range(3))
    ideal = noiseflow.Digitised(noiseflow.PoissonGaussian(gain=2.0, read_noise=1.0), step=1.0, low=0.0, high=65535.0)
    return noiseflow.WithMaps(ideal, 1 + 0.1 * gain, 100 + 4 * offset, torch.exp(variance))


def rows_of_offsets(scale: float = 1.0) -> noiseflow.ScanNoise:
    return noiseflow.ScanNoise(noiseflow.Gaussian(1.0), scale=scale)


@pytest.mark.parametrize("make", [camera_of_maps, rows_of_offsets])
def test_models_that_need_images_are_evaluated_pixel_by_pixel(make: Callable[[], torch.nn.Module]) -> None:
    model, random = make(), torch.Generator().manual_seed(0)
    signal = 5 + 200 * torch.rand(96, 96, generator=random)
    observation = model(signal).sample(generator=random)
    found = metrics.evaluate(model, signal, observation)
    assert found.nll == pytest.approx(-float(model(signal).log_prob(observation).double().mean()), abs=1e-5)
    assert found.overall.jsd < 2 * found.overall.jsd_floor
    assert found.mean_jsd < 1.2 * found.mean_jsd_floor
    assert found.ks < found.ks_floor
    assert min(min(tail.p_value) for tail in found.tails) > 1e-4
    assert found.num_improbable == 0
    kept = torch.rand(96, 96, generator=random) < 0.5
    masked = np.ma.MaskedArray(observation.numpy(), ~kept.numpy())
    assert metrics.evaluate(model, signal.numpy(), masked).num_pixels == int(kept.sum())
    with pytest.raises(ValueError, match="shapes must be equal"):
        metrics.evaluate(model, signal, observation.reshape(48, 192))
    with pytest.raises(ValueError, match="NaN"):
        metrics.evaluate(model, signal, torch.where(kept, observation, torch.nan))
    holes = metrics.evaluate(model, signal, torch.where(kept, observation, torch.nan), skip_non_finite=True)
    assert holes.num_pixels == int(kept.sum())


def test_wrong_maps_and_an_impossible_pixel_are_seen() -> None:
    model, random = camera_of_maps(), torch.Generator().manual_seed(0)
    signal = 5 + 200 * torch.rand(96, 96, generator=random)
    observation = model(signal).sample(generator=random)
    without = noiseflow.WithMaps(model.model, offset=model.offset)
    found = metrics.evaluate(without, signal, observation)
    assert found.ks > 2 * found.ks_floor
    assert found.overall.jsd > 3 * found.overall.jsd_floor
    observation[5, 7] = 5000.0
    with pytest.warns(UserWarning, match="1 of 9216 observations are impossible"):
        assert metrics.evaluate(model, signal, observation).num_improbable == 1


def test_masked_pixels_do_not_affect_those_that_share_an_offset_or_a_window_with_them() -> None:
    random = torch.Generator().manual_seed(1)
    rows, near = rows_of_offsets(2.0), noiseflow.RadialFlow(neighbourhood=3)
    signal = 10 + 50 * torch.rand(3, 48, 64, generator=random)
    observation, masked = rows(signal).sample(generator=random), torch.rand(3, 48, 64, generator=random) < 0.2
    spoilt = [torch.where(masked, 1e4, each).numpy() for each in (signal, observation)]
    expected = -float(
        rows(signal).log_prob(torch.where(masked, torch.nan, observation)).detach()[~masked].double().mean()
    )
    for shown in (spoilt, [signal.numpy(), spoilt[1]], [signal.numpy(), np.where(masked, np.nan, observation)]):
        images = [np.ma.MaskedArray(each, masked.numpy()) for each in shown]
        found = metrics.evaluate(rows, *images)
        assert found.nll == pytest.approx(expected, abs=1e-4)
        assert found.ks < 1.3 * found.ks_floor
    images = [np.ma.MaskedArray(each, masked.numpy()) for each in spoilt]
    filled = torch.where(masked, signal[~masked].mean(), signal)
    expected = -float(near(filled).log_prob(observation).detach()[~masked].double().mean())
    assert metrics.evaluate(near, *images).nll == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("legend", [False, True])
def test_histograms_of_residuals_and_densities_of_models_are_drawn_on_one_scale(legend: bool) -> None:
    models = {"right": noiseflow.Gaussian(2.0), "wide": noiseflow.Gaussian(4.0)}
    signal = np.linspace(10, 20, 40_000)
    observation = np.random.default_rng(0).normal(signal, 2.0)
    chart = residual_histogram(signal, observation, models, unit="counts", legend=legend)
    data, *densities = (float(drawn.max()) for drawn in chart._seen["y"])
    assert densities == pytest.approx([1 / (scale * np.sqrt(2 * np.pi)) for scale in (2.0, 4.0)], rel=2e-3)
    assert data == pytest.approx(densities[0], rel=0.1)
    assert [f">{name}</text>" in chart.svg() for name in ("data", *models)] == 3 * [legend]
