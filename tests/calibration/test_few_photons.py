"""Frames in which most pixels saw no photon, or one, are measured as others are, or refused for what they are."""

import numpy as np
import pytest

import calibration
from calibration.camera import calibrate_camera
from calibration.detector.correlation import contained_share
from calibration.detector.measure import measure_detector, photon_counter
from calibration.exposures.frames import blurred_step
from calibration.pipeline import measure_exposures
from calibration.registration.aligned import align_pair

from .simulators import GAIN, exposed, random_scene


def counted(photons: float, number: int) -> np.ndarray:
    """Frames of one scene of so many photons in its brightest pixels, without an offset or read noise."""
    generator = np.random.default_rng(7)
    scene = random_scene(generator, 128)
    return generator.poisson(photons * scene / scene.max(), (number, 128, 128)).astype(float)


def test_a_still_scene_of_few_photons_does_not_move():
    pairs, _ = calibration.align_burst(calibration.Burst(counted(0.7, 60)))
    assert pairs[0].counts.restless < 0.02 * pairs[0].short.size


@pytest.mark.parametrize("seed", [4, 24])
def test_offsets_without_lower_limit_do_not_outweigh_the_slope_of_a_small_pair(seed):
    generator = np.random.default_rng(seed)
    scene = random_scene(generator, 40, mean=50.0)
    short, long = (exposed(generator, times * scene, read_noise=6.0) for times in (1, 12))
    found = measure_exposures([calibration.ExposurePair(short, long)])
    assert found.verdict.grade == "good"
    assert found.figures.gain.q05 < 2 < found.figures.gain.q95


def test_the_gain_of_counted_photons_is_one_although_all_levels_hold_zeros():
    generator = np.random.default_rng(8)
    scene = random_scene(generator, 192)
    short, long = (generator.poisson(photons * scene / scene.max()).astype(float) for photons in (3, 60))
    assert np.mean(short == 0) > 0.01
    detector = measure_detector([align_pair(calibration.ExposurePair(short, long))])
    assert not detector.response.bent
    assert detector.response.local(detector.posterior.gain).median == pytest.approx(1.0, rel=0.02)


def assert_counted(found):
    gain, offset, read_noise = found.figures.gain, found.figures.offset, found.figures.read_noise
    assert found.verdict.grade == "good"
    assert gain.median == pytest.approx(1.0, rel=0.002)
    assert 0.95 < gain.q05 < gain.q95 < 1.05
    assert offset.q05 < 0 < offset.q95
    assert read_noise.median < 0.2


@pytest.mark.parametrize(("photons", "times"), [(0.2, 20), (0.5, 16), (1.5, 10)])
def test_a_pair_of_counted_photons_has_gain_one(photons, times):
    generator = np.random.default_rng(1)
    scene = random_scene(generator, 192, mean=photons)
    pair = calibration.ExposurePair(*(generator.poisson(many * scene).astype(float) for many in (1, times)))
    assert_counted(measure_exposures([pair]))


def test_a_burst_of_counted_photons_has_gain_one():
    generator = np.random.default_rng(1)
    scene = random_scene(generator, 192, mean=0.7)
    assert_counted(measure_exposures(calibration.Burst(generator.poisson(scene, (8, 192, 192)).astype(float))))


@pytest.mark.parametrize(
    ("gain", "offset", "read_noise"), [(0.8, 0, 0), (1.2, 0, 0), (1, 0, 0.8), (1, 0.5, 0.4), (1, -1, 1.5)]
)
def test_whole_values_clipped_at_zero_that_scatter_more_or_less_count_no_photons(gain, offset, read_noise):
    generator = np.random.default_rng(3)
    scene = random_scene(generator, 192, mean=2.0)
    options = {"gain": gain, "offset": offset, "read_noise": read_noise}
    pair = align_pair(calibration.ExposurePair(*(exposed(generator, many * scene, **options) for many in (1, 16))))
    assert pair.short.min() == 0
    assert photon_counter([pair], 0) is None


def test_frames_of_two_values_are_refused_for_that():
    with pytest.raises(ValueError, match="only the values 0 and 1"):
        calibration.Burst(np.minimum(counted(0.7, 60), 1.0))
    short, long = counted(2.0, 2)
    for pair in ((short > 1, long), (short, 7 * (long > 1)), (short > 1, long > 3)):
        with pytest.raises(ValueError, match=r"only the values 0 and \d, as a mask"):
            calibration.ExposurePair(*pair)


