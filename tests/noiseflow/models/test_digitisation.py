"""Rounding and rails are found in readings that show them, and only there; a fit takes them into account."""

import logging
import math

import numpy as np
import pytest
import torch
from scipy import ndimage

import noiseflow
from noiseflow import Digitisation, detect_digitisation
from tests.independent_scenes import Noise, binned, clipped, independent_series, poisson, scaled

READINGS = np.random.default_rng(0).normal(0.5, 0.3, 20_000).astype(np.float32)
NONE = Digitisation()


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e9])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_continuous_readings_are_not_digitised(scale: float, offset: float) -> None:
    assert detect_digitisation((READINGS + np.float32(offset)) * np.float32(scale)) == NONE
    assert detect_digitisation(np.random.default_rng(0).random(10_000, dtype=np.float32)) == NONE


def test_limits_are_found_only_where_values_of_equal_signal_pile_up() -> None:
    def found(values: np.ndarray, signal: float) -> Digitisation:
        return detect_digitisation(values, np.full(values.shape, signal))

    assert found(READINGS.clip(0, 1), 0.5) == Digitisation(0.0, 0.0, 1.0)
    assert found(READINGS.clip(-9, 1), 0.5) == Digitisation(0.0, -math.inf, 1.0)
    assert found(np.round(READINGS.clip(0, 1) * 255).astype(np.uint8), 127.5) == Digitisation(1.0, 0.0, 255.0)
    assert found(np.round(READINGS * 50), 25) == Digitisation(1.0, -math.inf, math.inf)
    assert found(np.round(READINGS.clip(0, 1) * 20), 10) == Digitisation(1.0, 0.0, 20.0)
    assert detect_digitisation(np.array([3, 255, 7], np.uint8)).high == 255.0
    assert detect_digitisation(READINGS.clip(0, 1)) == Digitisation(0.0, -math.inf, 1.0)


def _multiplied(clean: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, float]:
    electrons = random.poisson(5 * clean)
    return np.where(electrons > 0, random.gamma(electrons.clip(1), 20), 0).round(), 100.0


END_AT_ZERO: dict[str, Noise] = {
    **{f"{counts} counts": poisson(counts) for counts in (2, 10, 40, 100)},
    "dark offset": poisson(40, offset=10),
    "8 bits": scaled,
    "binned": binned,
    "multiplied electrons": _multiplied,
    "exact zeros": lambda clean, random: (
        np.where(clean > 0, clean + random.normal(0, 0.02, clean.shape), 0).clip(0),
        1.0,
    ),
}
CLIPPED: dict[str, Noise] = {
    "clipped": clipped(40, 0, 3),
    "clipped above a dark offset": clipped(40, 2, 3),
    "clipped below a dark offset": clipped(40, -2, 3),
    "few counts": clipped(10, 0, 1.5),
    "not rounded": lambda clean, random: ((clean + random.normal(0, 0.1, clean.shape)).clip(0), 1.0),
}


@pytest.mark.parametrize("scene", ["core_shell", "beads", "vesicles_in_ice"])
@pytest.mark.parametrize("name", [*END_AT_ZERO, *CLIPPED])
def test_counts_that_end_at_zero_are_not_clipped_and_clipped_values_are(name: str, scene: str) -> None:
    """Also if the signal is predicted with errors at every edge."""
    made = independent_series(scene, (END_AT_ZERO | CLIPPED)[name], "±70°/5°")
    for blur in (0.0, 0.7):
        predicted = ndimage.gaussian_filter(made.clean, (0, blur, blur))
        low = detect_digitisation(made.series.images, predicted).low
        assert low == (0.0 if name in CLIPPED else -math.inf), blur


@pytest.mark.parametrize("rate", [0.05, 0.3, 1.0, 10.0])
def test_counts_of_electrons_have_no_rail_at_zero(rate: float) -> None:
    counts = np.random.default_rng(0).poisson(rate, 100_000)
    assert detect_digitisation(counts) == Digitisation(1.0, -math.inf, math.inf)


@pytest.mark.parametrize("step", [1.0, 16.0, 1 / 255, 0.1, 1 / 65535])
@pytest.mark.parametrize("offset", [0.0, 0.37])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rounding_is_found_whatever_its_step(step: float, offset: float, dtype: type) -> None:
    readings = np.concatenate([READINGS] * 3).astype(np.float64) * (30 * step if step >= 1 else 1)
    rounded = (np.round(readings / step) * step + offset).astype(dtype)
    assert detect_digitisation(rounded).step == pytest.approx(step, rel=1e-3)


