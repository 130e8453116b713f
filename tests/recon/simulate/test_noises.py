"""The known noises: each is a normalised density with the mean, the spread and the samples it claims."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from recon.simulate.noises import CountingNoise, OutlierNoise, SkewedNoise
from recon.simulate.phantoms import PHANTOMS, make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series

NOISES = [SkewedNoise(0.05, 0.2), SkewedNoise(0.1, 0.1, skewness=0.8), OutlierNoise(), CountingNoise(0.4)]
SIGNALS = torch.tensor([0.2, 1.0, 3.0], dtype=torch.float64)


@pytest.mark.parametrize("noise", NOISES, ids=lambda noise: type(noise).__name__)
def test_density_has_unit_mass_and_the_moments_claimed(noise):
    distribution = noise(SIGNALS[:, None])
    value = torch.linspace(-40, 60, 50_001, dtype=torch.float64)
    density = distribution.log_prob(value.expand(3, -1)).exp()
    step = value[1] - value[0]
    torch.testing.assert_close(density.sum(1) * step, torch.ones(3).double(), rtol=1e-6, atol=0)
    mean = (density * value).sum(1) * step
    torch.testing.assert_close(mean, SIGNALS, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(distribution.mean.flatten(), SIGNALS)
    variance = (density * (value - mean[:, None]) ** 2).sum(1) * step
    torch.testing.assert_close(distribution.variance.flatten(), variance, rtol=1e-5, atol=0)


@pytest.mark.parametrize("noise", NOISES, ids=lambda noise: type(noise).__name__)
def test_samples_follow_the_distribution_function(noise):
    distribution = noise(torch.full((4000,), 1.3, dtype=torch.float64))
    sample = distribution.sample(generator=torch.Generator().manual_seed(0))
    assert kstest(distribution.cdf(sample).numpy(), "uniform").pvalue > 0.01
    torch.testing.assert_close(distribution.icdf(distribution.cdf(sample)), sample, rtol=1e-6, atol=1e-6)
    interval = distribution.log_interval_prob(sample - 0.1, sample + 0.1).exp()
    torch.testing.assert_close(interval, distribution.cdf(sample + 0.1) - distribution.cdf(sample - 0.1))


@pytest.mark.parametrize("name", PHANTOMS)
def test_phantoms_keep_their_shape_at_every_size(name):
    coarse, fine = (make_phantom(name, size, generator=np.random.default_rng(1)) for size in (48, 96))
    assert 0 <= fine.min() < fine.max() <= 1
    binned = fine.reshape(48, 2, 48, 2, 48, 2).mean((1, 3, 5))
    assert np.abs(binned - coarse).mean() < 0.15 * coarse.mean()


@pytest.mark.parametrize("name", [name for name in ACQUISITIONS if name != "none"])
def test_every_acquisition_gives_a_series_near_its_clean_images(name):
    acquisition = ACQUISITIONS[name]
    volume = make_phantom("particles", 24, generator=np.random.default_rng(0))
    clean, _ = clean_tilt_series(volume, np.arange(-60, 61, 20.0), acquisition=acquisition)
    noisy = add_noise(clean, acquisition.noise(), seed=0)
    assert noisy.images.shape == clean.images.shape
    spread = noisy.images.astype(float) - clean.images
    assert abs(spread.mean()) < 0.5 * spread.std()
    assert (noisy.images.dtype == np.uint8) == (name == "8-bit")
    assert math.isfinite(spread.std())
