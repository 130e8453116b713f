"""A detector that rounds and clips in front of a model: what it keeps for fits, where it starts, what describes it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats

import noiseflow

LEVELS = torch.arange(-2, 19, dtype=torch.float64) / 16


def detector() -> noiseflow.PhysicsFlow:
    return noiseflow.PhysicsFlow(detector=noiseflow.PoissonGaussian(0.05, -0.02, 0.9)).double()


@pytest.mark.parametrize("step", [1 / 16, 0.0])
@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1.0), (0.0, math.inf), (-math.inf, 1.0), (0.0, 0.97), (-math.inf, math.inf)]
)
def test_what_a_fit_keeps_of_the_likelihood_is_the_likelihood(step: float, low: float, high: float) -> None:
    model = noiseflow.Digitised(detector(), step, low, high)
    reading = LEVELS.clamp(low, high)
    signal = torch.linspace(0.05, 0.95, len(reading), dtype=torch.float64)
    kept = model.fixed_part(signal, reading)
    assert kept is not None
    expected = model(signal).log_prob(reading)
    assert torch.isfinite(expected).all()
    assert torch.allclose(model.log_prob_from(signal, kept), expected, rtol=1e-9)
    assert noiseflow.Digitised(noiseflow.RadialFlow(2), step, low, high).fixed_part(signal, reading) is None


def test_settings_of_a_detector() -> None:
    plain = noiseflow.Digitised(noiseflow.Gaussian(0.1))
    assert (plain.step, plain.low, plain.high) == (1.0, -math.inf, math.inf)
    assert plain.config() == {"step": 1.0}
    model = noiseflow.Digitised(noiseflow.Gaussian(0.1), 0.5, -1.0, 3.0)
    assert model.config() == {"step": 0.5, "low": -1.0, "high": 3.0}
    free = model.without_rails()
    assert (free.step, free.low, free.high, free.model is model.model) == (0.5, -math.inf, math.inf, True)
    assert noiseflow.Digitised(noiseflow.Gaussian(), 0.0).step == 0
    for wrong in ((-0.1, 0.0, 1.0), (0.5, 1.0, 1.0)):
        with pytest.raises(ValueError, match=r"step is|low is"):
            noiseflow.Digitised(noiseflow.Gaussian(), *wrong)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_groups_of_pixels_that_a_limit_clips_are_left_out_or_mirrored(sign: float) -> None:
    """Signals up to the limit, of width 0.1: near it half of the readings are clipped, far from it none."""
    generator = torch.Generator().manual_seed(0)
    signal = sign * torch.linspace(0.0, 1.5, 64_000)
    observation = signal + 0.1 * torch.randn(signal.shape, generator=generator)
    observation[::40] = signal[::40]  # neither side's: they would be mirrored onto themselves
    limit = (sign * signal - 1.0).abs() < 1e-3
    signal[limit] = sign
    low, high = (-math.inf, 1.0) if sign > 0 else (-1.0, math.inf)
    model = noiseflow.Digitised(noiseflow.Gaussian(), 0.0, low, high)
    clipped = observation.clamp(low, high)
    kept, seen = model._before_rails(signal, clipped, mirror=False)
    reach = sign * signal
    # at 2.05 standard deviations from the limit 2 % are clipped
    assert float(kept[reach < 0.76].float().mean()) == 1.0
    assert not kept[reach > 0.83].any()
    assert torch.equal(seen, clipped)
    kept, seen = model._before_rails(signal, clipped, mirror=True)
    assert bool(kept[reach < 0.76].all())
    near = (reach > 0.85) & (reach < 0.98)
    free = sign * (clipped - signal) < 0
    assert torch.equal(kept[near], free[near])
    assert not kept[reach > 1.03].any()
    assert int(limit.sum()) > 50
    assert not kept[limit].any()  # of a signal on the limit nothing tells how far the noise would reach beyond
    spread = (seen - signal)[near & kept]
    assert float(spread.std()) == pytest.approx(0.1, rel=0.05)
    assert float(spread.mean()) == pytest.approx(0.0, abs=0.005)


@pytest.mark.parametrize("pixels", [100, 40_000])
def test_where_too_little_is_left_unclipped_all_of_it_counts(pixels: int) -> None:
    signal = torch.full((pixels,), 0.99) + torch.linspace(0, 1e-3, pixels)
    observation = (signal + 0.1 * torch.randn(pixels, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    model = noiseflow.Digitised(noiseflow.Gaussian(), 0.0, 0.0, 1.0)
    model.standardise(signal, observation)
    assert float(model.model.log_scale.detach().exp()) == pytest.approx(float((observation - signal).std()), rel=0.5)


@pytest.mark.parametrize(("pixels", "suffice"), [(1024, True), (40_000, False)])
def test_256_unclipped_pixels_and_a_tenth_of_all_suffice_to_start_from(pixels: int, suffice: bool) -> None:
    """Unclipped are 16 of 64 groups by signal, 256 pixels, or one group, 625 pixels; their noise is a tenth as wide."""
    unclipped = torch.arange(pixels) < (pixels // 4 if suffice else pixels // 64)
    signal = torch.where(unclipped, 0.0, 1.0) + torch.linspace(0, 1e-3, pixels)
    noise = torch.randn(pixels, generator=torch.Generator().manual_seed(0)) * torch.where(unclipped, 0.01, 0.1)
    model = noiseflow.Digitised(noiseflow.Gaussian(), 0.0, -1.0, 1.0)
    model.standardise(signal, (signal + noise).clamp(-1, 1))
    assert (float(model.model.log_scale.detach().exp()) < 0.02) == suffice


@pytest.mark.parametrize("bounds", [1, 2])
def test_a_model_that_keeps_only_half_of_its_likelihood_keeps_none_behind_limits(bounds: int) -> None:
    class Half(noiseflow.Gaussian):
        def fixed_part(self, signal, *values):
            return torch.zeros(len(signal), 2) if len(values) == bounds else None

    inner = Half(0.1)
    model = noiseflow.Digitised(inner, 0.0, 0.0, 1.0)
    assert model.fixed_part(torch.full((3,), 0.5), torch.tensor([0.0, 0.4, 1.0])) is None


def _distance(shares: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Half the chi-squared distance, nats."""
    return float(((shares - truth) ** 2 / truth).sum() / 2)