def test_integers_are_rounded_to_their_common_step() -> None:
    counts = np.round(READINGS * 400).astype(np.int16)
    assert detect_digitisation(counts).step == 1
    assert detect_digitisation(counts * np.int16(16)).step == 16
    assert detect_digitisation(counts.astype(np.float64) * 16).step == 16
    assert detect_digitisation(np.round(READINGS * 1e6).astype(np.int32)).step == 1


def test_pixels_that_are_not_used_do_not_count() -> None:
    values = 100 * torch.rand(1000, generator=torch.Generator().manual_seed(0))
    values[:900] = values[:900].round()
    assert detect_digitisation(values).step == 0
    assert detect_digitisation(values, use=torch.arange(1000) < 900).step == 1
    assert not detect_digitisation(values, use=torch.zeros(1000, dtype=torch.bool)).found


def test_readings_that_are_not_finite_do_not_hide_the_rest() -> None:
    clipped = READINGS.clip(0, 1)
    clipped[:5] = np.nan, np.inf, -np.inf, np.nan, np.inf
    assert detect_digitisation(clipped, np.full(clipped.shape, 0.5)) == Digitisation(0.0, 0.0, 1.0)
    assert detect_digitisation(np.full(4, np.nan)) == NONE
    assert detect_digitisation(np.zeros(0)) == NONE
    assert detect_digitisation(np.zeros(100)) == NONE


def image(step: float, *, integer: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(20_000, generator=generator)
    observation = signal + 0.1 * torch.randn(20_000, generator=generator)
    if integer:
        return signal / step, (observation / step).round().to(torch.int32)
    return signal, (observation / step).round().clamp(0, 1 / step) * step


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_pixels_in_half_precision_are_read(dtype: torch.dtype) -> None:
    signal = torch.linspace(1, 5, 4000)
    observation = signal + 0.5 * torch.randn(4000, generator=torch.Generator().manual_seed(0))
    pair = signal.to(dtype), observation.to(dtype)
    assert not detect_digitisation(pair[1], pair[0]).found
    assert noiseflow.fit(noiseflow.Gaussian(), *pair, num_steps=1).held_out_nll == pytest.approx(0.72, abs=0.01)
    found = noiseflow.select(*pair, candidates={"Gaussian": noiseflow.Gaussian()}, num_steps=1)
    assert found.chosen.nll == pytest.approx(0.69, abs=0.01)


def test_fit_finds_rounding_and_rails_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    signal, observation = image(1 / 20)
    with caplog.at_level(logging.WARNING, logger="noiseflow"):
        result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=100)
    assert isinstance(result.noise_model, noiseflow.Digitised)
    assert result.digitisation[:4] == pytest.approx((1 / 20, 0.0, 1.0, 0.0))
    assert "rounded to steps of 0.05 and clipped at 0 and 1" in caplog.text
    assert float(result.noise_model.model.log_scale.detach().exp()) == pytest.approx(0.1, rel=0.03)


def test_fit_takes_integers_and_leaves_digitised_models_alone() -> None:
    signal, observation = image(1 / 20, integer=True)
    result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=100)
    assert result.digitisation == Digitisation(1.0, -math.inf, math.inf)
    assert float(result.noise_model.model.log_scale.detach().exp()) == pytest.approx(2.0, rel=0.03)
    for given in (noiseflow.Digitised(noiseflow.Gaussian(), step=1.0), noiseflow.Poisson()):
        result = noiseflow.fit(given, signal, observation, num_steps=2)
        assert result.noise_model is given
        assert not result.digitisation.found
    off = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=2, digitise=False)
    assert isinstance(off.noise_model, noiseflow.Gaussian)


@pytest.mark.parametrize("name", ["SplineFlow", "RadialFlow"])
def test_fine_rounding_costs_no_accuracy_in_single_precision(name: str) -> None:
    """Cells of a thousandth of the noise: differences of latents would lose all digits."""
    signal = torch.linspace(30_000, 40_000, 2000)
    model = getattr(noiseflow, name)()
    observation = signal + 300 * torch.randn(2000, generator=torch.Generator().manual_seed(0))
    model.standardise(signal, observation)
    rounded = noiseflow.Digitised(model, step=1.0)
    with torch.no_grad():
        difference = rounded(signal).log_prob(observation.round()) - model(signal).log_prob(observation.round())
    assert float(difference.abs().max()) < 2e-3


