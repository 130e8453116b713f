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
MODELS |= {
    "Poisson-Gaussian": lambda: noiseflow.PoissonGaussian(),
    "resolved electrons": lambda: noiseflow.PoissonGaussian(gain=0.2, read_noise=0.2),
    "mixture of one shape": lambda: noiseflow.Mixture(shared_shape=True, mean_preserving=True),
    "mixture": lambda: noiseflow.Mixture(mean_preserving=True),
    "physics and flow": lambda: noiseflow.PhysicsFlow(),
    "8-bit mixture": lambda: noiseflow.Digitised(noiseflow.Mixture(), step=1 / 255, low=0.0, high=1.0),
    "8-bit physics": lambda: noiseflow.Digitised(noiseflow.PhysicsFlow(), step=1 / 255, low=0.0, high=1.0),
    "clipped physics": lambda: noiseflow.Digitised(noiseflow.PhysicsFlow(), low=0.0, high=1.0),
}
SEEN = [-1e6, -1.0, -1e-12, 0.0, 1e-12, 0.5, 1.0, 2.0, 1e6]
IMAGE_MODELS = {
    "maps": lambda: noiseflow.WithMaps(
        noiseflow.SplineFlow(), torch.logspace(-2, 2, 81).reshape(9, 9), torch.linspace(-1e3, 1e3, 81).reshape(9, 9)
    ),
    "rows": lambda: noiseflow.ScanNoise(noiseflow.Gaussian()),
    "columns, mixture": lambda: noiseflow.ScanNoise(noiseflow.Mixture(), along="column"),
    "neighbourhood": lambda: noiseflow.SplineFlow(neighbourhood=3),
}
DTYPES = [torch.float32, torch.float64]


def within_limits(model: torch.nn.Module, observation: torch.Tensor) -> torch.Tensor:
    """Which observations a model's clipping limits leave possible: those beyond a limit by at most half a step."""
    low, high, step = (
        getattr(model, name, end) for name, end in (("low", -math.inf), ("high", math.inf), ("step", 0.0))
    )
    return (observation >= low - step / 2) & (observation <= high + step / 2)


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
    if name != "Poisson":  # shot noise alone makes pixel values below its offset impossible
        assert torch.equal(possible, within_limits(model, observation))
    log_prob[possible].clamp(min=-1e30).sum().backward()
    assert gradients_are_finite(model, signal, observation)


