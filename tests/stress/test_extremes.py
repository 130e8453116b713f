"""Numerical stability: value and gradient stay finite, inverses consistent, likelihoods below their maximum, at every extreme."""

import math

import pytest
import torch

import noiseflow
from tests.noiseflow.test_noise_models import disturbed

MODELS = {
    "radial": lambda: noiseflow.RadialFlow(mean_preserving=True),
    "spline": lambda: noiseflow.SplineFlow(mean_preserving=True),
    "signal-dependent Gaussian": lambda: noiseflow.SignalDependentGaussian(),
    "Gaussian": lambda: noiseflow.Gaussian(),
    "Poisson": lambda: noiseflow.Poisson(),
    "8-bit radial": lambda: noiseflow.Digitised(noiseflow.RadialFlow(), step=1 / 255, low=0.0, high=1.0),
    "clipped spline": lambda: noiseflow.Digitised(
        noiseflow.SplineFlow(mean_preserving=True), step=0.0, low=0.0, high=1.0
    ),
}
DTYPES = [torch.float32, torch.float64]


def gradients_are_finite(model: torch.nn.Module, *inputs: torch.Tensor) -> bool:
    tensors = [*inputs, *(p for p in model.parameters() if p.requires_grad)]
    return all(tensor.grad is None or bool(torch.isfinite(tensor.grad).all()) for tensor in tensors)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("strength", [0.0, 3.0, 50.0])
def test_likelihood_and_gradients_are_finite_everywhere(name: str, dtype: torch.dtype, strength: float) -> None:
    if name in ("Gaussian", "Poisson") and strength:
        pytest.skip("one scale and one gain have no extremes of shape")
    model = disturbed(MODELS[name](), strength).to(dtype)
    values = [-1e12, -1e6, -1.0, -1e-12, 0.0, 1e-12, 0.1, 0.5, 1.0, 2.0, 1e6, 1e12]
    signal = torch.tensor(values, dtype=dtype).repeat_interleave(len(values)).requires_grad_()
    observation = torch.tensor(values, dtype=dtype).repeat(len(values)).requires_grad_()
    log_prob = model(signal).log_prob(observation)
    possible = torch.isfinite(log_prob)
    assert not bool(torch.isnan(log_prob).any())
    assert not bool(torch.isposinf(log_prob).any())
    if name != "Poisson":  # shot noise alone makes readings below its offset impossible
        assert bool(possible.all())
    log_prob[possible].clamp(min=-1e30).sum().backward()
    assert gradients_are_finite(model, signal, observation)


@pytest.mark.parametrize("name", ["radial", "spline", "signal-dependent Gaussian"])
@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6, 1e12])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_fits_do_not_depend_on_scale_and_offset(name: str, scale: float, offset: float) -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(4000, generator=generator, dtype=torch.float64)
    observation = signal + 0.1 * torch.randn(4000, generator=generator, dtype=torch.float64)
    model = MODELS[name]().double()
    result = noiseflow.fit(model, (signal + offset) * scale, (observation + offset) * scale, num_steps=30)
    assert result.recoveries == 0
    assert result.held_out_nll - math.log(scale) == pytest.approx(-0.88, abs=0.25)


@pytest.mark.parametrize("name", ["radial", "spline"])
def test_bfloat16_autocast_changes_nothing(name: str) -> None:
    model = disturbed(MODELS[name](), 0.3).float()
    signal, observation = torch.linspace(0, 1, 100), torch.linspace(-0.5, 1.5, 100)
    exact = model(signal).log_prob(observation)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = model(signal).log_prob(observation)
    assert torch.allclose(found, exact, rtol=1e-5, atol=1e-5)


def test_observations_exactly_at_knots_and_centres() -> None:
    spline = disturbed(noiseflow.SplineFlow(), 0.3)
    signal = torch.zeros(17, dtype=torch.float64)
    distribution = spline(signal)
    _, _, transforms = spline.parameters_at(signal)
    standard = transforms[0].inverse(transforms[1].x[0])[0]
    observation = distribution._parameters[0] + torch.exp(distribution._parameters[1]) * standard
    observation = observation.detach().requires_grad_()
    log_prob = spline(signal).log_prob(observation)
    log_prob.sum().backward()
    assert bool(torch.isfinite(log_prob).all())
    assert gradients_are_finite(spline, observation)
    radial = noiseflow.RadialFlow().double()
    at_centre = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    radial(torch.zeros(1, dtype=torch.float64)).log_prob(at_centre).sum().backward()
    assert gradients_are_finite(radial, at_centre)


@pytest.mark.parametrize("name", MODELS)
def test_empty_and_single_pixels(name: str) -> None:
    model = MODELS[name]()
    assert model(torch.zeros(0)).log_prob(torch.zeros(0)).shape == (0,)
    assert model(torch.zeros(0)).sample().shape == (0,)
    assert model(torch.tensor(0.5)).sample().shape == ()
    assert model(torch.tensor(0.5)).log_prob(torch.tensor(1.0)).shape == ()


def test_poisson_at_rate_zero() -> None:
    model = noiseflow.Poisson()
    signal = torch.tensor([0.0, -3.0], requires_grad=True)
    assert torch.equal(model(signal).sample(), torch.zeros(2))
    log_prob = model(signal).log_prob(torch.zeros(2))
    assert torch.equal(log_prob.detach(), torch.zeros(2))
    log_prob.sum().backward()
    assert bool(torch.isfinite(signal.grad).all())
    assert torch.isneginf(model(signal).log_prob(torch.ones(2))).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["radial", "spline"])
def test_likelihood_stays_below_its_bound(name: str, dtype: torch.dtype) -> None:
    """The density cannot exceed the product of the steepest slopes of the layers times the normal one at zero."""
    model = disturbed(MODELS[name](), 3.0).to(dtype)
    signal = torch.full((100_001,), 0.4, dtype=dtype)
    observation = torch.linspace(-5, 5, 100_001, dtype=dtype)
    reference = disturbed(MODELS[name](), 3.0).double()
    found = model(signal).log_prob(observation).double()
    exact = reference(signal.double()).log_prob(observation.double())
    tolerance = 1e-9 if dtype == torch.float64 else 2e-2
    assert float(found.max()) <= float(exact.max()) + tolerance


@pytest.mark.slow
def test_hundred_million_pixels() -> None:
    model = noiseflow.SplineFlow(mean_preserving=True)
    signal = torch.rand(10**8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        drawn = model(signal).sample(generator=torch.Generator().manual_seed(1))
        total = model(signal).log_prob(drawn).double().mean()
    assert float(total) == pytest.approx(-0.5 * math.log(2 * math.pi * math.e) + 2.3, abs=0.01)
