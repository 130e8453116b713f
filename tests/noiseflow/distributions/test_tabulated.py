"""Tables stand in for the exact likelihood and sampler of large inputs, within their stated error."""

import copy
import gc
import weakref
from functools import cache

import numpy as np
import pytest
import torch

import noiseflow
from noiseflow import metrics
from noiseflow.distributions.numerics import tables
from noiseflow.fitting import observation_table
from noiseflow.fitting.observation_table import ObservationTable
from noiseflow.models import physics_flow

MODELS = {
    "radial": lambda: noiseflow.RadialFlow(),
    "spline": lambda: noiseflow.SplineFlow(mean_preserving=True),
    "8-bit": lambda: noiseflow.Digitised(noiseflow.SplineFlow(), step=1 / 255, low=0.0, high=1.0),
    "clipped": lambda: noiseflow.Digitised(noiseflow.RadialFlow(), step=0.0, low=0.0, high=1.0),
    "mixture of one shape": lambda: noiseflow.Mixture(shared_shape=True),
    "mixture": lambda: noiseflow.Mixture(),
}


def fitted(name: str) -> tuple[torch.nn.Module, torch.Tensor, torch.Tensor]:
    """A model fitted to skewed noise, without a table yet, and pixels enough to be tabulated."""
    model, signal, observation = _fitted(name)
    return copy.deepcopy(model), signal, observation


