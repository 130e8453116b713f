"""Detection of rounding and rails, choice of models, divergence from a known truth, and residual structure."""

import math

import pytest
import torch

import noiseflow
from noiseflow import metrics
from noiseflow.fitting.selection import select
from noiseflow.metrics.spatial import spatial_structure


def noisy(seed: int = 0, count: int = 60_000) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    signal = torch.rand(count, generator=generator)
    return signal, signal + 0.1 * torch.randn(count, generator=generator)


def test_simplest_sufficient_model_is_chosen() -> None:
    signal, observation = noisy(count=20_000)
    found = select(signal, observation, num_steps=50)
    assert found.chosen.name == "Gaussian"
    assert found.digitisation == (0.0, -math.inf, math.inf)
    few = {"Gaussian": noiseflow.Gaussian(), "SplineFlow": noiseflow.SplineFlow()}
    clipped = select(signal, observation.clamp(0, 1), candidates=few, num_steps=30)
    assert isinstance(clipped.chosen.model, noiseflow.Digitised)


def test_resolved_electrons_choose_the_physical_model() -> None:
    truth = noiseflow.PoissonGaussian(2.0, 100.0, 0.2)
    signal = 100 + 12 * torch.rand(20_000, generator=torch.Generator().manual_seed(0))
    found = select(signal, truth(signal).sample(generator=torch.Generator().manual_seed(1)), num_steps=50)
    assert found.chosen.name == "PoissonGaussian"
    assert {candidate.name for candidate in found.candidates if candidate.screened_out} >= {"Gaussian", "SplineFlow"}
    assert metrics.kl_divergence(truth, found.chosen.model, signal)[0] < 0.005


def test_flow_is_chosen_for_skewed_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(20_000, generator=generator)
    gamma = -torch.log(torch.rand((2, *signal.shape), generator=generator)).sum(0)
    found = select(signal, signal + 0.1 * (gamma - 2), num_steps=100)
    assert "Flow" in found.chosen.name
    by_name = {candidate.name: candidate for candidate in found.candidates}
    assert by_name["Gaussian"].excess > 0.05


def test_kl_divergence_of_gaussians_is_the_formula() -> None:
    signal = torch.rand(400_000, generator=torch.Generator().manual_seed(0))
    found, error = metrics.kl_divergence(noiseflow.Gaussian(0.1), noiseflow.Gaussian(0.12), signal)
    exact = math.log(1.2) + 1 / (2 * 1.44) - 0.5
    assert found == pytest.approx(exact, abs=4 * error)
    assert metrics.kl_divergence(noiseflow.Gaussian(0.1), noiseflow.Gaussian(0.1), signal)[0] == 0


@pytest.mark.parametrize("kind", ["none", "rows", "neighbours"])
def test_spatial_structure_is_seen(kind: str) -> None:
    generator = torch.Generator().manual_seed(0)
    signal, noise = torch.rand((200, 300), generator=generator), torch.randn((200, 300), generator=generator)
    if kind == "rows":
        noise = noise + 0.3 * torch.randn((200, 1), generator=generator)
    elif kind == "neighbours":
        noise = noise + 0.2 * torch.roll(noise, 1, dims=1)
    found = spatial_structure(noiseflow.Gaussian(float(noise.std()) * 0.1), signal, signal + 0.1 * noise)
    assert found.suffices == (kind == "none")
    if kind == "rows":
        assert found.rows == pytest.approx(1 + 0.09 * 300, rel=0.3)
    elif kind == "neighbours":
        assert found.horizontal == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [
        ("rows", "ScanNoise(model) adds"),
        ("columns", 'along="column"'),
        ("pattern", "WithMaps"),
        ("neighbours", "no term"),
    ],
)
def test_the_term_that_would_help_is_named(kind: str, remedy: str) -> None:
    generator = torch.Generator().manual_seed(0)
    signal, noise = torch.rand((3, 80, 100), generator=generator), torch.randn((3, 80, 100), generator=generator)
    if kind == "neighbours":
        noise = noise + 0.3 * torch.roll(noise, 1, dims=2)
    else:
        shape = {"rows": (3, 80, 1), "columns": (3, 1, 100), "pattern": (80, 100)}[kind]
        noise = noise + 0.3 * torch.randn(shape, generator=generator)
    observation = signal + 0.1 * noise
    found = spatial_structure(noiseflow.Gaussian(0.1 * float(noise.std())), signal, observation)
    assert len(found.remedies) == 1
    assert remedy in found.remedies[0]
    assert remedy in found.in_words()
    if kind == "rows":
        assert spatial_structure(noiseflow.ScanNoise(noiseflow.Gaussian(0.1), 0.03), signal, observation).suffices
