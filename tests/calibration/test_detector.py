"""The detector's likelihood is exact, its posterior honest, and what cannot be measured is refused."""

import numpy as np
import pytest
from scipy import stats

from calibration.align import Registration
from calibration.aligned import align_with
from calibration.detector import dark_offset, measure_detector, misfit
from calibration.exposures import Burst, ExposurePair
from calibration.likelihood import DetectorLikelihood
from calibration.photon_transfer import NUM_BINS, NotMeasurable, Readings, collect_levels, fit_photon_transfer
from calibration.posterior import potential_scale_reduction, sample_posterior

from .conftest import expose, rigid, textured_scene

GAIN, OFFSET, READ_NOISE = 2.0, 100.0, 1.5


def readings(generator, electrons, *, share=0.0, step=0.0, gain=GAIN, read_noise=READ_NOISE):
    """Readings of known electrons beside an estimate of their signal with a given share of their noise."""
    rate = np.asarray(electrons, float)

    def draw(times: float):
        counts = generator.poisson(rate * times) / times
        return OFFSET + gain * (counts + read_noise / times**0.5 * generator.standard_normal(rate.shape))

    observation, signal = draw(1.0), OFFSET + gain * rate if share == 0 else draw(1 / share)
    observation = np.round(observation / step) * step if step else observation
    return Readings(observation, signal, rate, share, share, step=step)


def single_level(rate: float, *, share: float = 0.0, step: float = 0.0):
    return collect_levels(
        [readings(np.random.default_rng(0), np.full(2000, rate), share=share, step=step)], num_levels=1
    )


@pytest.mark.parametrize("rate", [0.3, 4.0, 60.0, 3000.0])
@pytest.mark.parametrize("share", [0.0, 0.1])
def test_bin_masses_sum_to_one(rate, share):
    likelihood = DetectorLikelihood(single_level(rate, share=share, step=1.0))
    mass = likelihood.masses(np.array([GAIN]), np.array([OFFSET]), np.array([READ_NOISE]))
    assert mass.sum() == pytest.approx(1, abs=1e-12)
    assert mass.min() > -1e-9


def test_bin_masses_match_the_poisson_mixture():
    levels = single_level(3.0)
    mass = DetectorLikelihood(levels).masses(np.array([GAIN]), np.array([OFFSET]), np.array([READ_NOISE]))[0, 0]
    edges = (np.arange(NUM_BINS + 1) - NUM_BINS / 2) * levels.width[0]
    counts = np.arange(60)
    centres = GAIN * (counts - (levels.signal[0] - OFFSET) / GAIN)
    below = stats.norm.cdf((edges[:, None] - centres) / (GAIN * READ_NOISE)) @ stats.poisson.pmf(counts, 3.0)
    np.testing.assert_allclose(mass, np.diff(below), atol=2e-9)


def test_likelihood_of_a_parameter_set_does_not_depend_on_its_neighbours():
    levels = collect_levels([readings(np.random.default_rng(1), np.random.default_rng(2).gamma(2.0, 5.0, 20_000))])
    likelihood = DetectorLikelihood(levels)
    sets = np.array([[2.0, 100.0, 1.5], [0.5, 90.0, 8.0], [9.0, 101.0, 0.2]])
    together = likelihood(*sets.T)
    alone = [float(likelihood(*one[:, None])[0]) for one in sets]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_photon_transfer_line_gives_the_gain_despite_a_noisy_signal():
    electrons = np.random.default_rng(2).gamma(2.0, 20.0, 200_000)
    line = fit_photon_transfer(collect_levels([readings(np.random.default_rng(3), electrons, share=0.1, step=1.0)]))
    assert line.gain == pytest.approx(GAIN, rel=0.02)
    assert line.intercept == pytest.approx((GAIN * READ_NOISE) ** 2 - GAIN * OFFSET, abs=4)


def test_noise_that_does_not_grow_with_the_signal_has_no_gain():
    generator = np.random.default_rng(0)
    signal = generator.uniform(100, 1000, 50_000)
    falling = Readings(signal + generator.standard_normal(signal.shape) * (20 - signal / 100), signal, signal)
    with pytest.raises(NotMeasurable, match="does not grow"):
        fit_photon_transfer(collect_levels([falling]))


def test_posterior_covers_the_truth_and_the_fit_is_good():
    electrons = np.random.default_rng(5).gamma(1.2, 12.0, 60_000)
    levels = collect_levels([readings(np.random.default_rng(6), electrons, share=1 / 16, step=1.0)])
    found = sample_posterior(levels, offset=(OFFSET, 0.05))
    for interval, truth in ((found.gain, GAIN), (found.offset, OFFSET), (found.read_noise, READ_NOISE)):
        width = interval.q95 - interval.q05
        assert interval.q05 - 0.5 * width < truth < interval.q95 + 0.5 * width
    assert found.gain.q95 / found.gain.q05 < 1.1
    assert found.num_steps >= 50 * found.autocorrelation_time
    assert found.rhat < 1.05
    assert misfit(levels, found.most_likely) == pytest.approx(1, abs=0.25)


def test_unconverged_chain_is_an_error_that_says_how_many_more_steps():
    electrons = np.random.default_rng(5).gamma(1.2, 12.0, 5_000)
    levels = collect_levels([readings(np.random.default_rng(6), electrons)])
    with pytest.raises(ValueError, match=r"needs about \d+ more"):
        sample_posterior(levels, num_steps=60, largest_num_steps=60)


def test_scale_reduction_tells_chains_that_disagree():
    chain = np.random.default_rng(0).standard_normal((400, 8, 3))
    assert potential_scale_reduction(chain) < 1.01
    chain[:, :4, 1] += 1.0
    assert potential_scale_reduction(chain) > 1.1


def test_dark_frames_fix_offset_and_read_noise():
    generator = np.random.default_rng(9)
    scene = textured_scene(generator, 128)
    pair = expose(scene, rigid(0, (0, 0), 128), 128, generator, electrons=200.0, read_noise=3.0)
    dark = Burst(np.round(100 + 2 * 3.0 * generator.standard_normal((6, 128, 128))))
    assert dark_offset(dark)[0] == pytest.approx(100, abs=4 * dark_offset(dark)[1])
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    found = measure_detector([align_with(ExposurePair(pair.short, pair.long), still)], dark=dark).posterior
    assert found.read_noise.median == pytest.approx(3.0, rel=0.05)
    assert found.gain.median == pytest.approx(2.0, rel=0.05)
    assert found.read_noise.q95 / found.read_noise.q05 < 1.15


def test_clipped_readings_are_refused():
    generator = np.random.default_rng(4)
    scene = textured_scene(generator, 128)
    pair = expose(scene, rigid(0, (0, 0), 128), 128, generator, electrons=12.0, read_noise=8.0, offset=0.0)
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    aligned = align_with(ExposurePair(pair.short.clip(0), pair.long), still)
    with pytest.raises(NotMeasurable, match="rails"):
        measure_detector([aligned])
