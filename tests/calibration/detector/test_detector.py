"""The detector's likelihood is exact, its posterior honest, and what cannot be measured is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage, stats

import noiseflow
from calibration.detector.correlation import correlation_of
from calibration.detector.figures import figures_of
from calibration.detector.levels import (
    NUM_BINS,
    NotMeasurable,
    Readings,
    Scale,
    collect_cells,
    collect_levels,
    electrons_show,
    true_moments,
)
from calibration.detector.likelihood import DetectorLikelihood, LevelMasses, misfit
from calibration.detector.log_posterior import LogPosterior
from calibration.detector.measure import _shares, measure_detector, pooled, readings_of
from calibration.detector.models import MOST_BLOCKS, collect_pixels
from calibration.detector.photon_transfer import fit_photon_transfer, level_of
from calibration.detector.posterior import DetectorPosterior, sample_posterior
from calibration.detector.repair import Repairs
from calibration.detector.shape import unevenness
from calibration.exposures.frames import Burst, ExposurePair
from calibration.registration.align import Registration
from calibration.registration.aligned import align_pair
from calibration.registration.bursts import align_burst

from ..conftest import expose, rigid, textured_scene
from ..simulators import exposed, random_scene

GAIN, OFFSET, READ_NOISE = 2.0, 100.0, 1.5


def readings(generator, electrons, *, share=0.0, step=0.0, gain=GAIN, read_noise=READ_NOISE):
    """Readings of known electrons beside an estimate of their signal with a given share of their noise."""
    rate = np.asarray(electrons, float)

    def draw(times: float):
        counts = generator.poisson(rate * times) / times
        return OFFSET + gain * (counts + read_noise / times**0.5 * generator.standard_normal(rate.shape))

    observation, signal = draw(1.0), OFFSET + gain * rate if share == 0 else draw(1 / share)
    observation = np.round(observation / step) * step if step else observation
    return Readings(observation, signal, rate, share, share, 1.0, step, 0.0)


def single_level(rate: float, *, share: float = 0.0, step: float = 0.0):
    return collect_levels(
        [readings(np.random.default_rng(0), np.full(2000, rate), share=share, step=step)], num_levels=1
    )


@pytest.mark.parametrize("rate", [0.3, 4.0, 60.0, 3000.0])
@pytest.mark.parametrize("share", [0.0, 0.1])
def test_bin_masses_sum_to_one(rate, share):
    likelihood = LevelMasses(single_level(rate, share=share, step=1.0))
    mass = likelihood.masses(np.array([GAIN]), np.array([OFFSET]), np.array([READ_NOISE]))
    assert mass.sum() == pytest.approx(1, abs=1e-12)
    assert mass.min() > -1e-9


@pytest.mark.parametrize("rate", [0.3, 3.0, 60.0, 300.0])
def test_bin_masses_are_those_of_the_noise_model(rate):
    levels = single_level(rate)
    mass = LevelMasses(levels).masses(np.array([GAIN]), np.array([OFFSET]), np.array([READ_NOISE]))[0, 0]
    edges = torch.from_numpy(levels.signal[0] + (np.arange(NUM_BINS + 1) - NUM_BINS / 2) * levels.width[0])
    signal = torch.full((NUM_BINS,), levels.signal[0], dtype=torch.float64)
    noise = noiseflow.PoissonGaussian(GAIN, OFFSET, READ_NOISE).double()(signal)
    expected = noise.log_interval_prob(edges[:-1], edges[1:]).exp().detach().numpy()
    np.testing.assert_allclose(mass, expected, atol=2e-9)


def test_likelihood_of_a_parameter_set_does_not_depend_on_its_neighbours():
    levels = collect_levels([readings(np.random.default_rng(1), np.random.default_rng(2).gamma(2.0, 5.0, 20_000))])
    likelihood = DetectorLikelihood([levels])
    sets = np.array([[2.0, 100.0, 1.5], [0.5, 90.0, 8.0], [9.0, 101.0, 0.2]])
    together = likelihood(*sets.T)
    alone = [float(likelihood(*one[:, None])[0]) for one in sets]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_photon_transfer_line_gives_the_gain_despite_a_noisy_signal():
    electrons = np.random.default_rng(2).gamma(2.0, 20.0, 200_000)
    line = fit_photon_transfer([collect_levels([readings(np.random.default_rng(3), electrons, share=0.1, step=1.0)])])
    assert line.gain == pytest.approx(GAIN, rel=0.02)
    assert line.intercept == pytest.approx((GAIN * READ_NOISE) ** 2 - GAIN * OFFSET, abs=4)


def test_noise_that_does_not_grow_with_the_signal_has_no_gain():
    generator = np.random.default_rng(0)
    signal = generator.uniform(100, 1000, 50_000)
    falling = Readings(
        signal + generator.standard_normal(signal.shape) * (20 - signal / 100), signal, signal, 0.0, 0.0, 1.0, 1.0, 0.0
    )
    with pytest.raises(NotMeasurable, match="does not grow"):
        fit_photon_transfer([collect_levels([falling])])


def test_posterior_covers_the_truth_and_the_fit_is_good():
    electrons = np.random.default_rng(5).gamma(1.2, 12.0, 60_000)
    levels = collect_levels([readings(np.random.default_rng(6), electrons, share=1 / 16, step=1.0)])
    found = sample_posterior([levels], offset=(OFFSET, 0.05))
    for interval, truth in ((found.gain, GAIN), (found.offset, OFFSET), (found.read_noise, READ_NOISE)):
        width = interval.q95 - interval.q05
        assert interval.q05 - 0.5 * width < truth < interval.q95 + 0.5 * width
    assert found.gain.q95 / found.gain.q05 < 1.1
    assert found.effective > 600
    assert found.rhat < 1.05
    assert misfit([levels], found.most_likely) == pytest.approx(1, abs=0.25)


def test_intervals_of_what_the_exposures_hardly_tell_hold_under_both_priors():
    generator, gain, variance = np.random.default_rng(0), 2.0, 400.0
    read_noise = np.exp(
        generator.uniform(np.log(0.1), np.log(8.0), 4000)
    )  # flat in the logarithm along a line of equal variance
    offset = 200.0 - (variance - (gain * read_noise) ** 2) / gain
    levels = collect_levels([readings(np.random.default_rng(6), np.full(2000, 50.0))], num_levels=1)
    levels = replace(levels, signal=np.array([200.0]))
    samples = np.column_stack([np.full(4000, gain), offset, read_noise])
    found = DetectorPosterior(samples, samples[0], 1.0, 1.0, 4000, (levels,))
    assert found.read_noise.q05 == pytest.approx(0.1 * 80**0.05, rel=0.1)  # of a prior flat in the logarithm
    assert found.read_noise.median == pytest.approx(8 * 0.5**0.5, rel=0.1)  # flat in the variance
    assert found.read_noise.q95 == pytest.approx(8 * 0.95**0.5, rel=0.03)
    assert found.offset.q95 == pytest.approx(200 - (400 - 4 * 0.95 * 64) / 2, rel=0.03)


def test_samples_that_do_not_represent_the_posterior_are_an_error(monkeypatch):
    electrons = np.random.default_rng(5).gamma(1.2, 12.0, 5_000)
    levels = collect_levels([readings(np.random.default_rng(6), electrons)])
    for name in ("importance_sample", "ensemble_sample"):
        monkeypatch.setattr(f"calibration.detector.posterior.{name}", lambda *_: None)
    with pytest.raises(ValueError, match="raw frames"):
        sample_posterior([levels])


def test_a_chain_gives_the_same_posterior_where_importance_samples_fail(monkeypatch):
    electrons = np.random.default_rng(5).gamma(1.2, 12.0, 5_000)
    levels = collect_levels([readings(np.random.default_rng(6), electrons)])
    drawn = sample_posterior([levels], offset=(100.0, 0.1))
    monkeypatch.setattr("calibration.detector.posterior.importance_sample", lambda *_: None)
    chain = sample_posterior([levels], offset=(100.0, 0.1))
    width = drawn.samples.std(axis=0)
    assert np.abs(chain.samples.mean(axis=0) - drawn.samples.mean(axis=0)) / width == pytest.approx(0, abs=0.2)
    assert chain.samples.std(axis=0) / width == pytest.approx(1, abs=0.15)
    assert chain.effective > 400
    assert chain.rhat < 1.05


def test_a_local_maximum_is_left_for_a_likelier_sample():
    generator = np.random.default_rng(3)
    one = cells(generator, generator.gamma(4.0, 3.0, 30_000), gain=8.0, read_noise=0.25)
    levels = [collect_cells([one], guess=(8.7, 104.0, 0.5))]
    found = sample_posterior(levels, start=(8.7, 104.0, 0.5))
    assert found.most_likely == pytest.approx([8.0, 100.0, 0.25], rel=0.05)


def test_dark_frames_fix_offset_and_read_noise():
    generator = np.random.default_rng(9)
    scene = textured_scene(generator, 128)
    pair = expose(scene, rigid(0, (0, 0), 128), 128, generator, electrons=200.0, read_noise=3.0)
    dark = Burst(np.round(100 + 2 * 3.0 * generator.standard_normal((6, 128, 128))))
    offset, error = level_of(dark).known
    assert offset == pytest.approx(100, abs=4 * error)
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    found = measure_detector([align_pair(ExposurePair(pair.short, pair.long), still)], dark=dark).posterior
    assert found.read_noise.median == pytest.approx(3.0, rel=0.05)
    assert found.gain.median == pytest.approx(2.0, rel=0.05)
    assert found.read_noise.q95 / found.read_noise.q05 < 1.15


@pytest.mark.parametrize("noise", [0.15, 0.25, 0.4, 1.0])
def test_the_error_of_the_mean_of_dark_frames_contains_the_shift_by_rounding(noise):
    """Two codes have a variance of a quarter where the mean is between them, however little noise there is."""
    generator = np.random.default_rng(0)
    for place in np.linspace(-0.5, 0.5, 41):
        frames = np.round(generator.normal(100 + place, noise, (4, 64, 64)))
        mean, error = level_of(Burst(frames, calibration=True), step=1.0).known
        assert abs(mean - 100 - place) < 3 * error


def cells(generator, rate, *, read_noise, offset=OFFSET, gain=GAIN, ratio=16, low=-np.inf, high=np.inf):
    """Rounded and clipped readings beside signals from a longer exposure of the same detector."""

    def draw(times):
        electrons = generator.poisson(rate * times) + read_noise * generator.standard_normal(rate.shape)
        return np.round(offset + gain * electrons)

    scale = Scale(0, 1 / ratio, offset * (1 - 1 / ratio), offset + gain * float(rate.mean()), common_offset=True)
    signal = offset + (draw(ratio) - offset) / ratio
    shares = (1 / ratio, 1 / ratio**2)
    return Readings(draw(1).clip(low, high), signal, signal, *shares, 1.0, 1.0, 0.0, rails=(low, high), scale=scale)


def test_the_integral_over_scalings_does_not_depend_on_the_one_it_starts_from():
    """Rounding shifts the mean of all values by up to half a step if gain and step agree: their signals are uncertain by that."""
    generator = np.random.default_rng(0)
    one = cells(generator, generator.gamma(4.0, 2.0, 40_000), read_noise=0.4, gain=1.0, offset=100.0)
    one = replace(one, scale=replace(one.scale, common_offset=False))
    right = collect_cells([one], guess=(1.0, 100.0, 0.4))
    shifted = right.rescaled({0: (1.0, 0.3)})
    other = collect_levels([replace(one, scale=replace(one.scale, pair=1))])  # of another pair
    detector = np.array([[1.0], [100.0], [0.4]])
    values = [DetectorLikelihood([each, other])(*detector).item() for each in (right, shifted)]
    assert values[1] == pytest.approx(values[0], abs=0.5)


@pytest.mark.parametrize(("gain", "read_noise", "low"), [(0.6, 0.3, 0.0), (2.0, 0.25, 95.0), (5.0, 4.0, 100.0)])
def test_cells_of_rounded_and_clipped_readings_have_the_masses_of_the_mixture(gain, read_noise, low):
    generator = np.random.default_rng(0)
    rate = generator.gamma(4.0, 1.5, 40_000)
    one = cells(generator, rate, read_noise=read_noise, gain=gain, low=low)
    levels = collect_cells([one], guess=(gain, OFFSET, read_noise))
    mass = LevelMasses(levels).masses(np.array([gain]), np.array([OFFSET]), np.array([read_noise]))[0]
    counts = np.arange(200)
    own = gain * (levels.signal - OFFSET) / 16 + (gain * read_noise / 16) ** 2
    for level in (0, 3):
        mean = (levels.signal + levels.shift * own / levels.own - OFFSET)[level] / gain
        variance = (levels.spread + levels.excess * own)[level] / gain**2
        electrons = stats.nbinom.pmf(counts, mean**2 / variance, 1 / (1 + variance / mean))
        edges = levels.origin[level] + levels.width[level] * np.arange(mass.shape[1] + 1)
        edges = np.where(edges < low, -np.inf, edges)
        below = stats.norm.cdf((edges[:, None] - OFFSET - gain * counts) / (gain * read_noise)) @ electrons
        np.testing.assert_allclose(mass[level], np.diff(below), atol=3e-8)


def test_true_moments_behind_noisy_estimates_match_those_counted():
    generator = np.random.default_rng(1)
    truth = generator.gamma(3.0, 2.0, 4_000_000)
    estimate = generator.poisson(16 * truth) / 16 + 0.1 * generator.standard_normal(truth.shape)
    edges = np.linspace(-1, 40, 41 * 32 + 1)
    grid = 0.5 * (edges[1:] + edges[:-1])
    density = np.histogram(estimate, edges)[0] / 1.0
    _, first, second = true_moments(grid, ndimage.gaussian_filter1d(density, 1.0), 1 / 16, 0.1**2)
    for low, high in ((1.0, 2.0), (5.0, 6.0), (11.0, 13.0)):
        inside, place = (estimate >= low) & (estimate < high), (grid >= low) & (grid < high)
        assert first[place].sum() / density[place].sum() == pytest.approx(truth[inside].mean(), rel=4e-3)
        assert second[place].sum() / density[place].sum() == pytest.approx((truth[inside] ** 2).mean(), rel=8e-3)


@pytest.mark.parametrize(
    ("gain", "read_noise", "offset", "electrons"),
    [(0.65, 0.36, 100.0, 2.5), (2.4, 7.5, 0.0, 5.5), (14.0, 0.26, 0.0, 4.0)],
)
def test_rounding_clipping_and_single_electrons_leave_no_bias(gain, read_noise, offset, electrons):
    generator = np.random.default_rng(6)
    rate = electrons * np.exp(0.7 * generator.standard_normal(60_000) - 0.25)
    one = cells(generator, rate, read_noise=read_noise, gain=gain, offset=offset, low=0.0)
    levels = [collect_cells([one], guess=(gain, offset, read_noise))]
    found = sample_posterior(levels)
    for interval, truth in ((found.gain, gain), (found.offset, offset), (found.read_noise, read_noise)):
        deviation = (interval.q95 - interval.q05) / 3.29
        assert abs(interval.median - truth) < 3 * deviation
    assert misfit(found.levels, found.most_likely) == pytest.approx(1, abs=0.3)


def test_clipped_readings_count_as_clipped():
    generator = np.random.default_rng(4)
    scene = textured_scene(generator, 160)
    pair = expose(scene, rigid(0, (0, 0), 160), 160, generator, electrons=20.0, read_noise=8.0, offset=0.0)
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    short = pair.short.clip(0)
    assert np.mean(short == 0) > 0.02
    found = measure_detector([align_pair(ExposurePair(short, pair.long, 16.0), still)]).posterior
    for interval, truth in ((found.gain, 2.0), (found.offset, 0.0), (found.read_noise, 8.0)):
        deviation = (interval.q95 - interval.q05) / 3.29
        assert abs(interval.median - truth) < 3 * deviation


def test_a_mean_of_frames_as_the_long_exposure_tells_no_offset_but_the_gain():
    generator = np.random.default_rng(8)
    dose = 40 * np.exp(0.6 * ndimage.gaussian_filter(generator.standard_normal((160, 160)), 3) * 10)
    read = [
        np.round(100 + 2.0 * (generator.poisson(dose) + 3 * generator.standard_normal(dose.shape))) for _ in range(17)
    ]
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    pair = align_pair(ExposurePair(read[0], np.mean(read[1:], axis=0), 16.0), still)
    assert not pair.one_setting
    assert measure_detector([pair]).posterior.gain.median == pytest.approx(2.0, rel=0.06)


def test_a_signal_known_without_noise_is_no_special_case():
    generator = np.random.default_rng(9)
    rate = 10 * np.exp(0.6 * generator.standard_normal(40_000))
    observation = np.round(
        OFFSET + GAIN * (generator.poisson(rate) + READ_NOISE * generator.standard_normal(rate.shape))
    )
    signal = OFFSET + GAIN * rate
    known = Readings(
        observation, signal, signal, 0.0, 0.0, 1.0, 1.0, 0.0, scale=Scale(0, 1.0, 0.0, float(signal.mean()))
    )
    found = sample_posterior([collect_cells([known], guess=(GAIN, OFFSET, READ_NOISE))])
    assert found.gain.median == pytest.approx(GAIN, rel=0.05)


def test_pairs_some_of_few_and_some_of_many_electrons_are_measured_together():
    pairs = []
    for number, electrons in enumerate((2.0, 4000.0)):
        generator = np.random.default_rng(number)
        scene = textured_scene(generator, 128)
        pair = expose(scene, rigid(0, (0, 0), 128), 128, generator, electrons=electrons)
        still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
        pairs.append(align_pair(ExposurePair(pair.short, pair.long, 16.0), still))
    assert measure_detector(pairs).posterior.gain.median == pytest.approx(GAIN, rel=0.06)


@pytest.mark.parametrize("frames", [2, 3, 6])
def test_misfit_of_a_burst_is_one_though_its_residuals_share_their_mean(frames):
    found = []
    for seed in range(4):
        generator = np.random.default_rng(seed)
        scene = random_scene(generator, 128)
        burst = np.stack([exposed(generator, scene) for _ in range(frames)])
        pairs, _ = align_burst(Burst(burst))
        readings = pooled([one for number, pair in enumerate(pairs) for one in readings_of(pair, number)[0]])
        levels = [collect_levels(readings)]
        found.append(misfit(levels, sample_posterior(levels).most_likely))
    assert np.mean(found) == pytest.approx(1, abs=0.1)


def test_a_gain_that_cannot_be_told_from_none_is_refused():
    generator = np.random.default_rng(1)
    dose = 2.4 * np.exp(
        0.8 * (lambda x: x / x.std())(ndimage.gaussian_filter(generator.standard_normal((192, 192)), 4))
    )
    short = 100 + generator.normal(3.3 * dose, 25.0)  # the noise does not depend on the signal at all
    long = 100 + generator.normal(16 * 3.3 * dose, 25.0)
    pair = ExposurePair(np.round(short), np.round(long))
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 99.0, False)
    with pytest.raises(NotMeasurable, match="gain"):
        measure_detector([align_pair(pair, still)])


@pytest.mark.parametrize("long_gain", [GAIN, GAIN / 8])
def test_share_of_the_signals_noise_is_that_of_one_setting_only_where_it_agrees(long_gain):
    generator = np.random.default_rng(8)
    scene = random_scene(generator, 160)
    short = exposed(generator, scene, gain=GAIN, offset=100.0, read_noise=1.5)
    long = exposed(generator, 16 * scene, gain=long_gain, offset=100.0, read_noise=1.5)
    shot, read = _shares(align_pair(ExposurePair(short, long)))
    if long_gain == GAIN:
        assert (shot, read) == pytest.approx((1 / 16, 1 / 256), rel=0.05)
    else:  # the exposures' scale is a half, the noise that of 16 times the electrons
        assert shot == pytest.approx(1 / 16, rel=0.25)


def test_offset_of_a_pair_alone_lies_below_its_darkest_pixels():
    generator = np.random.default_rng(165)
    scene = random_scene(generator, 128, mean=42.0)
    setting = {"gain": 1.72, "offset": 100.0, "read_noise": 4.08}
    pair = align_pair(ExposurePair(*(exposed(generator, electrons, **setting) for electrons in (scene, 16 * scene))))
    found = readings_of(pair)[0][0]
    darkest, error = found.darkest()
    lowest = np.sort(100 + 1.72 * scene, axis=None)
    assert lowest[:64].mean() < darkest < lowest[:512].mean()
    density = LogPosterior([collect_levels([found])])
    gain, read_noise = 1.72, 4.08
    levels = replace(density.levels[0], darkest=np.full_like(density.levels[0].darkest, np.inf))
    without = LogPosterior([levels])
    above, below = (density.coordinates(gain, darkest + side * error, read_noise) for side in (4.0, -4.0))
    assert density(below) == pytest.approx(without(below))
    assert without(above) - density(above) == pytest.approx(8.0, rel=0.01)
    assert measure_detector([pair]).posterior.offset.q95 < darkest + 2 * error


def test_frames_of_a_burst_share_their_histograms_and_even_pixels_raise_no_alarm():
    generator = np.random.default_rng(1)
    frames = Burst(np.stack([exposed(generator, np.full((44, 52), 200.0)) for _ in range(40)]))
    pairs, _ = align_burst(frames)
    assert unevenness(pairs) == 0.0
    readings = pooled([one for number, pair in enumerate(pairs) for one in readings_of(pair, number)[0]])
    assert len(readings) == 1
    levels = collect_levels(readings)
    assert levels.count.sum() == pytest.approx(40 * 44 * 52, rel=1e-3)
    assert len(levels.signal) <= 16


def test_models_of_a_large_exposure_are_judged_by_whole_blocks_of_it():
    side = 8 * math.isqrt(2 * MOST_BLOCKS)
    generator = np.random.default_rng(0)
    scene = random_scene(generator, side)
    still = Registration(np.eye(2, 3), "translation", "sift", 0, 0, 0.0, 0.0, 0.0, False)
    kept = collect_pixels([align_pair(ExposurePair(exposed(generator, scene), exposed(generator, 16 * scene)), still)])
    assert len(np.unique(kept.block)) == MOST_BLOCKS
    assert len(kept.signal) == pytest.approx(64 * MOST_BLOCKS, rel=0.02)
    assert kept.held_out.mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("known", [True, False])
def test_the_gain_of_a_pair_alone_has_an_interval_that_holds_photon_transfers(known):
    generator = np.random.default_rng(6)
    scene = random_scene(generator, 128)
    short, long = exposed(generator, scene), exposed(generator, 16 * scene)
    pair = align_pair(ExposurePair(short, long, 16.0 if known else None))
    detector = measure_detector([pair])
    line = detector.line
    low, high = line.gain - 1.6 * line.gain_error, line.gain + 1.6 * line.gain_error
    clear = figures_of(detector, correlation_of([pair]), Repairs())
    assert clear.linear.median == detector.posterior.gain.median
    assert clear.gain.q05 < clear.linear.q05 < clear.linear.q95 < clear.gain.q95  # the exponent of the response
    if known:
        assert clear.linear == detector.posterior.gain
    else:
        assert clear.linear.q05 < low < high < clear.linear.q95


def test_a_few_pixels_beside_many_that_fill_no_level_are_left_out():
    generator = np.random.default_rng(7)
    electrons = generator.uniform(50, 400, 20_000)
    few = replace(readings(generator, electrons[:60], step=1.0), scale=Scale(0, 1.0, 0.0, 300.0))
    with pytest.raises(NotMeasurable, match="too few pixels of each brightness"):
        collect_cells([few], guess=(GAIN, OFFSET, READ_NOISE))


def test_levels_chosen_by_noisy_signals_have_the_line_of_the_detector():
    generator = np.random.default_rng(117)
    scene = random_scene(generator, 200, mean=8.0, contrast=0.3)
    setting = {"gain": 8.0, "offset": 400.0, "read_noise": 1.5}
    pair = ExposurePair(*(exposed(generator, times * scene, **setting) for times in (1, 4)))
    line = measure_detector([align_pair(pair)]).line
    assert abs(line.gain - 8.0) < 3 * line.gain_error
    assert line.gain_error < 0.6


def test_exposures_of_a_large_dark_scene_are_of_one_setting() -> None:
    generator = np.random.default_rng(2)
    y, x = np.mgrid[:1024, :1024]
    scene = np.full((1024, 1024), 0.6)
    for _ in range(300):  # cells on a dark background
        (row, column), radius = generator.random(2) * 1024, generator.uniform(4, 12)
        near = (slice(max(0, int(row) - 30), int(row) + 30), slice(max(0, int(column) - 30), int(column) + 30))
        scene[near] += generator.uniform(10, 40) * np.exp(
            -((((y[near] - row) ** 2 + (x[near] - column) ** 2) / radius**2) ** 2)
        )
    pair = align_pair(ExposurePair(*(exposed(generator, times * scene, read_noise=1.6) for times in (1, 10))))
    assert pair.plain_ratio == pytest.approx(10, rel=0.01)
    shot, read = _shares(pair)
    assert shot == pytest.approx(0.1, rel=0.02)
    assert read == pytest.approx(0.01, rel=0.02)
    other = exposed(generator, 10 * scene, gain=3.0)  # another setting
    assert align_pair(ExposurePair(pair.short, other)).plain_ratio is None


def test_clipped_darkness_bends_no_line_and_is_no_peak_of_single_electrons():
    """A sixth of the values is 0; only three of the levels hold none."""
    generator = np.random.default_rng(5)
    one = cells(generator, generator.gamma(2.0, 2.0, 60_000), read_noise=3.0, offset=1.0, low=0.0)
    levels, truth = [collect_cells([one], guess=(2.0, 1.0, 3.0))], np.array([2.0, 1.0, 3.0])
    assert levels[0].clipped().max() > 0.2
    assert not any(electrons_show(levels, gain) for gain in (2.1, 2.15, 2.2))
    line = fit_photon_transfer(levels, truth)
    assert abs(line.gain - 2.0) < 2 * line.gain_error < 0.2
    assert line.variance == pytest.approx(2 * (line.signal - 1) + 36, rel=0.1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_long_exposure_of_few_codes_leaves_no_comb_of_signals(seed):
    """With a third of a code of noise, the offset missed its interval by several widths, and histograms of sharper scenes did
    not fit."""
    generator = np.random.default_rng(seed)
    electrons = random_scene(generator, 160, mean=150.0)
    detector = {"gain": 0.03, "offset": 20.0, "read_noise": 10.0, "top": 255.0}
    pair = align_pair(ExposurePair(*(exposed(generator, times * electrons, **detector) for times in (1, 8))))
    found = measure_detector([pair])
    assert found.misfit < 1.1
    assert found.posterior.offset.q05 < 20 < found.posterior.offset.q95
    assert found.posterior.gain.q05 < 0.03 < found.posterior.gain.q95
