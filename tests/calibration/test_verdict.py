"""No figure is wrong without a flag, and clean exposures raise none."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from calibration.detector.correlation import (
    contained_share,
    correlation_in_time,
    correlation_of,
    correlation_of_residuals,
)
from calibration.detector.log_posterior import LogPosterior, by_whole_electrons
from calibration.detector.shape import uneven_codes, unevenness
from calibration.exposures.frames import Burst, ExposurePair
from calibration.exposures.processing import block_compressed, coarser_above, wavelet_compressed
from calibration.pipeline import measure_exposures
from calibration.registration.aligned import Residual, align_pair
from calibration.registration.bursts import align_burst

from . import simulators as sim
from .sabotage import CASES, corner_full, counting_photons, joined, jpeg2000


def measured(case):
    options = dict(case.options)
    dark = options.pop("dark", None)
    exposures = Burst(case.short) if case.long is None else [ExposurePair(case.short, case.long, **options)]
    return measure_exposures(exposures, dark=None if dark is None else Burst(dark, calibration=True))


def test_a_clean_pair_is_good_and_right():
    found = measured(CASES["clean, ratio known"](11))
    assert (found.verdict.grade, found.verdict.subjects) == ("good", ())
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.04)


@pytest.mark.parametrize(
    ("name", "reason", "tolerance"),
    [
        ("afterglow 0.35 along x", "correlated pixels", 0.06),
        ("both Gaussian-filtered, 0.4", "correlated pixels", 0.06),
        ("row offsets of 12", "row offsets", 0.04),
        ("4 % of the area moved", "scene changed", 0.05),
        ("long blurred, 0.7 pixels", "scene misfit", 0.06),
        ("illumination changed across the field", "scene misfit", 0.09),
        ("both resampled × 0.8", "periodic noise", 0.1),
        ("both resampled × 0.8, cubic", "periodic noise", None),
        ("both compressed (DCT)", "compressed", None),
        ("long drifted by 2 pixels", "scene misfit", 0.06),
        ("divided by a flat field", "uneven field", 0.08),
        ("JPEG, quality 75", "compressed", None),
        ("mains hum, 7.3 rows", "row offsets", 0.04),
    ],
)
def test_what_is_wrong_is_flagged_and_modelled_where_it_can_be(name, reason, tolerance):
    found = measured(CASES[name](12))
    assert found.verdict.grade != "good"
    assert reason in [one.reason for one in found.verdict.findings]
    if tolerance is not None:
        assert found.figures.gain.median == pytest.approx(2.0, rel=tolerance)


@pytest.mark.slow
def test_a_long_exposure_saturated_in_a_corner_does_not_mislead_the_registration():
    held = 0
    for seed in range(1, 7):
        found = measured(sim.pair(seed, corner_full))
        assert found.verdict.grade == "good"
        assert found.pairs[0].registration.error_px < 0.03
        assert found.figures.gain.median == pytest.approx(2.0, rel=0.04)
        held += found.figures.gain.q05 < 2.0 < found.figures.gain.q95
    assert held >= 5  # of 90 % intervals


def test_excess_noise_is_flagged_and_photon_transfer_gives_the_product():
    found = measured(CASES["EMCCD, gain × F² 150, darks"](13))
    assert found.verdict.grade != "good"
    assert found.figures.source == "photon transfer"
    assert found.figures.gain.median == pytest.approx(150, rel=0.06)
    assert found.figures.offset.median == pytest.approx(500, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
@pytest.mark.parametrize("seed", [21, 22])
def test_every_case_is_right_or_flagged(name, seed):
    case = CASES[name](seed)
    if name == "gamma-encoded":  # nothing in it is Poisson-Gaussian: either way of saying so will do
        with contextlib.suppress(ValueError):
            assert measured(case).verdict.grade == "bad"
        return
    if name == "exposures swapped":
        with pytest.raises(ValueError, match="exchange the two"):
            measured(case)
        return
    found = measured(case)
    if found.figures is None:
        assert found.verdict.grade == "bad"
        return
    if found.verdict.grade == "good":
        assert found.figures.gain.median == pytest.approx(case.gain, rel=0.04)  # 2 % and its own error
    else:
        serious = {one.reason for one in found.verdict.findings}
        assert not (case.clean and serious)


def test_a_narrow_filter_s_correlation_is_added_up_to_the_lag_that_noise_hides():
    point, factors = ndimage.gaussian_filter(np.pad(np.ones((1, 1)), 12), 0.5), []
    for seed in range(4):
        z = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((240, 240)), 0.5)
        residual = Residual(z / z.std(), np.ones(z.shape, bool), 0.0, np.ones(z.shape))
        factors.append(correlation_of_residuals([residual]).factor)
    assert np.mean(factors) == pytest.approx(1 / np.sum(point**2), rel=0.025)


def test_factor_of_a_known_filter_is_its_variance_loss():
    generator = np.random.default_rng(0)
    noise = generator.standard_normal((400, 400))
    filtered = 0.7 * noise + 0.3 * np.roll(noise, 1, axis=1)
    z = filtered / filtered.std()
    found = correlation_of_residuals([Residual(z, np.ones(z.shape, bool), 0.0, np.ones(z.shape))])
    assert found.found
    assert found.local
    assert found.factor == pytest.approx(1 / (0.7**2 + 0.3**2), rel=0.02)
    assert found.at(0, 1) == pytest.approx(0.21 / 0.58, abs=0.01)


def test_white_noise_has_no_correlation_and_no_period():
    z = np.random.default_rng(1).standard_normal((300, 500))
    found = correlation_of_residuals([Residual(z, np.ones(z.shape, bool), 0.0, np.ones(z.shape))])
    assert not found.found
    assert found.factor == 1
    assert found.period == 0


def test_only_a_compressed_frame_is_called_so():
    assert block_compressed(CASES["both compressed (DCT)"](5).short)
    assert not block_compressed(CASES["clean"](5).short)
    assert not block_compressed(CASES["both Gaussian-filtered, 0.8"](5).short)


@pytest.mark.parametrize("side", [8, 16, 23, 32, 48])
def test_few_blocks_of_noise_do_not_look_compressed(side: int) -> None:
    generator = np.random.default_rng(side)
    flats = (np.round(100 + 2 * generator.poisson(mean, (side, side))) for mean in (3, 50, 2000) for _ in range(8))
    assert not any(map(block_compressed, flats))


# single electrons two codes apart fit the others as well, after ten seconds
@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (4, 6))])
def test_a_comb_of_codes_is_flagged_as_such_and_does_not_make_the_figures_bad(seed):
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator, 128)
    short, long = sim.clean(generator, scene / 10)
    move = (short % 2 == 1) & (generator.random(short.shape) < 0.3)
    found = measure_exposures([ExposurePair(short + np.where(move, generator.choice([-1, 1], short.shape), 0), long)])
    assert "uneven codes" in [one.reason for one in found.verdict.findings]
    assert found.verdict.grade == "doubtful"
    assert found.detector.misfit < 1.3
    even = measure_exposures([ExposurePair(short, long)])
    assert "uneven codes" not in [one.reason for one in even.verdict.findings]
    electrons = np.array([2.0, 82.1, 0.2])  # two codes apart, with the variance of gain 2, offset 100 and read noise 3
    assert uneven_codes(found.detector.levels, electrons) > 0 == uneven_codes(even.detector.levels, electrons)


def test_uneven_pixels_are_seen_in_a_burst():
    generator = np.random.default_rng(3)
    scene = sim.random_scene(generator, 128)
    uneven = measure_exposures(Burst(sim.scmos(generator, scene, 6)))
    assert "uneven pixels" in [one.reason for one in uneven.verdict.findings]
    even = measure_exposures(Burst(np.stack([sim.exposed(generator, scene) for _ in range(6)])))
    assert "uneven pixels" not in [one.reason for one in even.verdict.findings]


def test_darks_brighter_than_the_exposures_are_refused_in_one_line():
    generator = np.random.default_rng(4)
    scene = sim.random_scene(generator, 64)
    dark = Burst(np.stack([sim.exposed(generator, 0 * scene, offset=5000.0) for _ in range(3)]), calibration=True)
    with pytest.raises(ValueError, match="brighter"):
        measure_exposures([ExposurePair(sim.exposed(generator, scene), sim.exposed(generator, 16 * scene))], dark=dark)


def test_frames_that_follow_one_another_are_flagged_and_independent_ones_are_not():
    generator = np.random.default_rng(6)
    electrons = generator.poisson(sim.random_scene(generator, 128), (9, 128, 128)).astype(float)
    lagging = 0.9 * electrons[1:] + 0.1 * electrons[:-1]
    lagging, free = (np.round(100 + 2 * one + generator.normal(0, 4, one.shape)) for one in (lagging, electrons))
    found = measure_exposures(Burst(lagging))
    assert ("frames correlated", True) in [(one.reason, one.bad) for one in found.verdict.findings]
    lag = 0.09 * 80 / (0.82 * 80 + 4)  # of 80 electrons: shot noise and a read noise of 2 electrons
    assert correlation_in_time(found.pairs)[0] == pytest.approx(lag, rel=0.1)
    value, error = correlation_in_time(align_burst(Burst(free))[0])
    assert abs(value) < 4 * error


def test_dark_frames_show_the_temporal_filter_that_a_pair_hides():
    generator = np.random.default_rng(7)
    scene = sim.random_scene(generator, 128)

    def last(electrons, number, kept):
        frames = [sim.exposed(generator, electrons) for _ in range(12)]
        for index in range(1, 12):
            frames[index] = (1 - kept) * frames[index] + kept * frames[index - 1]
        return np.round(frames[-number:])

    for kept in (0.0, 0.33):
        (short,), (long,), dark = (last(*one, kept) for one in ((scene, 1), (8 * scene, 1), (0 * scene, 4)))
        found = measure_exposures([ExposurePair(short, long)], dark=Burst(dark, calibration=True)).verdict
        assert (("frames correlated", True) in [(one.reason, one.bad) for one in found.findings]) == (kept > 0)


def test_a_long_exposure_that_contains_the_short_one_is_flagged():
    generator = np.random.default_rng(7)
    scene = sim.random_scene(generator)
    frames = [sim.exposed(generator, scene) for _ in range(9)]
    for long in (np.sum(frames[:8], axis=0), np.mean(frames[:8], axis=0)):
        found = measure_exposures([ExposurePair(frames[0], long)])
        assert ("short contained", True) in [(one.reason, one.bad) for one in found.verdict.findings]
        assert contained_share(found.pairs[0]) == pytest.approx(1 / 8, rel=0.1)
        assert contained_share(align_pair(ExposurePair(frames[8], long))) == 0


def test_sensitivities_of_pixels_and_sharp_scenes_are_no_contained_exposure():
    generator = np.random.default_rng(8)
    scene = sim.random_scene(generator)
    uneven = scene * generator.normal(1.0, 0.05, scene.shape)
    for electrons, ratio in ((uneven, 16), (uneven, 300), (scene, 300)):
        short, long = sim.exposed(generator, electrons), sim.exposed(generator, ratio * electrons)
        assert contained_share(align_pair(ExposurePair(short, long))) == 0


def test_compression_of_the_long_exposure_alone_is_flagged():
    cv2 = pytest.importorskip("cv2")
    generator = np.random.default_rng(9)
    scene = sim.random_scene(generator, mean=30.0)
    long = sim.exposed(generator, 16 * scene, gain=0.1, offset=10.0).clip(0, 255).astype(np.uint8)
    stored = cv2.imdecode(cv2.imencode(".jpg", long, [cv2.IMWRITE_JPEG_QUALITY, 80])[1], cv2.IMREAD_GRAYSCALE)
    reasons = measure_exposures([ExposurePair(sim.exposed(generator, scene), stored)]).verdict.findings
    assert [one.name for one in reasons if one.reason == "compressed"] == ["compression of the long exposure"]


def test_single_electrons_tell_the_gain_to_a_thousandth():
    found = measured(CASES["single electrons resolved"](32))
    assert found.verdict.subjects == ()
    assert found.detector.electrons
    found = found.figures
    assert found.gain.median == pytest.approx(8.0, rel=2e-3)
    assert found.offset.median == pytest.approx(100.0, abs=0.2)
    assert found.read_noise.median == pytest.approx(0.27, rel=0.05)


def test_a_burst_of_single_electrons_is_good():  # it has only residuals, which blur them
    found = measured(CASES["burst of 8, single electrons resolved"](31))
    assert (found.verdict.subjects, found.detector.electrons) == ((), False)


def test_the_peaks_of_ordinary_noise_are_not_single_electrons():
    assert not measured(CASES["clean, low dose"](33)).detector.electrons


@pytest.mark.parametrize(
    ("name", "gain"), [("burst of 10, 4 electrons", 2.0), ("burst of 8, noise as fine as the codes", 0.05)]
)
def test_skewed_or_coarse_noise_is_neither_correlated_nor_uneven(name, gain):
    found = measured(CASES[name](34))
    assert {one.reason for one in found.verdict.findings} == set()
    assert found.figures.gain.median == pytest.approx(gain, rel=0.06)


def test_a_burst_loses_no_noise_beside_saturated_pixels():
    generator = np.random.default_rng(35)
    electrons = np.broadcast_to(np.linspace(20, 300, 128), (128, 128))
    frames = np.stack([sim.exposed(generator, electrons, top=550.0) for _ in range(6)])
    pairs, _ = align_burst(Burst(frames))
    used = frames.mean(0)[pairs[0].mask]
    deviation = 2 * np.sqrt(225 + 9)  # counts, at the limit
    assert used.max() < 550 - 2.5 * deviation  # by the level, not by the pixels' own noise
    assert used.max() > 550 - 5 * deviation


def test_skewed_noise_of_independent_pixels_has_no_correlation():
    generator = np.random.default_rng(36)
    frames = generator.poisson(np.full((10, 192, 192), 1.5)).astype(float) * 4 + 100
    pairs, _ = align_burst(Burst(frames))
    assert not correlation_of(pairs).found


def test_converters_joined_in_one_frame_are_found_and_the_darker_pixels_measured():
    found = measured(CASES["two converters joined at 800 counts"](37))
    assert "joined converters" in [one.reason for one in found.verdict.findings]
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.06)
    most = measured(CASES["two converters joined at 300 counts"](37))
    assert [one.bad for one in most.verdict.findings if one.reason == "joined converters"] == [True]


def test_codes_are_coarser_only_where_they_are():
    generator = np.random.default_rng(38)
    scene = sim.random_scene(generator)
    for case in (
        sim.exposed(generator, scene),
        16 * sim.exposed(generator, scene),
        sim.exposed(generator, scene, top=300.0),
    ):
        assert coarser_above(case) is None
    assert coarser_above(np.round(joined(500.0)(generator, scene))) == pytest.approx(500.0, abs=40)


@pytest.mark.parametrize("per_mille", [400, 300, 200])
def test_lossy_wavelet_compression_is_found_and_lossless_is_none(per_mille):
    generator = np.random.default_rng(per_mille)
    frame = sim.exposed(generator, sim.random_scene(generator))
    assert wavelet_compressed(jpeg2000(frame, per_mille))
    assert not wavelet_compressed(jpeg2000(frame, 1000))


def test_no_other_frame_passes_for_wavelet_compressed():
    for name in (
        "clean",
        "JPEG, quality 75",
        "both median-filtered 3 × 3",
        "two lowest bits missing",
        "both as square roots",
    ):
        assert not wavelet_compressed(CASES[name](39).short), name


def test_a_faint_blur_shows_in_all_neighbours_together():
    generator = np.random.default_rng(40)
    blurred = [ndimage.gaussian_filter(generator.standard_normal((256, 256)), 0.3) for _ in range(6)]
    mask = np.ones((256, 256), bool)
    residuals = [Residual(one / one.std(), mask, 0.0, np.ones_like(one)) for one in blurred]
    found = correlation_of_residuals(residuals)
    assert found.found
    assert found.factor == pytest.approx(1 / np.mean([one.var() for one in blurred]), abs=0.01)


def test_a_given_ratio_that_the_exposures_contradict_is_flagged():
    case = CASES["clean, ratio known"](41)
    right = measured(case)
    wrong = measured(replace(case, options={"exposure_ratio": 24.0}))
    assert "exposure ratio" not in [one.reason for one in right.verdict.findings]
    assert "exposure ratio" in [one.reason for one in wrong.verdict.findings]
    assert wrong.figures.gain.median == pytest.approx(2.0, rel=0.06)


def test_the_period_of_a_scene_is_none_of_the_noise():
    generator = np.random.default_rng(42)
    mosaic = sim.random_scene(generator) * np.tile([[1.0, 0.6], [0.6, 0.35]], (128, 128))  # of a colour camera
    found = measured(sim.Case(*(sim.exposed(generator, times * mosaic) for times in (1, sim.RATIO))))
    assert {one.reason for one in found.verdict.findings} == set()


def small_pair(size, seed):
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator, size)
    return sim.Case(*(sim.exposed(generator, times * scene) for times in (1, sim.RATIO)))


def test_a_pair_of_64_pixels_is_measured_and_only_uncertain():
    found = measured(small_pair(64, 43))
    assert [one.reason for one in found.verdict.findings] == []
    assert found.figures.gain.q05 < 2.0 < found.figures.gain.q95


def test_histograms_of_a_few_hundred_pixels_are_not_too_even():
    assert [one.reason for one in measured(small_pair(40, 7)).verdict.findings] == []


@pytest.mark.parametrize("burst", [True, False])
def test_saturation_and_compression_are_seen_behind_the_pattern_of_dark_frames(burst):
    generator = np.random.default_rng(44)
    scene = sim.random_scene(generator, 128)
    offset = 100 + 6 * generator.standard_normal(scene.shape)
    top = np.round(100 + 2 * np.percentile(scene, 97))
    shorts = np.stack([sim.exposed(generator, scene, offset=offset, top=top) for _ in range(5)])
    dark = np.stack([sim.exposed(generator, 0 * scene, offset=offset) for _ in range(8)])
    long = None if burst else sim.exposed(generator, sim.RATIO * scene, offset=offset)
    case = sim.Case(shorts if burst else shorts[0], long, {"dark": dark})
    found = measured(case)
    assert {one.reason for one in found.verdict.findings} == set()
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.05)
    coded = np.stack([jpeg2000(one, 300) for one in shorts])
    found = measured(replace(case, short=coded if burst else coded[0]))
    assert "compressed" in [one.reason for one in found.verdict.findings]


def test_an_offset_that_is_an_electron_off_is_moved_to_the_peak():
    detector = measured(CASES["single electrons resolved"](45)).detector
    log_posterior = LogPosterior(detector.levels, detector.offset)
    gain, offset, read_noise = detector.posterior.most_likely
    wrong = log_posterior.coordinates(gain, offset + 2 * gain, read_noise)[0]
    near, _ = by_whole_electrons(log_posterior, wrong, np.diag([0.03, 0.3 * np.exp(wrong[0]), 0.2]))
    found = log_posterior.parameters(near)[1].item()
    assert found == pytest.approx(offset, abs=0.1 * gain)


def test_pixels_of_no_light_are_not_uneven():
    generator = np.random.default_rng(46)
    scene = sim.random_scene(generator, 128, mean=2.0, contrast=1.0)
    pairs, _ = align_burst(Burst(np.stack([counting_photons(generator, 16 * scene) for _ in range(8)])))
    assert unevenness(pairs) == 0
