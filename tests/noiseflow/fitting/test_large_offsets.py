"""Fits and selections do not depend on a constant that is added to signal and observation, however large it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import noiseflow

_RANDOM = np.random.default_rng(0)
SIGNAL = _RANDOM.uniform(2, 40, 12_000)
OBSERVATION = SIGNAL + 0.3 * np.sqrt(SIGNAL) * _RANDOM.normal(size=SIGNAL.size)
CANDIDATES = {"Gaussian": noiseflow.Gaussian, "SignalDependentGaussian": noiseflow.SignalDependentGaussian}


def nll(model: torch.nn.Module, offset: float = 0.0) -> float:
    return -float(np.mean(model(SIGNAL + offset).log_prob(OBSERVATION + offset)))


@pytest.mark.parametrize("offset", [-1e9, 1e12])
@pytest.mark.parametrize("kind", ["Mixture", "PoissonGaussian", "Poisson"])
def test_a_fit_is_that_of_the_values_above_the_offset(kind: str, offset: float, tmp_path) -> None:
    made = getattr(noiseflow, kind)
    wanted = noiseflow.fit(made(), SIGNAL, OBSERVATION)
    found = noiseflow.fit(made(), SIGNAL + offset, OBSERVATION + offset)
    model = noiseflow.load(noiseflow.save(found.noise_model, tmp_path / "model.safetensors"))
    assert nll(model, offset) == pytest.approx(nll(wanted.noise_model), abs=3e-4)
    assert model.fitted_range == pytest.approx((SIGNAL.min() + offset, SIGNAL.max() + offset), abs=1e-3)
    again = noiseflow.fit(found.noise_model, SIGNAL + offset, OBSERVATION + offset)
    assert nll(again.noise_model, offset) == pytest.approx(nll(model, offset), abs=3e-4)


@pytest.mark.parametrize("offset", [1e7, 1e12])
def test_a_selection_is_that_of_the_values_above_the_offset(offset: float) -> None:
    seen = []
    candidates = {name: kind() for name, kind in CANDIDATES.items()}
    enough = {"enough": lambda model: seen.append(nll(model, offset)) or False}
    chosen = noiseflow.select(SIGNAL + offset, OBSERVATION + offset, candidates=candidates, **enough).chosen
    assert chosen.name == "SignalDependentGaussian"
    wanted = noiseflow.fit(noiseflow.SignalDependentGaussian(), SIGNAL, OBSERVATION).noise_model
    assert nll(chosen.model, offset) == pytest.approx(nll(wanted), abs=3e-4)
    assert all(abs(each - nll(wanted)) < 1 for each in seen)
    assert seen


@pytest.mark.parametrize("kind", [np.int64, np.float64])
def test_rounded_values_keep_their_steps(kind: type) -> None:
    signal, counts = SIGNAL.round(), _RANDOM.poisson(SIGNAL.round())
    counts[::50] = 0  # dead pixels
    drawn = []
    for offset in (0, 10**10):
        given = [(each + offset).astype(kind) for each in (signal, counts)]
        found = noiseflow.select(*given, candidates={"Mixture4": noiseflow.Mixture(4)})
        assert found.digitisation.step == 1
        assert found.digitisation.origin % 1 == 0
        law = found.chosen.model(signal + offset)
        drawn.append(law.sample(generator=torch.Generator().manual_seed(0)) - offset)
    assert bool((drawn[1] == drawn[1].round()).all())
    assert np.mean(drawn[0] != drawn[1]) < 0.01


def test_models_of_conditions_are_raised_at_every_place() -> None:
    gain = np.repeat([1.0, 2.0], SIGNAL.size // 2)
    observation = SIGNAL + gain * (OBSERVATION - SIGNAL)
    for kind in (noiseflow.Gaussian, noiseflow.Poisson):
        fits = [
            noiseflow.fit(kind(), SIGNAL + offset, observation + offset, condition={"gain": gain}).noise_model
            for offset in (0.0, 1e10)
        ]
        for each in (1.0, 2.0):
            low, high = (
                model(np.array([20.0]) + offset, condition={"gain": each}).variance
                for model, offset in zip(fits, (0.0, 1e10), strict=True)
            )
            np.testing.assert_allclose(high, low, rtol=1e-3)


def test_values_that_lie_above_no_level_stay_in_double_precision() -> None:
    signal = np.concatenate([SIGNAL, SIGNAL + 1e9])
    observation = np.concatenate([OBSERVATION, OBSERVATION + 1e9])
    chosen = noiseflow.select(signal, observation, candidates={"Gaussian": noiseflow.Gaussian()}).chosen
    assert chosen.model(torch.zeros(())).stddev.item() == pytest.approx(np.std(OBSERVATION - SIGNAL), rel=0.05)


def test_single_precision_that_has_lost_the_noise_is_refused() -> None:
    pixels = [(each + 1e8).astype(np.float32) for each in (SIGNAL, OBSERVATION)]
    with pytest.raises(ValueError, match="give float64"):
        noiseflow.fit(noiseflow.Gaussian(), *pixels)
    with pytest.raises(ValueError, match="give float64"):
        noiseflow.select(*pixels)


def test_models_of_images_ask_for_a_subtracted_constant() -> None:
    images = [(each + 1e9).reshape(100, 120) for each in (SIGNAL, OBSERVATION)]
    with pytest.raises(ValueError, match="subtract a constant"):
        noiseflow.fit(noiseflow.ScanNoise(noiseflow.Gaussian()), *images)
