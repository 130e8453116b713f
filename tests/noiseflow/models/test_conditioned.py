"""Noise that depends on named conditions: as good as separate models, interpolated between, saved with names and ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import noiseflow
from benchmarks.pages.conditions import COUNT, GAINS, exposures, loss, pooled, truth


@pytest.fixture(scope="module")
def six_gains() -> noiseflow.Conditioned:
    return pooled(noiseflow.SignalDependentGaussian)


def test_six_gains_in_one_model_are_as_good_as_six_models(six_gains: noiseflow.Conditioned) -> None:
    for seed, gain in enumerate(GAINS):
        alone = noiseflow.fit(noiseflow.SignalDependentGaussian(), *exposures(gain, seed)).noise_model
        assert loss(six_gains.at({"gain": gain}), gain) < loss(alone, gain) + 0.005


@pytest.mark.parametrize("gain", [1.4, 6.0, 23.0])
def test_a_seventh_gain_is_interpolated(six_gains: noiseflow.Conditioned, gain: float) -> None:
    assert loss(six_gains.at({"gain": gain}), gain) < 0.02


def test_conditions_are_saved_and_sampled(
    six_gains: noiseflow.Conditioned, run: Any, refused: Any, tmp_path: Path
) -> None:
    path, clean, noisy = tmp_path / "camera.safetensors", tmp_path / "clean.npy", tmp_path / "noisy.npy"
    loaded = noiseflow.load(noiseflow.save(six_gains, path))
    assert loaded.ranges == {"gain": (1.0, 32.0)}
    signal = torch.full((3,), 130.0)
    both = [each(signal, condition={"gain": 3.0}).mean for each in (six_gains, loaded)]
    assert torch.equal(*both)
    np.save(clean, np.full((40, 40), 200.0, np.float32))
    run("sample", path, clean, "-o", noisy, "--condition", "gain=8")
    assert np.load(noisy).std() == pytest.approx(float(truth(8.0)(torch.tensor(200.0)).stddev.detach()), rel=0.1)
    assert "gain" in refused("sample", path, clean, "-o", tmp_path / "n.npy")
    assert "gain" in refused("sample", path, clean, "-o", tmp_path / "n.npy", "--condition", "gain=much")


def test_two_conditions_and_many_values_make_a_grid() -> None:
    random = torch.Generator().manual_seed(0)
    signal, tilt = torch.rand(16_000, generator=random), torch.rand(16_000, generator=random)
    camera = torch.arange(16_000) % 2
    width = 0.1 * (1 + tilt) * (1 + camera)
    observation = signal + width * torch.randn(16_000, generator=random)
    condition = {"tilt": tilt, "camera": camera}
    model = noiseflow.fit(noiseflow.Gaussian(), signal, observation, condition=condition).noise_model
    for place in ({"tilt": 0.5, "camera": 0}, {"tilt": 0.8, "camera": 1}):
        expected = 0.1 * (1 + place["tilt"]) * (1 + place["camera"])
        assert float(model(torch.tensor(0.5), condition=place).stddev) == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        *((each, "a number for each condition") for each in ({}, {"tilt": 1.0}, {"gain": 2.0, "tilt": 0.0}, 2.0)),
        ({"gain": torch.ones(2, 2)}, "a number for"),
        ({"gain": 64.0}, "range"),
    ],
)
def test_conditions_that_the_model_has_not_are_refused(
    six_gains: noiseflow.Conditioned, condition: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        six_gains(torch.tensor([150.0]), condition=condition)


@pytest.mark.parametrize(
    "condition", [{}, {"gain": torch.ones(3)}, {"gain": float("nan")}, {"gain": torch.arange(float(COUNT)) % 40 // 39}]
)
def test_conditions_that_cannot_be_fitted_are_refused(condition: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"condition|combination"):
        noiseflow.fit(noiseflow.Gaussian(), *exposures(2.0, 0), condition=condition)


def test_conditions_that_do_not_predict_each_other_are_told() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = 100 * torch.rand(6000, generator=generator)
    camera = torch.tensor([1.0, 2.0, 3.0]).repeat(2000)
    spread = torch.where(camera == 2, 30.0, 3.0)
    observation = signal + spread * torch.randn(6000, generator=generator)
    with pytest.warns(UserWarning, match="between"):
        noiseflow.fit(noiseflow.Gaussian(), signal, observation, condition={"camera": camera})


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("model", [noiseflow.SignalDependentGaussian, noiseflow.RadialFlow])
def test_few_pixels_at_each_gain_predict_the_gains_between(model: type, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    gain = 2.0 ** torch.randint(4, (6700,), generator=generator)
    signal = 0.2 + 0.8 * torch.rand(6700, generator=generator)
    observation = signal + (4e-4 + 0.01 * gain * signal).sqrt() * torch.randn(6700, generator=generator)
    found = noiseflow.fit(model(), signal, observation, condition={"gain": gain}, generator=generator).noise_model
    for between in (1.4, 2.8, 5.6):
        law = torch.distributions.Normal(signal, (4e-4 + 0.01 * between * signal).sqrt())
        value = signal + law.scale * torch.randn(signal.shape, generator=generator)
        lost = law.log_prob(value) - found(signal, condition={"gain": between}).log_prob(value)
        assert float(lost.mean()) < 0.02  # 0.06 where the weights of networks had moved apart
    assert found.model.pull is None