@pytest.mark.parametrize("name", IMAGE_MODELS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("strength", [0.0, 50.0])
def test_images_of_extremes_have_finite_likelihoods(name: str, dtype: torch.dtype, strength: float) -> None:
    model = IMAGE_MODELS[name]()
    if name not in ("rows", "columns, mixture"):
        model = disturbed(model, strength)
    model = model.to(dtype)
    levels = torch.tensor(SEEN, dtype=dtype)
    signal, observation = (
        each.contiguous().requires_grad_() for each in torch.meshgrid(levels, levels.flip(0), indexing="ij")
    )
    log_prob = model(signal).log_prob(observation)
    assert bool(torch.isfinite(log_prob).all())
    log_prob.clamp(min=-1e30).sum().backward()
    assert gradients_are_finite(model, signal, observation)


@pytest.mark.parametrize("name", [name for name in MODELS if name != "Poisson"])
def test_float32_agrees_with_float64(name: str) -> None:
    """Relative to the likelihood's size: a reading many deviations away has few digits of its own."""
    strength = 0.0 if "aussian" in name or name == "resolved electrons" else 0.3
    exact, single = (disturbed(MODELS[name](), strength).to(dtype) for dtype in (torch.float64, torch.float32))
    signal = torch.linspace(0, 1, 41).repeat_interleave(81)
    observation = torch.linspace(-0.5, 1.5, 81).repeat(41)
    with torch.no_grad():
        expected = exact(signal.double()).log_prob(observation.double())
        found = single(signal).log_prob(observation).double()
    possible = within_limits(exact, observation)
    assert torch.equal(torch.isfinite(expected), possible)
    assert torch.equal(torch.isfinite(found), possible)
    error = float(((found - expected).abs() / (1 + expected.abs()))[possible].max())
    print(f"worst error of float32, {name}: {error:.1e}")
    assert error < 3e-4


def test_worst_errors_against_many_digits() -> None:
    import mpmath

    worst = {"transform": 0.0, "Poisson-Gaussian": 0.0}
    model = noiseflow.PoissonGaussian(1.0, 0.0, 0.7).double()
    for rate in (0.01, 0.8, 20.0):
        for reading in (-4.0, 0.3, 1.0, 17.0, 60.0):
            with mpmath.workdps(40):
                mass = [mpmath.exp(-rate + k * mpmath.log(rate) - mpmath.loggamma(k + 1)) for k in range(200)]
                density = mpmath.fsum(m * mpmath.npdf(reading, k, mpmath.mpf(0.7)) for k, m in enumerate(mass))
                expected = float(mpmath.log(density))
            with torch.no_grad():
                found = model(torch.tensor([rate], dtype=torch.float64)).log_prob(
                    torch.tensor([reading], dtype=torch.float64)
                )
            worst["Poisson-Gaussian"] = max(worst["Poisson-Gaussian"], abs(float(found) - expected))
    spread = torch.tensor([1e-12, 1e-3, 1.0, 1e4, 1e9], dtype=torch.float64)
    flow = disturbed(noiseflow.RadialFlow(), 0.5)
    _, _, transforms = flow.parameters_at(torch.full((5,), 0.4, dtype=torch.float64))
    for radial in (each for each in transforms if hasattr(each, "log_width")):
        with torch.no_grad():
            found, _ = radial.forward(spread)
        for i, x in enumerate(spread.tolist()):
            with mpmath.workdps(50):
                exact = mpmath.mpf(x)
                parts = [
                    each.detach().expand(5, each.shape[-1])[i]
                    for each in (radial.centre, radial.log_width, radial.log_slope)
                ]
                for centre, log_width, log_slope in torch.stack(parts, 1).tolist():  # maps in turn
                    d, width = exact - mpmath.mpf(centre), mpmath.exp(mpmath.mpf(log_width))
                    exact += mpmath.expm1(mpmath.mpf(log_slope)) * d * width / (width + abs(d))
                error = float(abs(mpmath.mpf(float(found[i])) - exact) / (1 + abs(exact)))
            worst["transform"] = max(worst["transform"], error)
    for name, error in worst.items():
        print(f"worst error against 40 digits, {name}: {error:.1e}")
    assert worst["transform"] < 1e-14
    assert worst["Poisson-Gaussian"] < 1e-8


@pytest.mark.parametrize("name", ["Poisson-Gaussian", "mixture", "physics and flow"])
@pytest.mark.parametrize(("scale", "offset"), [(1e-12, 0.0), (1e12, 0.0), (1.0, 1e6)])
def test_physical_fits_do_not_depend_on_scale_and_offset(name: str, scale: float, offset: float) -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(3000, generator=generator, dtype=torch.float64)
    observation = signal + 0.1 * torch.randn(3000, generator=generator, dtype=torch.float64)
    model = MODELS[name]().double()
    result = noiseflow.fit(model, (signal + offset) * scale, (observation + offset) * scale, num_steps=10)
    assert result.recoveries == 0
    assert result.held_out_nll - math.log(scale) == pytest.approx(-0.88, abs=0.25)


@pytest.mark.parametrize("name", ["radial", "spline", "signal-dependent Gaussian"])
@pytest.mark.parametrize(("offset", "scale"), [(0.0, 1e-12), (0.0, 1e12), (1e6, 1.0)])
def test_fits_do_not_depend_on_scale_and_offset(name: str, scale: float, offset: float) -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(4000, generator=generator, dtype=torch.float64)
    observation = signal + 0.1 * torch.randn(4000, generator=generator, dtype=torch.float64)
    model = MODELS[name]().double()
    result = noiseflow.fit(model, (signal + offset) * scale, (observation + offset) * scale, num_steps=30)
    assert result.recoveries == 0
    assert result.held_out_nll - math.log(scale) == pytest.approx(-0.88, abs=0.25)


@pytest.mark.parametrize("name", [name for name in MODELS if "8-bit" not in name])
def test_bfloat16_autocast_changes_nothing(name: str) -> None:
    model = disturbed(MODELS[name](), 0.0 if name == "Poisson" else 0.3).float()
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
