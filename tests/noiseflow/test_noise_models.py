"""Every noise model obeys one contract; densities integrate to one whatever their parameters."""

import itertools
import math

import pytest
import torch
from scipy import stats

import noiseflow
from noiseflow.distributions.numerics.normal import log_normal_cdf, log_normal_interval
from tests.contracts import check_noise_model, integrate_density

FLOWS = {
    "radial": lambda: noiseflow.RadialFlow(),
    "radial, mean-preserving": lambda: noiseflow.RadialFlow(mean_preserving=True),
    "radial, 3 layers": lambda: noiseflow.RadialFlow(3),
    "spline": lambda: noiseflow.SplineFlow(),
    "spline, mean-preserving": lambda: noiseflow.SplineFlow(mean_preserving=True),
    "signal-dependent Gaussian": lambda: noiseflow.SignalDependentGaussian(),
}
OTHERS = {
    "Gaussian": lambda: noiseflow.Gaussian(),
    "Poisson": lambda: noiseflow.Poisson(gain=0.05, offset=-0.2),
    "counter with dead time": lambda: noiseflow.DeadTimeCounter(0.2),
    "rounded": lambda: noiseflow.Digitised(noiseflow.RadialFlow(), step=1 / 16),
    "8-bit": lambda: noiseflow.Digitised(noiseflow.Gaussian(), step=1 / 255, low=0.0, high=1.0),
    "clipped": lambda: noiseflow.Digitised(noiseflow.Gaussian(), step=0.0, low=0.0, high=1.0),
}
SIGNALS = torch.tensor([0.0, 0.03, 0.5, 1.0], dtype=torch.float64)


def disturbed(model: torch.nn.Module, scale: float, seed: int = 0) -> torch.nn.Module:
    """The model in float64 with normal numbers added to all of its parameters."""
    generator = torch.Generator().manual_seed(seed)
    model = model.double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
    return model


@pytest.mark.parametrize("name", [*FLOWS, *OTHERS])
@pytest.mark.parametrize("scale", [0.0, 0.2])
def test_noise_model_keeps_its_contract(name: str, scale: float) -> None:
    model = (FLOWS | OTHERS)[name]()
    check_noise_model(disturbed(model, scale if name in FLOWS else 0.0), SIGNALS)