@pytest.mark.parametrize("photons", [0.1, 1.0, 5.0])
def test_flats_of_counted_photons_are_not_clipped_and_have_gain_one(photons):
    generator = np.random.default_rng(3)
    levels = [generator.poisson(at, (6, 96, 96)).astype(float) for at in (0.002, photons, 2 * photons, 4 * photons)]
    dark, *flats = (calibration.Burst(frames, calibration=True) for frames in levels)
    found = calibrate_camera(flats, [dark])
    assert found.verdict.grade == "good"
    assert found.figures.gain.median == pytest.approx(1.0, rel=0.02)
    assert found.maps["defects"].mean() < 0.01


def test_the_posterior_of_a_black_background_has_no_peak_where_the_offset_meets_its_signal():
    """The expansion of the likelihood promised 20 nats there, and neither samples nor chains converged."""
    generator = np.random.default_rng([3, 0, 1449914930])
    generator.uniform(), generator.choice(3), generator.random()
    (y, x), light = np.mgrid[:192, :192], np.zeros((192, 192))
    for _ in range(generator.integers(25, 60)):
        (at_y, at_x), width = generator.uniform(0, 192, 2), generator.uniform(2, 9)
        height, turn, longer = generator.uniform(0.3, 1.5), generator.uniform(0, np.pi), generator.uniform(1, 3)
        along = ((x - at_x) * np.cos(turn) + (y - at_y) * np.sin(turn)) / width
        across = ((y - at_y) * np.cos(turn) - (x - at_x) * np.sin(turn)) / (width * longer)
        light += height / (1 + np.exp(4 * (np.hypot(along, across) - 1.5)))
    light *= 5.1535037385522955 / light.mean()
    options = {"gain": 0.3, "offset": 3.0, "read_noise": 2.0}
    found = measure_exposures([calibration.ExposurePair(*(exposed(generator, t * light, **options) for t in (1, 16)))])
    assert found.figures.gain.q05 < 0.3 < found.figures.gain.q95
    assert found.detector.posterior.num_draws < 3000


def test_offsets_of_pixels_that_both_exposures_share_leave_the_gain_of_dark_scenes_right():
    errors = []
    for seed in (1, 2, 3):  # 3 % too low by the values of pixels with few electrons
        generator = np.random.default_rng(seed)
        scene = random_scene(generator, 320, mean=4.0, contrast=0.9)
        options = {"offset": 100 + 3 * generator.standard_normal(scene.shape), "read_noise": 1.6}
        exposures = (exposed(generator, times * scene, **options) for times in (1, 16))
        found = measure_exposures([calibration.ExposurePair(*exposures, exposure_ratio=16.0)])
        assert found.verdict.grade == "good"
        errors.append(found.figures.gain.median / GAIN - 1)
    assert np.mean(errors) == pytest.approx(0, abs=0.012)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_dim_short_exposure_is_seen_in_the_long_one_though_registration_scatters(seed):
    generator = np.random.default_rng(seed)
    scene = random_scene(generator, 160, mean=3.0, contrast=1.2)
    frames = [exposed(generator, scene) for _ in range(6)]
    assert contained_share(align_pair(calibration.ExposurePair(frames[0], np.sum(frames, axis=0)))) > 0.15
    assert contained_share(align_pair(calibration.ExposurePair(frames[0], np.sum(frames[1:], axis=0)))) == 0


@pytest.mark.parametrize(("gain", "offset", "read_noise"), [(1.0, 0.0, 0.0), (0.5, 100.0, 2.0)])
def test_codes_divided_by_a_gain_reference_are_seen_near_0(gain, offset, read_noise):
    generator = np.random.default_rng(5)
    scene, reference = random_scene(generator, 192, mean=20.0), generator.normal(1, 0.04, (192, 192))
    options = {"gain": gain, "offset": offset, "read_noise": read_noise}
    short, long = ((exposed(generator, t * scene * reference, **options) - offset) / reference for t in (1, 8))
    found = measure_exposures([calibration.ExposurePair(short, long)])
    assert found.verdict.grade == "good"
    assert found.figures.source == "posterior"
    assert found.figures.gain.q05 < gain < found.figures.gain.q95
    assert blurred_step(short) == pytest.approx(1, rel=0.01)
    smooth = generator.normal(0, 3, short.shape)
    assert blurred_step(np.where(np.abs(smooth) < 1, 0, smooth)) == blurred_step(smooth.clip(0)) == 0
