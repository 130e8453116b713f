"""Scaling without bias, the long exposure's own noise found, and wrong pairs refused."""

import numpy as np
import pytest

from calibration.exposures.frames import ExposurePair
from calibration.exposures.masks import defects, saturated
from calibration.exposures.scaling import blocks_of
from calibration.registration.aligned import align_pair, block_split

from .. import simulators as sim
from ..conftest import expose, rigid, textured_scene


@pytest.fixture(scope="module")
def noisy():
    """A pair whose long exposure is only four times the short one, so that its noise matters."""
    generator = np.random.default_rng(2)
    scene = textured_scene(generator, 256)
    return expose(scene, rigid(0, (2.0, 1.0), 256), 256, generator, ratio=4.0)


def test_slope_and_intercept_are_unbiased_by_the_noise_of_the_long_exposure(noisy):
    aligned = align_pair(ExposurePair(noisy.short, noisy.long))
    scaling = aligned.scaling
    assert scaling.slope == pytest.approx(1 / 4, abs=4 * scaling.slope_error)
    assert scaling.intercept == pytest.approx(100 * (1 - 1 / 4), abs=4 * scaling.intercept_error)
    x, y = (image[aligned.mask] for image in (aligned.registration.warp(noisy.long)[0], noisy.short))
    ordinary = np.polyfit(x, y, 1)[0]
    assert ordinary < 1 / 4 - 4 * scaling.slope_error


def test_own_noise_of_few_electrons_grows_with_the_signal_as_fast_as_it_does():
    departures = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        scene = sim.random_scene(generator, 128, mean=6.0)
        short, long = (
            np.round(100 + 2 * (generator.poisson(times * scene) + 2 * generator.standard_normal(scene.shape)))
            for times in (1, 16)
        )
        aligned = align_pair(ExposurePair(short, long))
        own, kept = aligned.signal_variance, np.var(aligned.registration.noise(long.shape)[1][aligned.mask])
        departures.append((own.rate - kept * 2 / 16) / own.rate_error)
    assert abs(np.mean(departures)) < 3 / np.sqrt(len(departures))


def test_own_noise_of_the_long_exposure_is_found(noisy):
    aligned = align_pair(ExposurePair(noisy.short, noisy.long))
    truth = np.mean((aligned.signal - noisy.signal)[aligned.mask] ** 2)
    assert aligned.signal_variance(aligned.signal)[aligned.mask].mean() == pytest.approx(truth, rel=0.15)


def test_observation_scatters_as_the_short_exposure_alone(noisy):
    aligned = align_pair(ExposurePair(noisy.short, noisy.long))
    expected = np.mean((noisy.short - noisy.signal)[aligned.mask] ** 2)
    raw = np.mean((noisy.short - aligned.signal)[aligned.mask] ** 2)
    assert raw > 1.12 * expected
    assert np.mean((aligned.observation - aligned.signal)[aligned.mask] ** 2) == pytest.approx(expected, rel=0.04)


def test_swapped_exposures_are_refused(exposures):
    with pytest.raises(ValueError, match="exchange the two"):
        align_pair(ExposurePair(exposures.long, exposures.short))


def test_rescaled_copy_is_refused(exposures):
    with pytest.raises(ValueError, match="copy"):
        align_pair(ExposurePair(exposures.short, 3 * exposures.short + 7))


def test_hot_and_dead_pixels_are_those_bad_in_every_frame(exposures):
    short, long = exposures.short.copy(), exposures.long.copy()
    for y, x in ((20, 30), (100, 50)):
        short[y, x], long[y, x] = 900, 9000
    short[60, 60], long[60, 60] = 0, 0
    short[80, 80] = 900  # once only: noise, not a defect
    hot, dead = defects(np.stack([short, long]))
    assert np.argwhere(hot).tolist() == [[20, 30], [100, 50]]
    assert np.argwhere(dead).tolist() == [[60, 60]]


def test_saturated_pixels_of_the_long_exposure_are_masked(exposures):
    rail = np.percentile(exposures.long, 97)
    aligned = align_pair(ExposurePair(exposures.short, np.minimum(exposures.long, rail)))
    clipped, _ = aligned.registration.warp((exposures.long >= rail).astype(float))
    assert not (aligned.mask & (clipped > 0.5)).any()
    assert aligned.counts.saturated >= saturated(np.minimum(exposures.long, rail)).sum() * 0.8
    assert aligned.scaling.slope == pytest.approx(1 / 16, rel=0.01)


def test_blocks_are_kept_whole():
    apart = block_split(blocks_of((50, 70), side=10), np.random.default_rng(0), fraction=0.4)
    blocks = apart.reshape(5, 10, 7, 10).mean(axis=(1, 3))
    assert set(blocks.ravel()) == {0.0, 1.0}
    assert blocks.sum() == 14


def test_shot_noise_of_the_long_exposure_is_measured_where_few_bright_pixels_scatter_most():
    generator = np.random.default_rng(3)
    electrons = 20.0 * np.exp(0.9 * np.clip(textured_scene(generator, 160)(*np.mgrid[:160, :160]), -2, 4))
    rates = []
    for seed in range(6):
        draw = np.random.default_rng(seed)
        short, long = (100.0 + 2 * draw.poisson(ratio * electrons) for ratio in (1.0, 16.0))
        own = align_pair(ExposurePair(short, long)).signal_variance
        assert own.rate == pytest.approx(2 / 16, abs=4 * own.rate_error)
        rates.append((own.rate - 2 / 16) / own.rate_error)
    assert 0.3 < np.std(rates) < 2.0
