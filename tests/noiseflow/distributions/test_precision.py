"""Likelihoods and probabilities in single precision, at the extremes; derivatives in every mode; compilation."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import noiseflow
from noiseflow import NoiseModelBase


@settings(deadline=None, max_examples=50)
@given(rate=st.floats(0.01, 16e6), place=st.floats(-6, 6))
def test_poisson_in_single_precision_is_exact_at_any_dose(rate: float, place: float) -> None:
    signal = torch.tensor(rate)
    value = torch.round(signal + place * signal.sqrt()).clamp(min=0)
    expected = stats.poisson.logpmf(float(value), float(signal))
    for noise in (noiseflow.Poisson(), noiseflow.Digitised(noiseflow.Poisson())):
        assert float(noise(signal).log_prob(value)) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    found = float(noiseflow.Poisson()(signal).cdf(value))
    assert found == pytest.approx(stats.poisson.cdf(float(value), float(signal)), rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("gain", [0.37, 2.0, 13.0])
def test_draws_of_strong_signals_are_on_the_grid(gain: float) -> None:
    distribution = noiseflow.Poisson(gain=gain)(torch.full((1000,), 1e5 * gain))
    drawn = distribution.sample(generator=torch.Generator().manual_seed(0))
    jump = distribution.cdf(drawn) - distribution.cdf_below(drawn)
    assert torch.allclose(jump.log(), distribution.log_prob(drawn) + math.log(gain), atol=2e-2)


@settings(deadline=None, max_examples=40)
@given(z=st.floats(-12.5, 12.5), scale=st.floats(1e-3, 1e3))
def test_cdf_in_single_precision_is_exact_in_the_lower_tail(z: float, scale: float) -> None:
    noise = noiseflow.Gaussian(scale)
    value = torch.tensor(z * scale)
    exact = stats.norm.cdf(float(value) / float(noise.log_scale.detach().double().exp()))
    distribution = noise(torch.tensor(0.0))
    found = distribution.cdf(value)
    assert float(found) == pytest.approx(exact, rel=1e-4)
    above = distribution.log_interval_prob(value, torch.tensor(math.inf))
    below = distribution.log_interval_prob(torch.tensor(-math.inf), -value)
    assert float(above) == pytest.approx(float(below), rel=1e-5, abs=1e-7)
    if 1e-30 < exact < 0.9:
        assert float(distribution.icdf(found)) == pytest.approx(float(value), rel=1e-4, abs=1e-4 * scale)


@pytest.mark.parametrize("model", [noiseflow.SplineFlow(), noiseflow.RadialFlow(), noiseflow.Mixture()])
def test_cdf_of_flows_agrees_with_double_precision_in_the_lower_tail(model: NoiseModelBase) -> None:
    signal, value = torch.tensor([0.3, 0.5]), torch.tensor([-0.3, -0.2])
    exact = model.double()(signal.double()).cdf(value.double())
    found = model.float()(signal).cdf(value)
    assert bool((found > 0).all())
    assert torch.allclose(found.double().log(), exact.log(), rtol=1e-4)


EMCCD = noiseflow.ExcessNoise(gain=10.0, offset=100.0, read_noise=0.1)


def test_excess_noise_takes_missing_and_empty_inputs_and_batches() -> None:
    nan = float("nan")
    found = EMCCD(torch.tensor([150.0, nan, 150.0])).log_prob(torch.tensor([150.0, 150.0, nan]))
    assert torch.isfinite(found).tolist() == [True, False, False]
    none = EMCCD(torch.empty(0))
    for each in (none.log_prob(torch.empty(0)), none.cdf(torch.empty(0)), none.sample(), none.mean):
        assert each.shape == (0,)
    signal, value = torch.tensor([200.0, 300.0]), torch.tensor([210.0, 260.0])
    mapped = torch.func.vmap(lambda s, o: EMCCD(s).log_prob(o))(signal, value)
    assert torch.allclose(mapped, EMCCD(signal).log_prob(value), atol=1e-4)


def test_excess_noise_pulls_signals_below_the_offset_back() -> None:
    signal = torch.tensor([50.0], requires_grad=True)
    EMCCD(signal).log_prob(torch.tensor([60.0])).sum().backward()
    assert float(signal.grad[0]) == pytest.approx(10.0)


def test_excess_noise_is_twice_differentiable() -> None:
    signal = torch.tensor([150.0, 300.0, 500.0], dtype=torch.float64, requires_grad=True)
    value = torch.tensor([160.0, 310.0, 450.0], dtype=torch.float64)

    def log_prob(s: torch.Tensor) -> torch.Tensor:
        return EMCCD(s).log_prob(value)

    assert torch.autograd.gradcheck(log_prob, signal, rtol=1e-3, atol=1e-7)
    assert torch.autograd.gradgradcheck(log_prob, signal, rtol=1e-3, atol=1e-5)


@settings(deadline=None, max_examples=10)
@given(
    rate=st.floats(0.0, 300.0),
    read_noise=st.floats(0.05, 2.0),
    excess_factor=st.floats(1.1, 2.5),
)
def test_excess_noise_integrates_to_one(rate: float, read_noise: float, excess_factor: float) -> None:
    noise = noiseflow.ExcessNoise(1.0, 0.0, read_noise, excess_factor=excess_factor)
    spread = math.sqrt(excess_factor * rate + read_noise**2) + excess_factor
    value = torch.arange(rate - 15 * spread, rate + 40 * spread, read_noise / 8, dtype=torch.float64)
    with torch.no_grad():
        density = (
            noise(torch.tensor([rate, 320.0], dtype=torch.float64)[:, None]).log_prob(value.expand(2, -1))[0].exp()
        )
    assert float(torch.trapezoid(density, value)) == pytest.approx(1, abs=2e-4)


@pytest.mark.parametrize("model", [noiseflow.DeadTimeCounter(), noiseflow.Poisson()])
def test_counters_have_derivatives_in_both_modes(model: NoiseModelBase) -> None:
    signal, value = (torch.tensor(each, dtype=torch.float64) for each in ([11.0, 20.0], [10.0, 20.0]))
    for name in ("log_prob", "cdf"):

        def ask(s: torch.Tensor, name: str = name) -> torch.Tensor:
            found: torch.Tensor = getattr(model(s), name)(value)
            return found

        forward, reverse = torch.func.jacfwd(ask)(signal), torch.func.jacrev(ask)(signal)
        assert torch.allclose(forward, reverse, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        noiseflow.PoissonGaussian(),
        noiseflow.PhysicsFlow(),
        noiseflow.ExcessNoise(),
        noiseflow.Digitised(noiseflow.PoissonGaussian(), 0.01),
        noiseflow.Digitised(noiseflow.SplineFlow(), 0.01),
    ],
    ids=repr,
)
def test_physical_models_compile_without_graph_breaks(model: NoiseModelBase) -> None:
    signal = torch.tensor([0.5, 0.6, 0.7], requires_grad=True)
    observation = torch.tensor([0.51, 0.58, 0.9])

    def loss(s: torch.Tensor) -> torch.Tensor:
        return model(s).log_prob(observation).sum()  # type: ignore[no-any-return]

    torch._dynamo.reset()
    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)(signal)
    assert torch.allclose(compiled, loss(signal), atol=1e-4)
    found, expected = (torch.autograd.grad(each, signal)[0] for each in (compiled, loss(signal)))
    assert torch.allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("rate", [1e8, 1e10, 1e16, 1e20])
def test_draws_of_many_electrons_scatter_like_theirs(rate: float) -> None:
    signal = torch.full((20_000,), rate, dtype=torch.float64)
    for model in (noiseflow.Poisson(), noiseflow.PoissonGaussian(1.0, 0.0, 2.0)):
        latent = (model(signal).sample(generator=torch.Generator().manual_seed(0)) - rate) / rate**0.5
        assert abs(float(latent.mean())) < 0.03
        assert float(latent.std()) == pytest.approx(1, abs=0.02)  # 1.19 at 1e16 with torch's draws


@pytest.mark.parametrize("make", [noiseflow.Poisson, noiseflow.PoissonGaussian, noiseflow.ExcessNoise])
def test_draws_can_be_vectorised_and_compiled(make) -> None:
    noise, signal = make(), torch.linspace(1, 50, 6)
    draw = torch.func.vmap(lambda s: noise(s).sample(), randomness="different")
    compiled = torch.compile(lambda s: noise(s).sample(), fullgraph=True, backend="eager")
    for found in (draw(signal), compiled(signal)):
        assert found.shape == signal.shape
        assert bool(found.isfinite().all())
