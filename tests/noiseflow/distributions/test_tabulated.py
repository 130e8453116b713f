"""Tables stand in for the exact likelihood and sampler of large inputs, within their stated error."""

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import metrics
from noiseflow.distributions import tabulated
from noiseflow.fitting import observation_table
from noiseflow.fitting.observation_table import ObservationTable

MODELS = {
    "radial": lambda: noiseflow.RadialFlow(),
    "spline": lambda: noiseflow.SplineFlow(mean_preserving=True),
    "8-bit": lambda: noiseflow.Digitised(noiseflow.SplineFlow(), step=1 / 255, low=0.0, high=1.0),
    "clipped": lambda: noiseflow.Digitised(noiseflow.RadialFlow(), step=0.0, low=0.0, high=1.0),
    "mixture of one shape": lambda: noiseflow.Mixture(shared_shape=True),
    "mixture": lambda: noiseflow.Mixture(),
}


def fitted(name: str) -> tuple[torch.nn.Module, torch.Tensor, torch.Tensor]:
    """A model fitted to skewed noise, and pixels enough to be tabulated."""
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(tabulated.LARGE, generator=generator)
    gamma = -torch.log(torch.rand((4, *signal.shape), generator=generator)).sum(0)
    observation = signal + (0.03 + 0.05 * signal) * (gamma - 4) / 2
    model = MODELS[name]()
    if isinstance(model, noiseflow.Digitised):
        observation = (observation * 255).round() / 255 if model.step else observation
        observation = observation.clamp(0, 1)
    noiseflow.fit(model, signal, observation, num_steps=60)
    return model, signal, observation


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_of_large_inputs(name: str) -> None:
    model, signal, observation = fitted(name)
    with torch.no_grad():
        table = tabulated.log_prob(model, signal, observation)
        exact = torch.cat(
            [model(s).log_prob(o) for s, o in zip(signal.split(50_000), observation.split(50_000), strict=True)]
        )
        automatic = model(signal).log_prob(observation)
    assert table is not None
    assert torch.equal(automatic, table)
    assert float((table - exact).abs().mean()) < 1e-3
    assert abs(float((table - exact).mean())) < 5e-4


@pytest.mark.parametrize("name", ["radial", "spline", "mixture"])
def test_samples_of_large_inputs_follow_the_model(name: str) -> None:
    model, signal, _ = fitted(name)
    drawn = model(signal).sample(generator=torch.Generator().manual_seed(1))
    again = model(signal).sample(generator=torch.Generator().manual_seed(1))
    assert torch.equal(drawn, again)
    u = metrics.probability_integral_transform(model, signal, drawn, np.random.default_rng(0))
    assert metrics.kolmogorov_smirnov(u) < 2 / np.sqrt(u.size)
    latent = torch.randn(signal.shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        exact = model(signal).from_latent(latent)
    assert float(((drawn - exact).abs() / 0.05).mean()) < 1e-3


def test_table_follows_the_parameters() -> None:
    model, signal, observation = fitted("radial")
    with torch.no_grad():
        before = model(signal).log_prob(observation).mean()
        model.bias[1] += 0.5
        after = model(signal).log_prob(observation).mean()
        assert float(after) < float(before) - 0.05


def test_gradients_are_exact_not_tabulated() -> None:
    model, signal, observation = fitted("radial")
    assert model(signal).log_prob(observation).requires_grad


class ShotNoise(torch.nn.Module):
    """Normal noise whose variance is the signal, and 4 besides."""

    def forward(self, signal: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(signal, (signal.clamp_min(0) + 4).sqrt())


def test_weak_signals_are_resolved_beside_strong_ones() -> None:
    """Noise of 2 at no signal and of 190 at the brightest, 36 000: steps that serve the one would miss the other."""
    generator = torch.Generator().manual_seed(0)
    signal = 36_000 * torch.rand(50_000, generator=generator) ** 4
    observation = signal + (signal + 4).sqrt() * torch.randn(signal.shape, generator=generator)
    table = ObservationTable(ShotNoise(), observation, 0.0, 36_000.0, tolerance=2e-3)
    assert table.error <= 2e-3
    near = (signal + (signal + 4).sqrt()).requires_grad_()
    exact = ShotNoise()(near).log_prob(observation)
    found = table.log_prob(near)
    assert float((found - exact.detach()).abs().mean()) < 5e-3
    (slope,) = torch.autograd.grad(exact.sum(), near)
    assert float((table.slope(near) - slope).abs().mean()) < 0.02 * float(slope.abs().mean())


def test_slopes_looked_up_in_pieces_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    signal = torch.rand(10_000, generator=torch.Generator().manual_seed(0))
    observation = signal + 0.1 * torch.randn(signal.shape, generator=torch.Generator().manual_seed(1))
    table = ObservationTable(noiseflow.Gaussian(0.1), observation, 0.0, 1.0)
    whole = table.slope(signal)
    monkeypatch.setattr(observation_table, "_CHUNK", 999)
    assert torch.equal(table.slope(signal), whole)


def test_scale_and_its_inverse_agree_beyond_the_range_too() -> None:
    scale = tabulated.RootScale(-3.0, 50.0, 0.01)
    readings = torch.linspace(-20, 90, 500, dtype=torch.float64)
    assert torch.allclose(scale.inverse(scale.observation(readings)), readings, atol=1e-9)
    assert bool((scale.observation(readings).diff() > 0).all())


def test_the_finest_size_is_not_tabulated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    built = []
    build = ObservationTable._build
    monkeypatch.setattr(ObservationTable, "_build", lambda self, *args: built.append(args[1:3]) or build(self, *args))
    observation = torch.randn(5000, generator=torch.Generator().manual_seed(0))
    ObservationTable(noiseflow.SignalDependentGaussian(), observation, -2.0, 2.0, tolerance=0.0)
    assert len(built) == len(set(built)) > 1