@pytest.mark.parametrize("name", FLOWS)
@pytest.mark.parametrize(("seed", "scale"), [(0, 0.0), *itertools.product(range(2), (0.5, 3.0, 50.0))])
def test_density_integrates_to_one(name: str, scale: float, seed: int) -> None:
    model = disturbed(FLOWS[name](), scale, seed)
    for signal in (0.0, 0.4, 1.0):
        with torch.no_grad():
            assert integrate_density(model, signal) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("name", FLOWS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_latent_round_trip(name: str, dtype: torch.dtype, tolerance: float) -> None:
    model = disturbed(FLOWS[name](), 0.3).to(dtype)
    distribution = model(torch.full((1001,), 0.3, dtype=dtype))
    latent = torch.linspace(-5, 5, 1001, dtype=dtype)
    observation = distribution.from_latent(latent)
    again = distribution.from_latent(distribution.to_latent(observation)[0])
    assert bool(((again - observation).abs() < tolerance * distribution.stddev).all())


@pytest.mark.parametrize("name", [name for name in FLOWS if "preserving" in name])
def test_mean_is_preserved(name: str) -> None:
    model = disturbed(FLOWS[name](), 0.15)
    signal = torch.linspace(0, 1, 301, dtype=torch.float64)
    distribution = model(signal)
    assert float(((distribution.mean - signal) / distribution.stddev).abs().max()) < 1e-4
    skewed = disturbed(noiseflow.RadialFlow(), 0.15)(signal)
    assert float(((skewed.mean - signal) / skewed.stddev).abs().max()) > 1e-2


def test_poisson_has_its_exact_masses() -> None:
    model = noiseflow.Poisson(gain=2.0, offset=10.0).double()
    count = torch.arange(0, 30, dtype=torch.float64)
    signal = torch.full_like(count, 10 + 2 * 6.5)
    found = model(signal).log_prob(10 + 2 * count) + math.log(2)
    assert torch.allclose(found, torch.from_numpy(stats.poisson(6.5).logpmf(count.numpy())), rtol=1e-6)
    assert torch.isneginf(model(signal).log_prob(torch.full_like(count, 4.0))).all()


@pytest.mark.parametrize("low", [-40.0, -8.0, -0.3, 0.0, 6.0, 40.0])
@pytest.mark.parametrize("width", [1e-12, 1e-6, 1e-2, 0.3, 5.0])
def test_log_normal_interval_agrees_with_mpmath(low: float, width: float) -> None:
    import mpmath

    mpmath.mp.dps = 400
    a, b = mpmath.mpf(low), mpmath.mpf(low + width)
    root = mpmath.sqrt(2)
    exact = mpmath.log((mpmath.erfc(-b / root) - mpmath.erfc(-a / root)) / 2)
    found = log_normal_interval(torch.tensor(low, dtype=torch.float64), torch.tensor(low + width, dtype=torch.float64))
    # the width itself carries a rounding error of about 1e-16·|low|
    assert float(found) == pytest.approx(float(exact), abs=1e-5 + 4e-16 * (1 + abs(low)) / width)


def test_log_normal_interval_reaches_to_infinity_with_finite_gradients() -> None:
    low = torch.tensor([-math.inf, 3.0, -math.inf, 30.0], dtype=torch.float64, requires_grad=True)
    high = torch.tensor([-3.0, math.inf, math.inf, math.inf], dtype=torch.float64, requires_grad=True)
    value = log_normal_interval(low, high)
    expected = torch.from_numpy(stats.norm.logcdf([-3, -3, math.inf, -30]))
    assert torch.allclose(value, expected, rtol=1e-10)
    value.sum().backward()
    assert torch.isfinite(high.grad[0])
    assert torch.isfinite(low.grad[1])


def test_clipped_gaussian_has_its_tails_on_the_rails() -> None:
    model = noiseflow.Digitised(noiseflow.Gaussian(0.25), step=0.0, low=0.0, high=1.0).double()
    signal = torch.tensor([0.1], dtype=torch.float64)
    log_rail = model(signal).log_prob(torch.zeros(1, dtype=torch.float64))
    assert float(log_rail.detach().exp()) == pytest.approx(stats.norm.cdf(-0.1 / 0.25), rel=1e-7)


def test_digitised_masses_sum_to_one() -> None:
    model = disturbed(noiseflow.Digitised(noiseflow.SplineFlow(), step=1 / 255, low=0.0, high=1.0), 0.3)
    levels = torch.arange(256, dtype=torch.float64) / 255
    for signal in (0.0, 0.5, 1.0):
        total = model(torch.full_like(levels, signal)).log_prob(levels).exp().sum()
        assert float(total.detach()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("step", "low", "high"), [(-1.0, 0.0, 1.0), (1.0, 2.0, 1.0)])
def test_digitised_refuses_impossible_settings(step: float, low: float, high: float) -> None:
    with pytest.raises(ValueError, match=r"step is|low clipping limit must be below"):
        noiseflow.Digitised(noiseflow.Gaussian(), step=step, low=low, high=high)


def test_poisson_finds_gain_and_offset_and_allows_every_reading() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = 30 + 400 * torch.rand(200_000, generator=generator)
    observation = 2 * torch.poisson((signal - 20) / 2, generator=generator) + 20
    model = noiseflow.Poisson()
    model.standardise(signal, observation)
    assert float(model.log_gain.exp()) == pytest.approx(2, rel=0.02)
    assert float(model.offset) == pytest.approx(20, abs=2)
    with_read_noise = observation + 30 * torch.randn(observation.shape, generator=generator)
    model.standardise(signal, with_read_noise)
    assert torch.isfinite(model(signal).log_prob(with_read_noise)).all()


@pytest.mark.parametrize("x", [-1e15, -1e8, -100.0, -3.0, 0.0, 4.0, 30.0])
def test_log_normal_cdf_has_the_right_gradient(x: float) -> None:
    import mpmath

    mpmath.mp.dps = 60
    at = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    log_normal_cdf(at).backward()
    exact = mpmath.npdf(x) / mpmath.ncdf(x) if x > -1e3 else -mpmath.mpf(x) - 1 / mpmath.mpf(x)
    assert float(at.grad) == pytest.approx(float(exact), rel=1e-10)


@pytest.mark.parametrize("name", ["PoissonGaussian", "Mixture", "PhysicsFlow", *(n for n in FLOWS), "Gaussian"])
@pytest.mark.parametrize("step", [0.0, 1 / 32])
def test_every_model_can_be_fitted_behind_rails(name: str, step: float) -> None:
    inner = getattr(noiseflow, name)() if hasattr(noiseflow, name) else FLOWS[name]()
    model = noiseflow.Digitised(inner, step=step, low=0.0, high=1.0)
    signal = torch.linspace(0, 1, 500)
    reading = signal + 0.2 * torch.randn(500, generator=torch.Generator().manual_seed(0))
    observation = ((reading / step).round() * step if step else reading).clamp(0, 1)
    model.standardise(signal, observation)
    model(signal).log_prob(observation).mean().backward()
    for parameter in model.parameters():
        assert parameter.grad is None or bool(torch.isfinite(parameter.grad).all())