def test_unequal_levels_are_recognised_matched_and_saved(tmp_path: Path) -> None:
    """Counts stored as square roots: the levels hold four to twenty counts each, and midpoints miss how many."""
    random = np.random.default_rng(3)
    signal = random.uniform(20, 400, 30_000)
    stored = np.round(2 * np.sqrt(random.poisson(signal))) ** 2 / 4
    result = noiseflow.fit(noiseflow.SignalDependentGaussian(), signal.astype(np.float32), stored.astype(np.float32))
    model = result.noise_model
    assert len(result.digitisation.levels) == len(np.unique(stored))
    level, counts = np.unique(stored, return_counts=True)
    midpoints = noiseflow.Digitised(model.model, levels=level.tolist())
    even = np.sort(signal)[10::20]
    number = np.arange(700)
    masses, stored_as = stats.poisson.pmf(number, even[:, None]).mean(0), np.round(2 * np.sqrt(number)) ** 2 / 4
    truth = np.array([masses[stored_as == each].sum() for each in level])
    matched, evenly = (
        _distance(each(torch.from_numpy(even)).quadrature()[1].detach().mean(1).numpy(), truth)
        for each in (model, midpoints)
    )
    # nearer to the truth than ideal edges, and than the counted shares of the levels
    assert matched < 0.6 * min(evenly, _distance(counts / 30_000, truth))
    at = torch.tensor(60.0)
    found = model(at)
    mass = found.quadrature()[1].detach()
    assert float(mass.sum()) == pytest.approx(1, abs=1e-6)
    again = noiseflow.load(noiseflow.save(model, tmp_path / "coded.safetensors"))
    assert torch.equal(again(at).quadrature()[1].detach(), mass)
    drawn = found.sample((1000,), generator=torch.Generator().manual_seed(0))
    assert set(drawn.tolist()) <= set(level.tolist())
    assert float(found.cdf(torch.tensor(stored.max()))) == 1
    equal = noiseflow.Digitised(noiseflow.Gaussian(3.0), 2.0)
    coded = noiseflow.Digitised(noiseflow.Gaussian(3.0), levels=[2.0 * k for k in range(60)])
    values, signals = torch.tensor([50.0, 52.0, 70.0]), torch.full((3,), 51.0)
    for method in ("log_prob", "cdf", "cdf_below"):
        assert torch.allclose(
            getattr(coded(signals), method)(values), getattr(equal(signals), method)(values), atol=1e-6
        )


@pytest.mark.parametrize("levels", [[1.0], [1.0, 3.0, 2.0]])
def test_levels_that_do_not_increase_are_refused(levels: list[float]) -> None:
    with pytest.raises(ValueError, match="levels"):
        noiseflow.Digitised(noiseflow.Gaussian(), levels=levels)


def test_a_level_that_the_fitted_pixels_lack_is_not_impossible() -> None:
    signal = torch.rand(4000, generator=torch.Generator().manual_seed(0)) * 6 + 2
    model = noiseflow.Digitised(noiseflow.Gaussian(1.0), levels=[float(k * k) for k in range(6)])
    observation = model(signal).sample(generator=torch.Generator().manual_seed(1)).clamp(max=9.0)
    assert model.match_levels(signal, observation)
    assert torch.isfinite(model(signal[:5]).log_prob(torch.tensor([0.0, 4.0, 9.0, 16.0, 25.0]))).all()