@pytest.mark.parametrize(("low", "high"), [(0.0, math.inf), (-math.inf, 1.0), (0.0, 1.0)])
def test_a_flow_starts_with_the_width_that_the_noise_had_before_the_rails(low: float, high: float) -> None:
    signal = torch.linspace(0.0, 1.0, 200_000)
    width = 0.05 + 0.2 * signal
    observation = signal + width * torch.randn(signal.shape, generator=torch.Generator().manual_seed(0))
    model = noiseflow.Digitised(noiseflow.SignalDependentGaussian(), 0.0, low, high)
    model.standardise(signal, observation.clamp(low, high))
    with torch.no_grad():
        found = model.model(signal).stddev
    assert float((found / width).log().abs().max()) < 0.1
    assert float((found / width)[::20].log().abs().median()) < 0.02


def test_pixels_that_are_not_finite_are_left_out_where_asked() -> None:
    signal, observation = image(1 / 20)
    broken = observation.clone()
    broken[:7] = math.nan
    with pytest.raises(ValueError, match="7 pixels of signal or observation are NaN"):
        noiseflow.fit(noiseflow.Gaussian(), signal, broken)
    result = noiseflow.fit(noiseflow.Gaussian(), signal, broken, skip_non_finite=True, num_steps=20)
    assert result.digitisation.step == pytest.approx(1 / 20)
    assert math.isfinite(result.held_out_nll)


@pytest.mark.parametrize("rails", [{"low": 0.0, "high": 1.0}, {"low": 0.0}, {"high": 1.0}, {}])
@pytest.mark.parametrize("step", [0.0, 0.125])
def test_likelihood_is_the_same_pixel_by_pixel_as_by_reading(step: float, rails: dict[str, float]) -> None:
    """Between the rails it is that of one level, on a rail that of all beyond; however signals and readings are laid out."""
    inner, signals = noiseflow.Gaussian(0.3), torch.linspace(-0.2, 1.2, 29)
    model = noiseflow.Digitised(inner, step=step, **rails)
    readings = torch.arange(9) / 8
    base, low, high = inner(signals[:, None]), rails.get("low", -math.inf), rails.get("high", math.inf)
    below = torch.where(readings <= low, -math.inf, readings - step / 2)
    above = torch.where(readings >= high, math.inf, readings + step / 2)
    masses = base.cdf(above.expand(29, -1)) - base.cdf(below.expand(29, -1))
    density = base.log_prob(readings.expand(29, -1))
    on_rail = (readings <= low) | (readings >= high)
    expected = torch.where(on_rail | torch.tensor(step > 0), masses.log(), density)
    by_reading = model(signals[:, None]).log_prob(readings.expand(29, -1))
    by_pixel = model(signals.repeat_interleave(9)).log_prob(readings.repeat(29)).view(29, 9)
    torch.testing.assert_close(by_reading, expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(by_pixel, by_reading)


@pytest.mark.parametrize(("step", "origin"), [(2.0, 1.0), (0.1, 0.03), (4.0, -1.0)])
def test_levels_that_are_no_multiples_of_the_step_are_sampled_where_they_are(step, origin, tmp_path):
    values = origin + step * np.random.default_rng(0).normal(300, 20, 20_000).round()
    found = detect_digitisation(values)
    assert (found.step, found.origin) == (pytest.approx(step), pytest.approx(origin, abs=1e-3 * step))
    model = noiseflow.Digitised(noiseflow.Gaussian(20 * step), *found)
    noiseflow.save(model, tmp_path / "model.safetensors")
    for one in (model, noiseflow.load(tmp_path / "model.safetensors")):
        distribution = one(torch.full((4096,), 300 * step, dtype=torch.float64))
        drawn = distribution.sample(generator=torch.Generator().manual_seed(0))
        away = (drawn - origin) / step
        assert torch.allclose(away, away.round(), atol=1e-2)
        assert torch.isfinite(distribution.log_prob(drawn)).all()
        assert bool(distribution.support.check(drawn).all())


def test_a_low_limit_shows_where_few_of_the_signals_reach_it() -> None:
    random = np.random.default_rng(0)
    signal = random.uniform(1, 240, 50_000)
    values = (2 * random.poisson(signal / 2) + 3 * random.standard_normal(signal.size)).round().clip(0, 255)
    found = noiseflow.detect_digitisation(values, signal)
    assert (found.step, found.low, found.high) == (1.0, 0.0, 255.0)