@cache
def _fitted(name: str) -> tuple[torch.nn.Module, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(tables.LARGE, generator=generator)
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
        table = tables.log_prob(model, signal, observation)
        exact = torch.cat(
            [model(s).log_prob(o) for s, o in zip(signal.split(50_000), observation.split(50_000), strict=True)]
        )
        found = model(signal).log_prob(observation)
    assert table is not None
    assert torch.equal(found, table)
    assert float((table - exact).abs().max()) < tables.TOLERANCE
    assert abs(float((table - exact).mean())) < 5e-4


def test_kinks_that_curvature_hides_are_seen_in_tables() -> None:
    """Beyond the range of the fit, rows are wide beside the distances of the learnt scales."""
    generator = torch.Generator().manual_seed(0)
    signal = 0.2 + 0.8 * torch.rand(50_000, generator=generator)
    observation = signal + (0.02 + 0.1 * signal) * torch.randn(50_000, generator=generator)
    model = noiseflow.fit(noiseflow.SignalDependentGaussian(), signal, observation, generator=generator).noise_model
    wide = 1.2 * torch.rand(400_000, generator=generator)
    with torch.no_grad():
        value = model(wide).sample(generator=generator)
        exact = [model(s).log_prob(o) for s, o in zip(wide.split(50_000), value.split(50_000), strict=True)]
        assert (
            float((model(wide).log_prob(value) - torch.cat(exact)).abs().max()) < tables.TOLERANCE
        )  # 1.4 times as much


def test_slow_moments_of_many_pixels_come_from_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    generator, sizes = torch.Generator().manual_seed(0), list[int]()
    signal = 100 + 60 * torch.rand(4000, generator=generator)
    observation = noiseflow.PoissonGaussian(2.0, 95.0, 1.0)(signal).sample(generator=generator)
    model = noiseflow.fit(noiseflow.PhysicsFlow(), signal, observation, num_steps=20).noise_model
    exact = model(signal[:100]).mean, model(signal[:100]).stddev
    nodes = physics_flow.latent_nodes
    monkeypatch.setattr(physics_flow, "latent_nodes", lambda base: (sizes.append(base.rate.numel()), nodes(base))[1])
    law = model(signal)
    for found, one, unit in ((law.mean, exact[0], exact[1]), (law.stddev, exact[1], exact[1])):
        assert float(((found[:100] - one) / unit).abs().max()) < tables.TOLERANCE
    assert sum(sizes) < 1000


@pytest.mark.parametrize("name", ["radial", "spline"])
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


@pytest.mark.parametrize("how", ["data", "in place", "copied", "inference"])
def test_table_follows_the_parameters(how: str) -> None:
    """However they change: ``.data`` raises no version, and copies made for inference have none."""
    model, signal, observation = fitted("radial")
    with torch.no_grad():
        before = float(model(signal).log_prob(observation).mean())
    if how == "inference":
        with torch.inference_mode():
            model = copy.deepcopy(model)
            model.bias += 0
    elif how == "copied":
        model = copy.deepcopy(model)
    with torch.inference_mode(how == "inference"), torch.no_grad():
        change = torch.zeros_like(model.bias)
        change[1] = 0.5
        if how == "data":
            model.bias.data.add_(change)
        else:
            model.bias += change
        after = model(signal).log_prob(observation)
        exact = torch.cat(
            [model(s).log_prob(o) for s, o in zip(signal.split(9999), observation.split(9999), strict=True)]
        )
    assert float(after.mean()) < before - 0.05
    assert float((after - exact).abs().max()) < 1.5e-3


@pytest.mark.slow
def test_number_types_have_tables_of_their_own() -> None:
    model, signal, observation = fitted("spline")
    with torch.no_grad():
        single = model(signal).log_prob(observation)
        double = model(signal.double()).log_prob(observation.double())
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    assert float((single - double).abs().max()) < 3e-3


def test_far_outliers_are_exact() -> None:
    model, signal, observation = fitted("radial")
    far = observation.clone()
    far[:4] = torch.tensor([1000.0, 1e6, -1e6, 30.0])
    with torch.no_grad():
        found, exact = model(signal).log_prob(far)[:4], model(signal[:4]).log_prob(far[:4])
    assert torch.equal(found, exact)


def test_a_wider_table_replaces_one_whose_range_signals_leave() -> None:
    model, signal, observation = fitted("spline")
    with torch.no_grad():
        model(signal).log_prob(observation)
        (table,) = tables._tables[model].values()
        wider = 1.1 * signal - 0.03
        moved = wider + (observation - signal)
        found = model(wider).log_prob(moved)
        exact = torch.cat([model(s).log_prob(o) for s, o in zip(wider.split(9999), moved.split(9999), strict=True)])
        (other,) = tables._tables[model].values()
        model(signal).log_prob(observation)
    (same,) = tables._tables[model].values()
    assert same is other is not table
    assert (other.scale.low, other.scale.high) == (float(wider.min()), float(wider.max()))
    assert float((found - exact).abs().max()) < 1.5e-3


def test_a_model_is_not_kept_alive_by_its_tables() -> None:
    model, signal, observation = fitted("spline")
    with torch.no_grad():
        model(signal).log_prob(observation)
    gone = weakref.ref(model)
    del model
    gc.collect()
    assert gone() is None


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
    monkeypatch.setattr(observation_table, "LONG", 999)
    assert torch.equal(table.slope(signal), whole)


def test_scale_and_its_inverse_agree_beyond_the_range_too() -> None:
    scale = tables.RootScale(-3.0, 50.0, 0.01)
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


@pytest.mark.parametrize("name", ["spline", "8-bit"])
@pytest.mark.parametrize("kinds", [("float32", "float64"), ("bfloat16", "float32"), ("float16", "float16")])
def test_tables_take_signals_and_observations_of_different_number_types(name: str, kinds: tuple[str, str]) -> None:
    model = noiseflow.SplineFlow()
    model = noiseflow.Digitised(model, 1 / 255, 0.0, 1.0) if name == "8-bit" else model
    given = torch.rand(tables.LARGE + 1, generator=torch.Generator().manual_seed(0))
    signal, observation = (each.to(getattr(torch, kind)) for each, kind in zip((given, given), kinds, strict=True))
    with torch.no_grad():
        found = model(signal).log_prob(observation)
        exact = model(signal[:1000]).log_prob(observation[:1000])
    assert found.dtype == exact.dtype == torch.promote_types(signal.dtype, observation.dtype)
    rounding = torch.finfo(found.dtype).eps * float(exact.abs().max())
    assert torch.allclose(found[:1000], exact, rtol=0, atol=2e-3 + rounding)