_MISSING = [float(k) for k in range(400) if k % 4 != 3]
_COMPANDED = [*range(64), *range(64, 256, 4), *range(256, 1024, 16)]
_RANDOM = sorted(np.random.default_rng(8).uniform(0, 400, 120).tolist())


@pytest.mark.parametrize("levels", [_MISSING, _COMPANDED, _RANDOM], ids=["missing", "companded", "random"])
def test_any_increasing_levels_are_recognised_and_cost_nothing(levels: list[float]) -> None:
    random, places = np.random.default_rng(5), np.asarray(levels, np.float64)
    signal = random.uniform(30, 350, 30_000)
    value = signal + 6 * random.standard_normal(signal.size)
    stored = places[np.searchsorted((places[1:] + places[:-1]) / 2, value)]
    result = noiseflow.fit(noiseflow.Gaussian(), signal, stored)
    assert set(result.digitisation.levels) == set(stored.tolist())
    truth = noiseflow.Digitised(noiseflow.Gaussian(6.0), levels=levels)
    again = truth(torch.from_numpy(signal)).sample(generator=torch.Generator().manual_seed(0))
    lost = truth(signal).log_prob(again.numpy()) - result.noise_model(signal).log_prob(again.numpy())
    assert float(lost.mean()) < 1e-3


def test_edges_are_fitted_to_the_training_pixels_as_they_count() -> None:
    """Held-out pixels that lack other codes do not move the edges; a pixel of weight 3 moves them as three pixels do."""
    signal = 20 + 40 * torch.rand(6000, generator=torch.Generator().manual_seed(0))
    code = (signal + 4 * torch.randn(6000, generator=torch.Generator().manual_seed(1))).round()
    levels, held_out = [float(each) for each in range(100)], torch.arange(6000) % 3 == 0
    once, thrice = (code - (code.remainder(4) == each).float() for each in (1, 3))

    def edges(observation: torch.Tensor, *pixels: torch.Tensor, **options: object) -> torch.Tensor:
        model = noiseflow.Digitised(noiseflow.Gaussian(4.0), levels=levels)
        return noiseflow.fit(model, *pixels or (signal,), observation, **options).noise_model.edges

    judged = [edges(torch.where(held_out, each, once), held_out=held_out) for each in (once, thrice)]
    assert torch.equal(*judged)
    weight = 1 + 2 * (torch.arange(6000) % 2).double()
    repeated = (torch.repeat_interleave(each, weight.long()) for each in (once, signal, held_out))
    code, shown, out = repeated
    torch.testing.assert_close(edges(once, held_out=held_out, weights=weight), edges(code, shown, held_out=out))


@pytest.mark.parametrize("uneven", [True, False])
def test_equal_levels_with_uneven_codes_are_recognised(uneven: bool, tmp_path: Path) -> None:
    """A converter whose odd codes are a third wider than its even ones, and an ideal one."""
    codes = np.arange(-50, 300)
    edges = codes[1:] - 0.5 - np.where(codes[1:] % 2 == 1, 1 / 12, -1 / 12) * uneven
    truth = noiseflow.Digitised(noiseflow.Gaussian(3.0), levels=codes.tolist(), edges=edges.tolist())
    signal = np.random.default_rng(6).uniform(30, 200, 30_000)
    stored = truth(torch.from_numpy(signal)).sample(generator=torch.Generator().manual_seed(1))
    model = noiseflow.fit(noiseflow.Gaussian(), signal, stored).noise_model
    assert bool(model.levels.numel()) == uneven
    again = truth(torch.from_numpy(signal)).sample(generator=torch.Generator().manual_seed(2))
    lost = truth(torch.from_numpy(signal)).log_prob(again) - model(torch.from_numpy(signal)).log_prob(again)
    assert float(lost.detach().mean()) < 1e-3
    loaded = noiseflow.load(noiseflow.save(model, tmp_path / "codes.safetensors"))
    assert torch.equal(loaded(torch.tensor(80.0)).log_prob(81.0), model(torch.tensor(80.0)).log_prob(81.0))


def test_values_of_a_scene_with_few_levels_are_no_levels_of_a_converter() -> None:
    random = np.random.default_rng(7)
    signal = random.choice([10.0, 60.0, 150.0], 30_000)
    values = np.round(signal + 0.4 * random.standard_normal(signal.size))
    found = noiseflow.detect_digitisation(values, signal)
    assert found.step == 1
    assert not found.levels


