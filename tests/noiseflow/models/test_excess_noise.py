"""Random multiplication: the density is that of the compound law, and a fit finds gain and excess factor apart."""

import numpy as np
import pytest
import torch
from scipy import stats

import noiseflow


def law(value, rate, gain, offset, read_noise, pulse_variance):
    """Density by summing over electrons and integrating the gamma law against the read noise, term by term."""
    grid = np.linspace(0, 60 * gain, 60_001)
    density = stats.poisson.pmf(0, rate) * stats.norm.pdf(value, offset, gain * read_noise)
    for electrons in range(1, 60):
        charge = stats.gamma.pdf(grid, electrons / pulse_variance, scale=gain * pulse_variance)
        charge[0] = 0.0
        spread = stats.norm.pdf(value, offset + grid, gain * read_noise)
        density += stats.poisson.pmf(electrons, rate) * np.trapezoid(charge * spread, grid)
    return density


@pytest.mark.parametrize("squared", [1.3, 2.0])
@pytest.mark.parametrize("rate", [0.4, 5.0])
def test_density_is_the_compound_law(squared, rate):
    gain, offset, read_noise = 10.0, 100.0, 0.5
    model = noiseflow.ExcessNoise(gain, offset, read_noise, excess_factor=squared)
    signal = torch.tensor([offset, offset + gain * rate, offset + 20 * gain], dtype=torch.float64)
    for value in (97.0, 110.0, 140.0, 190.0):
        found = float(model(signal).log_prob(torch.full((3,), value, dtype=torch.float64))[1].detach().exp())
        assert found == pytest.approx(law(value, rate, gain, offset, read_noise, squared - 1), rel=0.02)


def test_intervals_sum_to_one_and_moments_are_those_of_the_mass():
    model = noiseflow.ExcessNoise(4.0, 50.0, 0.8, excess_factor=1.8)
    signal = torch.tensor([50.0, 70.0, 300.0], dtype=torch.float64)
    value = torch.arange(-100.0, 2000.0, dtype=torch.float64)[:, None].expand(-1, 3)
    with torch.no_grad():
        mass = noiseflow.Digitised(model, step=1.0)(signal).log_prob(value).exp()
        variance = model(signal).variance
    np.testing.assert_allclose(mass.sum(0), 1, atol=1e-3)
    mean = (mass * value).sum(0)
    np.testing.assert_allclose(mean, signal, rtol=2e-3)
    np.testing.assert_allclose((mass * (value - mean) ** 2).sum(0), variance + 1 / 12, rtol=0.01)


@pytest.mark.parametrize("squared", [1.3, 2.0, 2.5])
@pytest.mark.parametrize("read_noise", [0.01, 0.03, 0.3])
def test_probabilities_sum_to_one_however_narrow_the_read_noise(read_noise: float, squared: float) -> None:
    model = noiseflow.Digitised(noiseflow.ExcessNoise(10.0, 0.0, read_noise, excess_factor=squared), step=1.0)
    signal = torch.linspace(0, 30, 16, dtype=torch.float64)
    value = torch.arange(-20.0, 600.0, dtype=torch.float64)[:, None].expand(-1, 16)
    with torch.no_grad():
        mass = model(signal).log_prob(value).exp()
    np.testing.assert_allclose(mass.sum(0), 1, atol=1e-6)


def test_samples_follow_the_distribution_function():
    model = noiseflow.ExcessNoise(30.0, 500.0, 0.4, excess_factor=2.0)
    distribution = model(torch.tensor([560.0, 900.0], dtype=torch.float64))
    drawn = distribution.sample((20_000,), generator=torch.Generator().manual_seed(0))
    transform = distribution.cdf(drawn).detach().numpy()
    for column in transform.T:
        assert stats.kstest(column, "uniform").statistic < 1.63 / np.sqrt(20_000) + 2e-3


def test_a_fit_tells_gain_from_excess_factor():
    truth = noiseflow.ExcessNoise(75.0, 500.0, 0.4, excess_factor=2.0)
    generator = torch.Generator().manual_seed(1)
    signal = 500 + 75 * torch.from_numpy(np.random.default_rng(1).gamma(2.0, 5.0, 30_000))
    observation = truth(signal).sample(generator=generator)
    model = noiseflow.ExcessNoise()
    model.standardise(signal, observation)
    assert float(model.gain * model.excess_factor) == pytest.approx(150, rel=0.04)
    assert float(model.excess_factor) == pytest.approx(2.0, abs=0.25)
    with torch.no_grad():
        loss = truth(signal).log_prob(observation).mean() - model(signal).log_prob(observation).mean()
    assert float(loss) < 0.002


def test_saved_and_loaded_it_is_the_same(tmp_path):
    model = noiseflow.ExcessNoise(3.0, 10.0, 1.5, excess_factor=1.6)
    loaded = noiseflow.load(noiseflow.save(model, tmp_path / "m.safetensors"))
    assert repr(loaded) == repr(model)


@pytest.mark.parametrize("rate", [29.0, 31.0, 720.0, 1e5])
def test_density_of_many_electrons_is_a_density(rate: float) -> None:
    law = noiseflow.ExcessNoise(gain=1.0, read_noise=0.5, excess_factor=1.5)(torch.tensor(rate, dtype=torch.float64))
    width = law.variance.detach().sqrt()
    value = rate + width * torch.linspace(-8, 8, 2001, dtype=torch.float64)
    density = law.log_prob(value).detach().exp()
    assert float(torch.trapezoid(density, value)) == pytest.approx(1, abs=1e-6)
    assert float(torch.trapezoid(density * (value - rate) ** 2, value)) == pytest.approx(float(width**2), rel=1e-5)


def test_second_derivatives_of_pixels_at_many_rates_are_those_of_each_pixel_alone() -> None:
    model = noiseflow.ExcessNoise(gain=40.0, offset=100.0, read_noise=2.0)
    signal, observation = (torch.tensor(each, dtype=torch.float64) for each in ([105.0, 140, 500], [95.0, 180, 420]))

    def curvature(pixels: slice) -> torch.Tensor:
        total = model(signal[pixels]).log_prob(observation[pixels]).sum()
        (slope,) = torch.autograd.grad(total, model.change, create_graph=True)
        return torch.stack([torch.autograd.grad(each, model.change, retain_graph=True)[0] for each in slope])

    # tables of a single pixel cover a range so narrow that interpolation is exact
    alone = sum(curvature(slice(i, i + 1)) for i in range(3))
    np.testing.assert_allclose(curvature(slice(None)), alone, atol=1e-3)


def test_no_pixels_give_no_probabilities() -> None:
    none = torch.empty(0)
    law = noiseflow.ExcessNoise()(none)
    for found in (
        law.log_prob(none),
        law.cdf(none),
        law.icdf(none),
        law.log_interval_prob(none, none + 1),
        law.sample(),
    ):
        assert found.shape == (0,)
