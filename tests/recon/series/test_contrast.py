"""The mode of a series, as its images decide it."""

import numpy as np
import pytest

import recon
from recon.series.first_guess import likely_mode
from recon.simulate.simulation import Acquisition


@pytest.mark.parametrize("mode", ["transmission", "linear"])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_mode_is_that_of_the_images(mode: str, noise: float) -> None:
    density = np.zeros((24, 24, 24))
    density[8:14, 6:18, 9:17] = 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 5.0), acquisition=Acquisition(None, mode))
    images = series.images + noise * series.images.std() * np.random.default_rng(0).normal(size=series.images.shape)
    other = recon.TiltSeries(images.astype(np.float32), series.tilt_angles)
    assert likely_mode(other) == mode


@pytest.mark.parametrize("counts", [0.05, 0.5, 2.0])
def test_maps_of_few_counts_have_a_dark_background(counts: float) -> None:
    density = np.zeros((24, 24, 24))
    density[8:14, 6:18, 9:17] = 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 5.0), acquisition=Acquisition(None, "linear"))
    images = np.random.default_rng(0).poisson(counts * series.images / series.images.max()).astype(np.float32)
    assert likely_mode(recon.TiltSeries(images, series.tilt_angles)) == "linear"


def test_images_of_noise_have_no_mode() -> None:
    images = np.random.default_rng(0).normal(100.0, 1.0, (25, 24, 24)).astype(np.float32)
    assert likely_mode(recon.TiltSeries(images, np.arange(-60, 61, 5.0))) is None
