"""Shot and read noise, mixtures, physics with a flow: exact against other routes to the same numbers, fitted to the truth."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mpmath
import pytest
import torch
from torch import Tensor

import noiseflow
from benchmarks.pages.noise_laws import laws
from noiseflow.distributions.electrons import exact as electrons
from noiseflow.distributions.electrons.exact import below, log_both_tails, log_density, log_interval
from noiseflow.distributions.numerics.normal import log_normal_cdf
from noiseflow.models import detector_start
from noiseflow.models.physics_flow import ndtri_exp
from recon.simulate.noises import CountingNoise
from tests.contracts import check_noise_model, integrate_density

SIGNALS = torch.tensor([0.0, 0.03, 0.5, 1.0], dtype=torch.float64)
READ_NOISES = [0.05, 0.2, 0.6, 1.0, 1.499, 1.501, 4.0, 100.0]
RATES = [0.0, 1e-12, 1e-3, 0.5, 3.0, 9.0, 25.0, 60.0, 400.0, 1e4, 1e6]
DEVIATIONS = torch.tensor([-25.0, -6.0, -2.0, -0.4, 0.0, 0.3, 1.7, 5.0, 25.0], dtype=torch.float64)
MODELS = {
    "Poisson-Gaussian, resolved electrons": lambda: noiseflow.PoissonGaussian(gain=0.1, offset=-0.05, read_noise=0.2),
    "Poisson-Gaussian, one electron": lambda: noiseflow.PoissonGaussian(gain=0.1, offset=-0.05, read_noise=1.0),
    "Poisson-Gaussian, default": lambda: noiseflow.PoissonGaussian(),
    "physics and flow": lambda: moved(noiseflow.PhysicsFlow(detector=noiseflow.PoissonGaussian(0.1, -0.05, 0.4))),
    "physics and flow, default": lambda: noiseflow.PhysicsFlow(),
    "physics and flow of a dim detector": lambda: moved(
        noiseflow.PhysicsFlow(detector=noiseflow.PoissonGaussian(0.1, -0.05, 0.4))
    ),
    "mixture": lambda: noiseflow.Mixture(),
    "mixture of one shape": lambda: noiseflow.Mixture(shared_shape=True),
    "mixture of one shape, mean-preserving": lambda: noiseflow.Mixture(shared_shape=True, mean_preserving=True),
    "mixture, mean-preserving": lambda: noiseflow.Mixture(5, mean_preserving=True),
}


def moved(model: torch.nn.Module, scale: float = 0.2) -> torch.nn.Module:
    """The model with normal numbers added to the parameters of its flow."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.correction.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return model