def test_codes_are_not_taken_for_uneven_where_one_level_holds_most_pixels() -> None:
    """Vacuum of counts: a noise model that fits it badly makes an error at one level, which is no pattern of a converter."""
    random = np.random.default_rng(3)
    signal = np.r_[np.zeros(50_000), random.uniform(0, 300, 10_000)]
    observation = torch.from_numpy(random.poisson(signal).astype(float))
    estimate = torch.from_numpy(signal + 0.05)
    model = noiseflow.Digitised(noiseflow.SignalDependentGaussian(), low=0.0)
    model.standardise(estimate, observation)
    assert not model.match_levels(estimate, observation)


def test_codes_of_random_widths_are_told_from_errors_of_the_noise_model() -> None:
    random = np.random.default_rng(0)
    edges = np.cumsum(random.uniform(0.6, 1.4, 200)) - 0.5
    signal = random.uniform(30, 150, 40_000)
    law = torch.from_numpy(signal), torch.from_numpy(signal + 4 * random.standard_normal(40_000))
    coded = torch.from_numpy(np.searchsorted(edges, law[1].numpy()).astype(float))
    found = noiseflow.fit(noiseflow.Gaussian().double(), law[0], coded).noise_model
    assert found.levels.numel() > 100
    inside = (found.levels[1:] > 40) & (found.levels[1:] < 140)
    true = torch.from_numpy(edges)[found.levels[1:][inside].long() - 1]
    assert (
        float((found.edges[inside] - true).diff().std()) < 0.15
    )  # the widths scatter by 0.23, those of pixels by 0.06
    heavy = (law[0] + 3 * torch.distributions.StudentT(3.0).sample((40_000,))).round()
    assert not noiseflow.fit(noiseflow.Gaussian().double(), law[0], heavy).noise_model.levels.numel()


def test_three_significant_digits_are_levels_of_two_steps() -> None:
    random = np.random.default_rng(0)
    signal = random.uniform(60, 160, 40_000)
    value = signal + np.sqrt(1 + 0.3 * signal) * random.standard_normal(40_000)
    digits = np.where(value < 99.95, value.round(1), value.round())
    found = noiseflow.detect_digitisation(digits, signal)
    assert 500 < len(found.levels) < 1024


@pytest.mark.parametrize(
    ("step", "levels", "said"),
    [(1.0, range(751), "rounded to steps of 1 of unequal width"), (0.5, (0, 1, 4, 9), "coded in 4 unequal levels")],
)
def test_the_words_tell_equal_steps_from_unequal_levels(step: float, levels: Iterable[int], said: str) -> None:
    assert noiseflow.Digitisation(step, levels=tuple(map(float, levels))).in_words() == said


@pytest.mark.parametrize("seed", [0, 1])
def test_a_peak_that_the_noise_model_lacks_is_no_pattern_of_the_converter(seed: int) -> None:
    """A multiplying detector in low light: most pixels hold no electron, a few counts wide, and the others reach far."""
    random = np.random.default_rng(seed)
    electrons = random.uniform(0.1, 3, 30_000)
    multiplied = random.standard_gamma(np.maximum(random.poisson(electrons), 1e-9)) * 30
    stored = np.round(100 + multiplied + 3 * random.standard_normal(electrons.size))
    fits = [
        noiseflow.fit(kind(), 100 + 30 * electrons, stored)
        for kind in (noiseflow.Gaussian, noiseflow.SignalDependentGaussian)
    ]
    assert not any(each.noise_model.levels.numel() for each in fits)
    simple, flexible = (each.held_out_nll for each in fits)
    assert flexible < simple


@pytest.mark.parametrize(("missing", "period"), [(3, 4), (7, 8), (1, 3)])
def test_a_pattern_of_missing_codes_is_learnt_by_code_and_by_place(missing: int, period: int) -> None:
    generator = torch.Generator().manual_seed(0)

    def draw(count: int) -> tuple[torch.Tensor, torch.Tensor]:
        signal = 10 + 190 * torch.rand(count, generator=generator)
        code = (signal + 5 * torch.randn(count, generator=generator)).round()
        return signal, code - (code.remainder(period) == missing).float()

    model = noiseflow.fit(noiseflow.Gaussian(), *draw(20_000)).noise_model
    fresh = draw(200_000)
    width = torch.where((fresh[1] + 1).remainder(period) == missing, 1.5, 0.5)
    law = torch.distributions.Normal(fresh[0].double(), 5.0)
    exact = torch.log(law.cdf(fresh[1] + width) - law.cdf(fresh[1] - 0.5))
    lost = exact - noiseflow.metrics.pixel_log_prob(model, *fresh)
    assert float(lost.mean()) < 0.0015  # 0.0034 where each level has to tell its width
