"""Exports: the mixture file holds what was fitted, CAREamics and deepinv take it as their own."""

from __future__ import annotations

import math
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import interop


def detector() -> noiseflow.SplineFlow:
    """A flow fitted to skewed, signal-dependent noise on signals of 100 to 300 counts."""
    generator = torch.Generator().manual_seed(0)
    signal = 100 + 200 * torch.rand(20_000, generator=generator)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        noise = torch.distributions.Gamma(4.0, 2.0).sample(signal.shape) - 2
    model = noiseflow.SplineFlow(mean_preserving=True)
    noiseflow.fit(model, signal, signal + 0.7 * torch.sqrt(signal) * noise, num_steps=150)
    return model


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[noiseflow.SplineFlow, Path, float]:
    model, path = detector(), tmp_path_factory.mktemp("gmm") / "detector.npz"
    return model, path, interop.to_pn2v_gmm(model, path, num_steps=300)


def mixture_density(arrays: Any, signal: np.ndarray, observation: np.ndarray) -> np.ndarray:
    """p(observation | signal) of the file, by the definition of PN2V."""
    means, log_variances, log_weights = np.split(arrays["trained_weight"].astype(float), 3)
    t = (signal - arrays["min_signal"]) / (arrays["max_signal"] - arrays["min_signal"])
    powers = t[:, None] ** np.arange(means.shape[1])
    mean, log_weight = powers @ means.T, powers @ log_weights.T
    variance = np.maximum(powers @ np.exp(log_variances).T, arrays["min_sigma"])
    weight = np.exp(log_weight) / np.exp(log_weight).sum(1, keepdims=True)
    mean = mean - (weight * mean).sum(1, keepdims=True) + signal[:, None]
    density = np.exp(-((observation[:, None] - mean) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    return (weight * density).sum(1)


def test_mixture_file_comes_close_to_the_model(exported: tuple[noiseflow.SplineFlow, Path, float]) -> None:
    model, path, divergence = exported
    arrays = np.load(path, allow_pickle=False)
    assert sorted(arrays) == ["max_signal", "min_sigma", "min_signal", "trained_weight"]
    assert arrays["trained_weight"].shape == (9, 4)
    assert (arrays["min_signal"], arrays["max_signal"]) == pytest.approx((100, 300), rel=1e-2)
    signal = torch.linspace(110, 290, 4000)
    with torch.no_grad():
        observation = model(signal).sample(generator=torch.Generator().manual_seed(3))
        own = model(signal).log_prob(observation).double().numpy()
    theirs = np.log(mixture_density(arrays, signal.numpy(), observation.numpy()))
    assert 0 <= divergence < 0.03
    assert float((own - theirs).mean()) == pytest.approx(divergence, abs=0.01)
    gaussian = -0.5 * np.log(2 * np.pi * np.e * 0.49 * signal.numpy())
    assert theirs.mean() > gaussian.mean() + 0.03


def test_careamics_reads_the_mixture(exported: tuple[noiseflow.SplineFlow, Path, float]) -> None:
    pytest.importorskip("careamics")
    from careamics.config.noise_model import GaussianMixtureNMConfig
    from careamics.models.lvae.noise_models import GaussianMixtureNoiseModel

    _, path, _ = exported
    theirs = GaussianMixtureNoiseModel(GaussianMixtureNMConfig(path=path))
    signal = torch.linspace(100, 300, 2000)
    observation = signal + 15 * torch.randn(signal.shape, generator=torch.Generator().manual_seed(0))
    shape = (1, 1, 40, 50)
    with torch.no_grad():
        found = theirs.likelihood(observation.reshape(shape), signal.reshape(shape)).reshape(-1).numpy()
    expected = mixture_density(np.load(path), signal.numpy(), observation.numpy())
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-8)


def test_rails_and_rounding_are_left_out(tmp_path: Path) -> None:
    inside = noiseflow.Gaussian(2.0)
    around = noiseflow.Digitised(inside, step=1.0, low=0.0, high=255.0)
    divergence = interop.to_pn2v_gmm(around, tmp_path / "a.npz", signal_range=(10, 200), num_gaussians=1, num_steps=100)
    assert divergence < 2e-3
    arrays = np.load(tmp_path / "a.npz")
    density = mixture_density(arrays, np.array([50.0, 150.0]), np.array([51.0, 148.0]))
    assert density == pytest.approx(np.exp([-1 / 8, -0.5]) / np.sqrt(8 * np.pi), rel=0.05)


def test_unknown_range_of_signals_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="signal_range"):
        interop.to_pn2v_gmm(noiseflow.Gaussian(), tmp_path / "a.npz")
    with pytest.raises(ValueError, match="below"):
        interop.to_pn2v_gmm(noiseflow.Gaussian(), tmp_path / "a.npz", signal_range=(2, 2))
    with pytest.raises(ValueError, match=r"\.npz"):
        interop.to_pn2v_gmm(noiseflow.Gaussian(), tmp_path / "a.pt", signal_range=(0, 1))
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("name", ["ScanNoise", "WithMaps", "neighbourhood", "PoissonGaussian"])
def test_every_model_is_written(name: str, tmp_path: Path) -> None:
    """The law of a single pixel comes near the model's: of its width, with the offsets of rows where there are some."""
    model, width = {
        "ScanNoise": (noiseflow.ScanNoise(noiseflow.Digitised(noiseflow.Gaussian(3.0)), 4.0), 5.0),
        "WithMaps": (noiseflow.WithMaps(noiseflow.Gaussian(3.0), np.full((5, 7), 1.5)), 3.0),
        "neighbourhood": (noiseflow.SignalDependentGaussian(neighbourhood=3), math.exp(-2.3)),
        "PoissonGaussian": (noiseflow.PoissonGaussian(0.5, 0.0, 1.0), math.sqrt(0.5 * 100 + 0.25)),
    }[name]
    options = {"num_gaussians": 1, "num_coefficients": 2, "num_steps": 150}
    divergence = interop.to_pn2v_gmm(model, tmp_path / "a.npz", signal_range=(95, 105), **options)
    assert abs(divergence) < 5e-3
    density = mixture_density(np.load(tmp_path / "a.npz"), np.array([100.0]), np.array([100.0]))
    assert density == pytest.approx(1 / (width * math.sqrt(2 * math.pi)), rel=0.03)