def scalar(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def log_masses(rate: float, middle: float, reach: float) -> tuple[Tensor, Tensor]:
    """Integers around `middle` and their log Poisson masses; large rates by Loader's saddle-point form."""
    k = torch.arange(max(0, math.floor(middle - reach)), math.ceil(middle + reach) + 1, dtype=torch.float64)
    if rate == 0:
        return k, torch.where(k > 0, -math.inf, 0.0)
    if rate < 1e3:
        return k, torch.xlogy(k, scalar(rate)) - rate - torch.lgamma(k + 1)
    safe = k.clamp(min=1)
    stirling = 0.5 * torch.log(2 * math.pi * safe) + 1 / (12 * safe) - 1 / (360 * safe**3)
    return k, k * torch.log(rate / safe) + k - rate - stirling


def summed(rate: float, read_noise: float, observation: float) -> tuple[float, float, float]:
    """Log-density and both log tails by the plain sum over all electrons that could matter."""
    reach = 16 * math.sqrt(max(rate, abs(observation))) + abs(observation - rate) + 60
    k, log_mass = log_masses(rate, (rate + observation) / 2, reach)
    z = (observation - k) / read_noise
    log_normal = -0.5 * z**2 - math.log(read_noise * math.sqrt(2 * math.pi))
    parts = (log_normal, torch.special.log_ndtr(z), torch.special.log_ndtr(-z))
    return tuple(float(torch.logsumexp(log_mass + part, 0)) for part in parts)


@pytest.mark.parametrize("read_noise", READ_NOISES)
@pytest.mark.parametrize("rate", RATES)
def test_density_and_tails_agree_with_the_plain_sum(read_noise: float, rate: float) -> None:
    residual = DEVIATIONS * math.sqrt(rate + read_noise**2)
    rates = torch.full_like(residual, rate)
    density = log_density(residual, rates, scalar(read_noise))
    lower, upper = log_both_tails(residual, rates, scalar(read_noise))
    for i, r in enumerate(residual.tolist()):
        expected, expected_lower, expected_upper = summed(rate, read_noise, rate + r)
        rounding = 4e-16 * rate * (1 + abs(r) / read_noise**2)  # of the plain sum and of the observation itself
        assert float(density[i]) == pytest.approx(expected, abs=1e-6 + rounding)
        near, expected_near = (upper, expected_upper) if r > 0 else (lower, expected_lower)
        assert float(near[i]) == pytest.approx(expected_near, abs=1e-6 + rounding)
        assert float(lower[i].exp() + upper[i].exp()) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("read_noise", [0.05, 0.3, 1.0, 1.49])
@pytest.mark.parametrize("rate", [0.0, 1e-3, 0.5, 3.0, 25.0, 33.0, 300.0, 3e3])
def test_cumulative_probability_agrees_with_the_plain_sum(rate: float, read_noise: float) -> None:
    residual = DEVIATIONS * math.sqrt(rate + read_noise**2)
    found = below(residual, torch.full_like(residual, rate), scalar(read_noise))
    expected = [math.exp(summed(rate, read_noise, rate + r)[1]) for r in residual.tolist()]
    assert found.tolist() == pytest.approx(expected, rel=1e-8, abs=1e-8)


def mpmath_density(rate: float, read_noise: float, observation: float) -> float:
    with mpmath.workdps(40):
        r, s, y = (mpmath.mpf(each) for each in (rate, read_noise, observation))
        scale = max(rate, abs(observation))
        first, last = (int(max(0, scale + side * (30 * math.sqrt(scale) + 60))) for side in (-1, 1))
        log_first = first * mpmath.log(r) - r - mpmath.loggamma(first + 1)
        mass, total = mpmath.mpf(1), mpmath.mpf(0)
        for k in range(first, last):
            total += mass * mpmath.exp(-((y - k) ** 2) / (2 * s**2))
            mass *= r / (k + 1)
        return float(log_first + mpmath.log(total) - mpmath.log(s * mpmath.sqrt(2 * mpmath.pi)))


@pytest.mark.parametrize(
    ("rate", "read_noise", "observation"),
    [
        (3.0, 0.2, 5.4),
        (1e-3, 1.499, -6.0),
        (1e-3, 1.501, 9.0),
        (22.0, 50.0, 200.0),
        (1e4, 0.05, 10321.37),
        (40.0, 2.0, 3.0),
    ],
)
def test_density_agrees_with_mpmath(rate: float, read_noise: float, observation: float) -> None:
    found = log_density(scalar(observation - rate).reshape(1), scalar(rate).reshape(1), scalar(read_noise))
    assert float(found) == pytest.approx(mpmath_density(rate, read_noise, observation), abs=1e-7)


@pytest.mark.parametrize("read_noise", [0.2, 1.0, 1.6, 20.0])
@pytest.mark.parametrize("rate", [0.0, 0.5, 20.0, 3000.0])
@pytest.mark.parametrize("width", [1e-9, 0.01, 0.5, 2.9, 3.1, 40.0])
def test_interval_is_the_integral_of_the_density(read_noise: float, rate: float, width: float) -> None:
    spread = math.sqrt(rate + read_noise**2)
    for start in (-12.0, -1.0, -0.01, 0.5, 9.0):
        low = scalar(start * spread).reshape(1)
        found = float(log_interval(low, low + width, torch.full_like(low, rate), scalar(read_noise)))
        nodes, weights = gauss_legendre(max(2, math.ceil(width / (0.3 * min(read_noise, spread)))))
        inside = low + width * nodes
        values = log_density(inside, torch.full_like(inside, rate), scalar(read_noise))
        expected = float(torch.logsumexp(values + torch.log(weights), 0)) + math.log(width)
        if expected > -300:  # the reference's nodes are too few beyond
            assert found == pytest.approx(expected, abs=2e-6 + 4e-16 * (rate + abs(float(low))) / width)


def gauss_legendre(num_panels: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights on [0, 1], eight in each panel."""
    import numpy as np

    x, w = (torch.from_numpy(each) for each in np.polynomial.legendre.leggauss(8))
    start = torch.arange(num_panels, dtype=torch.float64)[:, None]
    return ((start + (x + 1) / 2) / num_panels).flatten(), (w / 2 / num_panels).repeat(num_panels)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("read_noise", [0.05, 0.5, 1.49, 3.0, 100.0])
def test_value_and_gradient_are_finite_everywhere(read_noise: float, dtype: torch.dtype) -> None:
    model = noiseflow.PoissonGaussian(gain=1.0, offset=0.0, read_noise=read_noise).to(dtype)
    levels = torch.tensor([-1e6, -3.0, 0.0, 1e-38, 1e-12, 0.4, 7.0, 300.0, 1e6, 1e9], dtype=dtype)
    signal, observation = (
        each.flatten().clone().requires_grad_() for each in torch.meshgrid(levels, levels, indexing="ij")
    )
    distribution = model(signal)
    half = 0.5 + 1e-6 * observation.detach().abs()
    for value in (
        distribution.log_prob(observation),
        distribution.log_interval_prob(observation - half, observation + half),
    ):
        assert value.dtype == dtype
        assert torch.isfinite(value).all()
        for gradient in torch.autograd.grad(value.sum(), [signal, observation, model.change], retain_graph=True):
            assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("read_noise", [0.3, 2.0])
def test_gradients_agree_with_differences(read_noise: float) -> None:
    model = noiseflow.PoissonGaussian(gain=0.3, offset=0.2, read_noise=read_noise).double()
    signal = torch.tensor([0.21, 0.7, 3.0, 40.0], dtype=torch.float64, requires_grad=True)
    observation = (signal + torch.tensor([0.1, 0.9, -1.0, 3.0])).detach().requires_grad_()
    parameters = list(model.parameters())

    def functions(signal: Tensor, observation: Tensor, *_: Tensor) -> tuple[Tensor, ...]:
        distribution = model(signal)
        ends = (-math.inf, observation), (observation, observation + 0.2), (observation, math.inf)
        intervals = (distribution.log_interval_prob(low, high) for low, high in ends)
        return distribution.log_prob(observation), distribution.cdf(observation), *intervals

    assert torch.autograd.gradcheck(functions, (signal, observation, *parameters), eps=1e-6, atol=1e-5)


def test_float32_agrees_with_float64() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = 100 + 3e4 * torch.rand(2000, generator=generator) ** 3
    observation = noiseflow.PoissonGaussian(2.0, 100.0, 0.3)(signal).sample(generator=generator)
    single = noiseflow.PoissonGaussian(2.0, 100.0, 0.3)(signal).log_prob(observation)
    double = noiseflow.PoissonGaussian(2.0, 100.0, 0.3).double()(signal.double()).log_prob(observation.double())
    assert float((single.double() - double).detach().abs().max()) < 1e-5


@pytest.mark.parametrize("name", MODELS)
def test_model_keeps_its_contract(name: str) -> None:
    check_noise_model(MODELS[name]().double(), SIGNALS)


@pytest.mark.parametrize("name", [name for name in MODELS if "flow" not in name])
def test_density_integrates_to_one(name: str) -> None:
    model = MODELS[name]().double()
    for signal in (0.0, 0.4, 1.0):
        nodes, weights = gauss_legendre(3000)
        reach = 30 * float(noiseflow.PoissonGaussian()(scalar(signal)).stddev.detach()) + 0.5
        observation = signal + reach * (2 * nodes - 1)
        mass = (model(torch.full_like(nodes, signal)).log_prob(observation).exp() * weights).sum() * 2 * reach
        assert float(mass.detach()) == pytest.approx(1, abs=1e-8)


@torch.no_grad()
def test_physics_flow_density_integrates_to_one() -> None:
    model = MODELS["physics and flow"]().double()
    for signal in (0.0, 0.4):
        assert integrate_density(model, signal, tolerance=1e-10) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("read_noise", [0.2, 2.0])
def test_physics_flow_starts_as_its_detector(read_noise: float) -> None:
    detector = noiseflow.PoissonGaussian(0.1, -0.05, read_noise).double()
    model = noiseflow.PhysicsFlow(detector=detector).double()
    observation = torch.linspace(-3, 9, 2001, dtype=torch.float64)
    signal = torch.full_like(observation, 0.6)
    found, expected = model(signal), detector(signal)
    assert torch.allclose(found.log_prob(observation), expected.log_prob(observation), rtol=1e-12, atol=1e-9)
    for width in (1e-6, 0.05, 1.0):
        masses = found.log_interval_prob(observation, observation + width)
        assert torch.allclose(
            masses, expected.log_interval_prob(observation, observation + width), rtol=1e-12, atol=1e-9
        )
    assert torch.allclose(found.cdf(observation), expected.cdf(observation), atol=1e-9)


def test_normal_quantile_of_a_log_probability_inverts_its_own() -> None:
    z = -torch.logspace(-3, 5, 400, dtype=torch.float64)
    assert torch.allclose(ndtri_exp(log_normal_cdf(z)), z, rtol=1e-11, atol=1e-12)


def test_physics_flow_latent_round_trip() -> None:
    model = MODELS["physics and flow"]().double()
    latent = torch.linspace(-7, 7, 301, dtype=torch.float64)
    for signal in (-0.05, 0.0, 0.5, 20.0):
        distribution = model(torch.full_like(latent, signal))
        assert torch.allclose(distribution.to_latent(distribution.from_latent(latent))[0], latent, atol=1e-7)


def test_what_a_fit_keeps_of_the_likelihood_is_the_likelihood() -> None:
    """Behind a converter: test_digitised_model."""
    model = MODELS["physics and flow of a dim detector"]().double()
    signal, reading = torch.linspace(0, 1, 50, dtype=torch.float64), torch.linspace(-0.2, 1.3, 50, dtype=torch.float64)
    kept = model.log_prob_from(signal, model.fixed_part(signal, reading))
    assert torch.allclose(kept, model(signal).log_prob(reading), rtol=1e-12)


def test_physics_flow_gradients_agree_with_differences() -> None:
    model = MODELS["physics and flow"]().double()
    signal = torch.tensor([0.01, 0.2, 0.9], dtype=torch.float64)
    observation = torch.tensor([0.05, 0.12, 1.3], dtype=torch.float64)
    names = ["detector.change", "correction.bias"]
    held = dict(model.named_parameters())

    def functions(signal: Tensor, observation: Tensor, *values: Tensor) -> Tensor:
        changed = held | dict(zip(names, values, strict=True))
        return torch.func.functional_call(
            Caller(model), {f"model.{n}": v for n, v in changed.items()}, (signal, observation)
        )

    inputs = [signal, observation, *(held[name].detach().clone() for name in names)]
    assert torch.autograd.gradcheck(functions, [each.requires_grad_() for each in inputs], eps=1e-6, atol=1e-4)


class Caller(torch.nn.Module):
    """Log-density and interval mass as one function of a model's parameters."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, signal: Tensor, observation: Tensor) -> Tensor:
        distribution = self.model(signal)
        interval = distribution.log_interval_prob(observation, observation + 0.05)
        return torch.stack([distribution.log_prob(observation), interval])


def shaken(model: noiseflow.Mixture) -> noiseflow.Mixture:
    """The mixture with its parameters anywhere."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator).to(parameter))
    return model.double()


@pytest.mark.parametrize("shared_shape", [False, True])
def test_mixture_preserves_the_mean(shared_shape: bool) -> None:
    model = shaken(noiseflow.Mixture(4, shared_shape=shared_shape, mean_preserving=True))
    signal = torch.linspace(-0.2, 1.2, 50, dtype=torch.float64)
    assert torch.allclose(model(signal).mean, signal, atol=1e-12)


@pytest.mark.parametrize("mean_preserving", [False, True])
def test_shared_shape_varies_with_the_signal_in_width_alone(mean_preserving: bool) -> None:
    model = shaken(noiseflow.Mixture(shared_shape=True, mean_preserving=mean_preserving))
    with torch.no_grad():
        noise = model(torch.linspace(0, 1, 20, dtype=torch.float64))
        quantiles = torch.stack([(noise.icdf(q) - noise.mean) / noise.stddev for q in torch.tensor([0.01, 0.3, 0.9])])
    assert float(noise.stddev.max() / noise.stddev.min()) > 1.5
    assert torch.allclose(quantiles, quantiles[:, :1].expand_as(quantiles), atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_digitised_masses_sum_to_one(name: str) -> None:
    model = noiseflow.Digitised(MODELS[name](), step=1 / 64, low=0.0, high=1.0).double()
    levels = torch.arange(65, dtype=torch.float64) / 64
    for signal in (0.0, 0.5, 1.0):
        total = model(torch.full_like(levels, signal)).log_prob(levels).exp().sum()
        assert float(total.detach()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_same_model_comes_back_from_its_file(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    again = noiseflow.load(noiseflow.save(model, tmp_path / "model.safetensors"))
    signal, observation = torch.linspace(0, 1, 9), torch.linspace(-0.3, 1.4, 9)
    assert torch.equal(again(signal).log_prob(observation), model(signal).log_prob(observation))


def photons(rate: float, read_noise: float, count: int, seed: int) -> tuple[noiseflow.PoissonGaussian, Tensor, Tensor]:
    """A detector of gain 2.13 and offset 101.2 that sees rates of 0.5 to 1.5 times `rate`."""
    generator = torch.Generator().manual_seed(seed)
    truth = noiseflow.PoissonGaussian(2.13, 101.2, read_noise)
    signal = 101.2 + 2.13 * rate * (0.5 + torch.rand(count, generator=generator))
    return truth, signal, truth(signal).sample(generator=generator)


@torch.no_grad()
def divergence(truth: torch.nn.Module, model: torch.nn.Module, signal: Tensor, observation: Tensor) -> float:
    """KL from the truth to the model, nats per pixel, by the draws themselves."""
    return float((truth(signal).log_prob(observation) - model(signal).log_prob(observation)).double().mean())


@pytest.mark.parametrize("read_noise", [0.2, 0.5])
@pytest.mark.parametrize("rate", [0.5, 3.0, 50.0])
def test_fitted_detector_is_the_true_one(rate: float, read_noise: float) -> None:
    truth, signal, observation = photons(rate, read_noise, 20_000, seed=1)
    model = noiseflow.PoissonGaussian()
    noiseflow.fit(model, signal, observation, num_steps=50)
    assert divergence(truth, model, *photons(rate, read_noise, 50_000, seed=2)[1:]) < 0.005


def test_detector_of_many_resolved_electrons_is_not_one_electron_off() -> None:
    truth, signal, observation = photons(50.0, 0.2, 60_000, seed=3)
    model = noiseflow.PoissonGaussian()
    model.standardise(signal, observation)
    found = [float(each.detach()) for each in (model.gain, model.offset, model.read_noise)]
    expected = [float(each.detach()) for each in (truth.gain, truth.offset, truth.read_noise)]
    assert found == pytest.approx(expected, rel=0.01, abs=0.02)


@pytest.mark.parametrize("excess_factor", [pytest.param(1.0, marks=pytest.mark.slow), 1.6])
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.1, 0.7), (0.0, math.inf)])
def test_a_fit_behind_limits_is_at_least_as_likely_as_the_truth(low: float, high: float, excess_factor: float) -> None:
    """Means of alike pixels mix no clipped values with others, and the probability of a limit has gradients."""
    truth, learner = (
        noiseflow.Digitised(detector(*each, excess_factor), step=0.0, low=low, high=high).double()
        for each in ((0.1, -0.02, 1.5), (1.0, 0.0, 1.0))
    )
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(20_000, generator=generator, dtype=torch.float64)
    observation = truth(signal).sample(generator=generator)
    fitted = noiseflow.fit(learner, signal, observation, held_out=1e-3).noise_model
    with torch.no_grad():
        assert float((truth(signal).log_prob(observation) - fitted(signal).log_prob(observation)).sum()) < 4.0


@pytest.mark.parametrize("step", [0.0, 1 / 64])
def test_detector_behind_rails_is_found(step: float) -> None:
    truth = noiseflow.Digitised(noiseflow.PoissonGaussian(0.05, 0.0, 1.5), step=step, low=0.0, high=1.0)
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(20_000, generator=generator, dtype=torch.float64)
    observation = truth(signal).sample(generator=generator)
    model = noiseflow.Digitised(noiseflow.PhysicsFlow(), step=step, low=0.0, high=1.0)
    model.standardise(signal, observation)
    assert divergence(truth, model, signal, observation) < 0.001


def test_a_step_so_far_that_densities_overflow_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    class Jump:
        def __init__(self, parameters: list[Tensor], **_: object) -> None:
            (self.change,) = parameters

        def zero_grad(self) -> None:
            self.change.grad = None

        def step(self, closure: Callable[[], Tensor]) -> None:
            self.change.data[2] += 450.0
            assert math.isinf(float(closure()))

    monkeypatch.setattr(detector_start, "lbfgs", Jump)
    noise = noiseflow.PoissonGaussian().double()
    signal = torch.linspace(5.0, 50.0, 4000, dtype=torch.float64)
    observation = torch.normal(signal, signal.sqrt(), generator=torch.Generator().manual_seed(0))
    noise.standardise(signal, observation)
    assert math.isfinite(float(noise(signal).log_prob(observation).sum().detach()))


@pytest.mark.parametrize(
    "noise", [noiseflow.PoissonGaussian(1.0, 0.0, 0.5), CountingNoise(0.5)], ids=lambda noise: type(noise).__name__
)
def test_readings_pull_an_estimate_below_the_offset_back(noise: torch.nn.Module) -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.full((4000,), -0.4, dtype=torch.float64, requires_grad=True)
    readings = noise(torch.zeros(4000, dtype=torch.float64)).sample(generator=generator)
    distribution = noise(signal)
    distribution.log_prob(readings).sum().backward()
    assert float(distribution.mean.detach().mean()) == pytest.approx(-0.4)
    assert float(distribution.sample(generator=generator).mean()) == pytest.approx(-0.4, abs=0.05)
    assert float(signal.grad.mean()) == pytest.approx(0.4 / 0.25, rel=0.1)


@pytest.mark.parametrize("read_noise", [0.02, 0.2, 0.9, 3.0, 10.0])
def test_cells_and_slopes_are_those_of_the_exact_integral(read_noise: float) -> None:
    """Every fast way to a cell's mass and its closed derivatives against the general one under autograd."""
    generator = torch.Generator().manual_seed(0)
    rate = 200 * torch.rand(400, generator=generator, dtype=torch.float64) ** 3 + 1e-3
    electrons_seen = torch.poisson(rate, generator=generator)
    read = read_noise * torch.randn(400, generator=generator, dtype=torch.float64)
    width = torch.tensor([0.05, 0.5, 2.5, 20.0], dtype=torch.float64).repeat(100)
    low = electrons_seen + read - rate - width * torch.rand(400, generator=generator, dtype=torch.float64)
    noise = torch.tensor(read_noise, dtype=torch.float64)
    found, slopes = electrons.interval_and_slopes(low, low + width, rate, noise, slopes=True)
    exact, exact_slopes = electrons._slowly(low, low + width, rate, noise, slopes=True)
    assert torch.allclose(found, exact, rtol=0, atol=1e-6)
    for slope, expected in zip(slopes, exact_slopes, strict=True):
        assert torch.allclose(slope, expected, rtol=1e-5, atol=1e-5)


def test_slope_by_the_rate_without_light_is_what_a_first_electron_adds() -> None:
    low, noise = torch.tensor([-0.9], dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    rate, step = torch.zeros(1, dtype=torch.float64), 1e-7
    _, slopes = electrons.interval_and_slopes(low, low + 2.4, rate, noise, slopes=True)
    at, after = (
        electrons.interval_and_slopes(low, low + 2.4, rate + more, noise, slopes=False)[0] for more in (0.0, step)
    )
    assert float(slopes[2]) == pytest.approx(float((after - at) / step), abs=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("read_noise", [0.3, 3.0, 100.0])
def test_values_beyond_the_likely_range_are_as_improbable_as_it_says_and_not_much_more(read_noise):
    signal = torch.tensor([120.0, 1e3, 1e6], dtype=torch.float64)
    law = noiseflow.PoissonGaussian(2.0, 100.0, read_noise)(signal)
    low, high = law.likely_range()
    ends = torch.full_like(signal, torch.inf)
    assert -50 < float(law.log_interval_prob(-ends, low).max()) < -30
    outside = law.log_interval_prob(high, ends)
    assert -50 < float(outside.min()) <= float(outside.max()) < -30


def detector(gain: float, offset: float, read_noise: float, excess_factor: float = 1.0) -> noiseflow.NoiseModelBase:
    if excess_factor > 1:
        return noiseflow.ExcessNoise(gain, offset, read_noise, excess_factor=excess_factor)
    return noiseflow.PoissonGaussian(gain, offset, read_noise)


@pytest.mark.parametrize(
    ("truth", "signals"),
    [
        ((2.0, 100.0, 1.5), (100.0, 5000.0)),  # a camera in good light
        ((0.5, 0.0, 0.6), (0.0, 5.0)),
        ((1.0, 0.0, 1.0), (5.0, 15.0)),
        ((30.0, 200.0, 0.2), (200.0, 6000.0)),  # resolved electrons
        ((40.0, 300.0, 0.2, 2.0), (300.0, 420.0)),  # an EMCCD in dim light
    ],
)
def test_a_fit_of_many_pixels_is_at_least_as_likely_as_the_truth(truth: tuple[float, ...], signals: Any) -> None:
    """Fits to 16 000 of the pixels lose about 20 nats, and those to a few alignments of electrons hundreds."""
    model, learner = detector(*truth), detector(1.0, 0.0, 1.0, *truth[3:])
    generator = torch.Generator().manual_seed(0)
    signal = signals[0] + (signals[1] - signals[0]) * torch.rand(200_000, generator=generator, dtype=torch.float64)
    observation = model(signal).sample(generator=generator)
    fitted = noiseflow.fit(learner, signal, observation, held_out=1e-3).noise_model
    with torch.no_grad():
        assert float((model(signal).log_prob(observation) - fitted(signal).log_prob(observation)).sum()) < 4.0


@pytest.mark.parametrize(
    ("read_noise", "level", "excess_factor"), [(0.3, 8.0, 1.0), (1.1, 100.0, 1.0), (0.15, 2000.0, 1.0), (0.3, 3.0, 2.0)]
)
def test_one_level_of_signals_gives_a_detector(read_noise: float, level: float, excess_factor: float) -> None:
    """The variance of one level has no slope; rounding errors of the level must not make one."""
    truth, learner = detector(2.5, 1 / 3, read_noise, excess_factor), detector(1.0, 0.0, 1.0, excess_factor)
    signal = torch.full((20_000,), 2.5 * level + 1 / 3, dtype=torch.float64)
    signal[::2] *= 1 + 1e-15
    observation = truth(signal).sample(generator=torch.Generator().manual_seed(0))
    fitted = noiseflow.fit(learner, signal, observation, held_out=1e-3).noise_model
    with torch.no_grad():
        assert float((truth(signal).log_prob(observation) - fitted(signal).log_prob(observation)).sum()) < 4.0


@pytest.mark.parametrize("read_noise", [0.01, 0.06, 0.15, 1.0])
def test_entropy_of_resolved_electrons_is_that_of_a_fine_sum(read_noise: float) -> None:
    rates = torch.tensor([0.01, 2.0, 60.0, 300.0], dtype=torch.float64)
    camera = noiseflow.PoissonGaussian(2.0, 5.0, read_noise).double()
    with torch.no_grad():
        law = camera(5 + 2 * rates)
        found, step = law.entropy(), min(read_noise / 8, 0.05)
        for pixel, rate in enumerate(rates.tolist()):
            electrons = torch.arange(-10, rate + 10 * rate**0.5 + 30, step, dtype=torch.float64)
            log_prob = camera(5 + 2 * rates[pixel].expand_as(electrons)).log_prob(5 + 2 * electrons)
            expected = -2 * step * float((log_prob.exp() * log_prob.clamp(min=-700)).sum())
            assert float(found[pixel]) == pytest.approx(expected, abs=1e-6)
        mean = law.expectation(lambda value: value)
        assert torch.allclose(mean, law.mean)
        assert torch.allclose(law.expectation(lambda value: (value - mean) ** 2), law.variance)
        scaled = law.rescaled(torch.tensor(3.0), torch.tensor(1.0))
        assert torch.allclose(scaled.entropy(), found + math.log(3))


def test_entropy_has_the_gradient_of_its_differences() -> None:
    camera = noiseflow.PoissonGaussian(2.0, 1.0, 0.08).double()
    signal = torch.tensor([1.5, 9.0, 400.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(camera(signal).entropy().sum(), signal)
    with torch.no_grad():
        difference = (camera(signal + 1e-4).entropy() - camera(signal - 1e-4).entropy()) / 2e-4
    assert torch.allclose(slope, difference, rtol=1e-4)


def test_a_search_ends_where_pixels_no_longer_tell_the_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Levels that are logarithms look like resolved electrons, with an offset a thousand electrons away."""
    signal, observation = (torch.from_numpy(each).float() for each in laws()["log-coded-12"].data(4500, 0))
    searches, settled = list[float](), detector_start._settled
    monkeypatch.setattr(detector_start, "_settled", lambda *given: (searches.append(0.0), settled(*given))[1])
    noiseflow.Digitised(noiseflow.PoissonGaussian()).scale_to(signal, observation)
    assert len(searches) < 40


def test_a_grid_of_counts_leaves_no_pixel_impossible() -> None:
    """The likeliest grid of 4096 pixels may begin above the lowest of all, which would stop a joint fit."""
    generator = torch.Generator().manual_seed(0)
    signal = 3 + 30 * torch.rand(20_000, generator=generator)
    observation = torch.poisson(signal, generator=generator).clamp(min=1)
    observation[7], signal[7] = -2, 3

    def behind(model: torch.nn.Module) -> noiseflow.Digitised:
        return noiseflow.Digitised(model, 1.0)

    model = noiseflow.Poisson()
    model.standardise(signal, observation)
    model.settle(signal, observation, behind)
    assert bool(behind(model)(signal).log_prob(observation).isfinite().all())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
@pytest.mark.parametrize(("low", "high", "gain", "read"), [(200.0, 4000.0, 2.0, 40.0), (0.0, 1.0, 0.002, 0.05)])
def test_steps_of_half_precision_are_no_electrons(
    low: float, high: float, gain: float, read: float, dtype: torch.dtype
) -> None:
    generator = torch.Generator().manual_seed(8)
    signal = low + (high - low) * torch.rand(6000, generator=generator, dtype=torch.float64)
    true = noiseflow.PoissonGaussian(gain, 0.0, read / gain).double()
    observation = true(signal).sample(generator=generator).to(dtype)
    found = noiseflow.fit(noiseflow.PoissonGaussian(), signal.to(dtype), observation, digitise=False).noise_model
    fresh = true(signal).sample(generator=generator)
    lost = true(signal).log_prob(fresh) - found.double()(signal).log_prob(fresh)
    assert float(lost.mean().detach()) < 2e-3