def test_missing_deepinv_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "noiseflow.interop.deepinv", raising=False)
    monkeypatch.setitem(sys.modules, "deepinv", None)
    monkeypatch.setitem(sys.modules, "deepinv.optim", None)
    for export in (interop.to_deepinv, interop.to_deepinv_fidelity):
        with pytest.raises(ImportError, match=r"\[deepinv\]"):
            export(noiseflow.Gaussian())


def test_deepinv_models_survive_pickling_and_give_the_likelihood() -> None:
    deepinv = pytest.importorskip("deepinv")
    model = noiseflow.SplineFlow()
    clean = torch.rand(3, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    noise = pickle.loads(pickle.dumps(interop.to_deepinv(model)))
    noisy = noise(clean, seed=1)
    fidelity = interop.to_deepinv_fidelity(model)
    assert isinstance(fidelity, deepinv.optim.DataFidelity)
    physics = deepinv.physics.Denoising(noise)
    expected = -model(clean).log_prob(noisy).sum((1, 2, 3))
    assert torch.allclose(fidelity(clean, noisy, physics), expected, rtol=1e-5)
    step = 1e-3 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(2)).double()
    fidelity, double, seen = fidelity.double(), clean.double(), noisy.double()
    slope = (fidelity.grad(double.clone(), seen, physics) * step).sum((1, 2, 3))
    change = (fidelity(double + step / 2, seen, physics) - fidelity(double - step / 2, seen, physics)).detach()
    assert torch.allclose(slope.detach(), change, rtol=1e-3)


def test_deepinv_puts_the_noise_on_its_images() -> None:
    deepinv = pytest.importorskip("deepinv")
    noise = interop.to_deepinv(noiseflow.Gaussian(0.1))
    physics = deepinv.physics.Denoising(noise)
    clean = torch.full((2, 1, 64, 64), 0.5)
    noisy = physics(clean, seed=1)
    assert noisy.shape == clean.shape
    assert torch.equal(noisy, physics(clean, seed=1))
    assert not torch.equal(noisy, physics(clean))
    assert float((noisy - clean).std()) == pytest.approx(0.1, rel=0.05)
