"""Faults that leave every histogram Poisson-Gaussian: they are measured, excluded or reported."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from scipy import ndimage, stats

import noiseflow
from calibration import verdict
from calibration.camera import calibrate_camera
from calibration.detector.emva import measure_camera
from calibration.detector.models import SIMPLE, collect_pixels
from calibration.detector.photon_transfer import _weighted_line
from calibration.detector.response import response_of
from calibration.exposures.frames import Burst, ExposurePair, read_burst
from calibration.exposures.masks import without_outliers
from calibration.exposures.scaling import groups_of
from calibration.pipeline import calibrate_exposures, measure_exposures

from . import simulators as sim
from .sabotage import CASES


def reasons(found):
    return {one.reason for one in found.verdict.findings}


def calibration_burst(frames):
    return Burst(np.stack(frames), calibration=True)


def bent(generator, electrons, power, *, around, before=False):
    """Pixel values of a response ∝ light^power with a local gain of 2·power counts per electron at `around` electrons.

    Read noise comes after the response, or `before` it.
    """
    noise = generator.standard_normal(electrons.shape)
    charge = np.maximum(generator.poisson(electrons) + 3 * noise * before, 0)
    return np.round(100 + 2 * around * (charge / around) ** power + 6 * noise * (not before))


@pytest.mark.parametrize("power", [0.9, 1.1])
def test_dark_frames_tell_the_exponent_of_the_response(power):
    generator = np.random.default_rng(1)
    scene = sim.random_scene(generator, 192)
    around = scene.mean()
    exposures = [ExposurePair(*(bent(generator, times * scene, power, around=around) for times in (1, 16)))]
    found = measure_exposures(exposures)  # the noise of the long exposure tells the exponent
    assert reasons(found) <= {"nonlinear response"}
    assert abs(found.detector.response.exponent - power) < 3 * found.detector.response.error < 0.15
    assert found.figures.gain.q05 < 2 * power < found.figures.gain.q95
    dark = calibration_burst([bent(generator, 0 * scene, power, around=around) for _ in range(4)])
    found = measure_exposures(exposures, dark=dark)
    assert reasons(found) == {"nonlinear response"}
    assert found.detector.response.exponent == pytest.approx(power, abs=4 * found.detector.response.error)
    assert found.figures.gain.median == pytest.approx(2 * power, rel=0.06)


@pytest.mark.parametrize("before", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("power", "known"), [(0.9, {"nonlinear response"}), (1.0, set())])
def test_the_noise_of_the_long_exposure_continues_the_curve_of_the_short_one(power, known, before):
    errors = []
    for seed in (3, 4, 5):  # of one pair, the gain scatters by 3 to 4.5 %
        generator = np.random.default_rng(seed)
        scene = sim.random_scene(generator)
        short, long = (bent(generator, times * scene, power, around=scene.mean(), before=before) for times in (1, 16))
        found = measure_exposures([ExposurePair(short, long)])
        gain = found.figures.gain
        assert reasons(found) == known
        assert gain.q05 < 2 * power < gain.q95 < 1.25 * gain.q05
        errors.append(abs(gain.median / (2 * power) - 1))
    assert np.mean(errors) < 0.06


@pytest.mark.parametrize("seed", [20, 24])
def test_a_long_exposure_that_may_be_of_another_setting_hides_no_bent_response(seed):
    generator = np.random.default_rng(seed)
    scene = sim.random_scene(generator, 128, mean=60.0)
    short, long = (bent(generator, times * scene, 0.85, around=scene.mean(), before=True) for times in (1, 40))
    found = measure_exposures([ExposurePair(short, long)])
    assert reasons(found) == {"nonlinear response"}
    assert found.figures.gain.q05 < 2 * 0.85 < found.figures.gain.q95


@pytest.mark.parametrize("seed", [2, 5])
def test_a_linear_response_leaves_the_gain_of_few_electrons_known(seed):
    case = CASES["clean, low dose"](seed)
    found = measure_exposures([ExposurePair(case.short, case.long)])
    assert reasons(found) == set()
    assert found.figures.gain.q05 < 2.0 < found.figures.gain.q95 < 1.5 * found.figures.gain.q05


def test_a_long_exposure_of_another_gain_says_nothing_of_the_exponent():
    generator = np.random.default_rng(11)
    scene = sim.random_scene(generator, 192)
    pair = ExposurePair(sim.exposed(generator, scene), sim.exposed(generator, 16 * scene, gain=sim.GAIN / 8))
    found = measure_exposures([pair])
    assert found.verdict.grade == "good"
    assert not found.detector.response.known
    assert found.figures.gain.q05 < sim.GAIN < found.figures.gain.q95


@pytest.mark.parametrize("power", [0.8, 0.9, 1.0, 1.2])
def test_variances_at_many_signals_restrict_the_exponent_of_the_response(power):
    generator = np.random.default_rng(9)
    electrons = np.linspace(20, 400, 16)
    signal = 100 + 2 * 80 * (electrons / 80) ** power
    variance = (power * (signal - 100) / electrons) ** 2 * electrons + 36
    error = 0.01 * variance
    found = response_of(signal, variance + error * generator.standard_normal(16), error)
    assert abs(found.exponent - power) < 3 * found.error
    assert found.error < 0.1
    assert not (power == 1.0 and found.bent)


def test_a_check_that_fails_loses_no_verdict(monkeypatch):
    generator = np.random.default_rng(10)
    frames = calibration_burst([sim.exposed(generator, np.full((64, 64), e)) for e in (100.0, 100.0)])
    bright = calibration_burst([sim.exposed(generator, np.full((64, 64), e)) for e in (900.0, 900.0)])
    names = [check.name for check in (*verdict.SCENES, *verdict.COMMON)]
    assert len(set(names)) == len(names)
    monkeypatch.setattr(verdict.CalibrationCase, "pattern", property(lambda case: 1 / 0))
    found = calibrate_camera([frames, bright]).verdict
    assert {"noise across the field", "classes of pixels"} <= set(found.not_tested)
    assert set(found.subjects) == {"no dark frames", "few levels"}


def test_a_linear_response_with_dark_frames_leaves_the_interval_narrow():
    generator = np.random.default_rng(2)
    scene = sim.random_scene(generator)
    dark = calibration_burst([sim.exposed(generator, 0 * scene) for _ in range(4)])
    found = measure_exposures([ExposurePair(*sim.clean(generator, scene))], dark=dark)
    gain = found.figures.gain
    assert (found.verdict.grade, found.detector.response.known) == ("good", True)
    assert gain.q95 - gain.q05 < 0.1 * gain.median


def test_flats_divided_by_their_shading_are_reported_and_shaded_ones_are_not():
    generator = np.random.default_rng(3)
    y, x = np.indices((128, 128)) / 127 - 0.5
    shading = 1 - 1.2 * (x**2 + y**2)

    def frames(electrons, by):
        values = [sim.exposed(generator, electrons * shading, rounded=False) for _ in range(3)]
        return calibration_burst([np.round(100 + (one - 100) / by) for one in values])

    levels = (100.0, 500.0, 2000.0)
    divided = calibrate_camera([frames(level, shading) for level in levels], [frames(0.0, shading)])
    assert "uneven field" in reasons(divided)
    shaded = calibrate_camera([frames(level, 1.0) for level in levels], [frames(0.0, 1.0)])
    assert shaded.verdict.grade == "good"
    assert shaded.figures.gain.median == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("of", [lambda y, x: x >= 64, lambda y, x: x % 2, lambda y, x: (y % 2 == 0) & (x % 2 == 0)])
def test_gains_of_halves_columns_and_mosaics_are_reported_by_class(of):
    generator = np.random.default_rng(4)
    scene = sim.random_scene(generator, 128)
    gain = np.where(of(*np.indices(scene.shape)), 2.5, 2.0)
    pair = measure_exposures([ExposurePair(*(sim.exposed(generator, t * scene, gain=gain) for t in (1, 16)))])
    flats = [
        calibration_burst([sim.exposed(generator, 0 * scene + e, gain=gain) for _ in range(3)])
        for e in (0, 100, 400, 900)
    ]
    camera = calibrate_camera(flats[1:], flats[:1])
    for found in (pair, camera):
        assert reasons(found) == {"uneven gains"}
        each = found.verdict.evidence["classes of pixels"]["what"].split("gains of ")[1].split(" counts")[0].split(", ")
        error = 0.03 if found is camera else 0.1  # that of the slope of a variance line of 4000 pixels
        assert (float(min(each)), float(max(each))) == pytest.approx((2.0, 2.5), rel=error)
    ratio = max(camera.figures.pattern.factors) / min(camera.figures.pattern.factors)
    assert ratio == pytest.approx(1.25, abs=0.06)


def test_cosmic_rays_are_excluded_and_counted():
    generator = np.random.default_rng(5)
    scene = sim.random_scene(generator)

    def struck(image):
        hit = generator.random(image.shape) < 1e-3
        return image + np.round(np.where(hit, 100 + generator.exponential(500, image.shape), 0))

    short, long = sim.clean(generator, scene)
    found = measure_exposures([ExposurePair(struck(short), long)])
    assert found.verdict.grade == "good"
    assert found.figures.linear.median == pytest.approx(2.0, rel=0.03)
    assert found.pairs[0].counts.outliers > 40
    level = np.full((96, 96), 1000.0)
    flats = [calibration_burst([struck(sim.exposed(generator, s * level)) for _ in range(2)]) for s in (0.1, 1.0)]
    dark = calibration_burst([sim.exposed(generator, 0 * level) for _ in range(4)])
    camera = measure_camera(flats, [dark])
    assert camera.gain.median == pytest.approx(2.0, rel=0.03)
    assert 20 < camera.outliers < 60


@pytest.mark.parametrize("shape", [(2, 64, 64), (6, 64, 64), (400, 3, 3)])
@pytest.mark.parametrize("electrons", [0.2, 5.0, 100.0])
def test_tails_of_noise_are_no_outliers(shape, electrons):
    generator = np.random.default_rng(6)
    frames = sim.exposed(generator, np.full(shape, electrons))
    again, number = without_outliers(frames)
    assert number <= 1
    assert again.var(axis=0).mean() == pytest.approx(frames.var(axis=0).mean(), rel=0.01)


def test_nine_pixels_of_an_emccd_have_its_excess_factor_and_no_correlation():
    generator = np.random.default_rng(7)

    def frames(electrons):
        level = np.full((3, 3), electrons)
        return calibration_burst(
            [sim.multiplied(generator, level, gain=100.0, offset=500.0, read=30.0) for _ in range(3000)]
        )

    found = calibrate_camera([frames(level) for level in (2.0, 5.0, 12.0, 25.0, 50.0, 100.0)], [frames(0.0)])
    assert found.verdict.grade == "good"
    assert found.figures.gain.median == pytest.approx(200.0, rel=0.03)
    assert found.figures.excess_factor.q05 < 2.0 < found.figures.excess_factor.q95
    assert found.figures.excess_factor.median == pytest.approx(2.0, abs=0.35)
    for electrons in (2.0, 5.0, 12.0):  # new frames and samples of the model have the same tails
        level = np.full((20_000, 3, 3), electrons)
        real = sim.multiplied(generator, level, gain=100.0, offset=500.0, read=30.0)
        signal = torch.full(level.shape, 500 + 100 * electrons)
        drawn = found.model(signal).sample(generator=torch.Generator().manual_seed(1)).numpy()
        assert stats.skew(drawn.ravel()) == pytest.approx(stats.skew(real.ravel()), rel=0.05)
        tails = (float(np.quantile(one, 0.999)) - float(one.mean()) for one in (drawn, real))
        assert next(tails) == pytest.approx(next(tails), rel=0.05)


@pytest.mark.parametrize("mosaic", [1.0, 0.6])
def test_offsets_of_rows_of_flats_are_subtracted_and_reported(mosaic: float) -> None:
    generator = np.random.default_rng(9)
    light = np.ones((96, 96))
    light[::2, ::2] = mosaic  # the filters of a Bayer pattern

    def frames(electrons: float, band: float) -> Burst:
        bands = band * generator.standard_normal((8, 96, 1))
        return calibration_burst([np.round(sim.exposed(generator, electrons * light) + one) for one in bands])

    found = calibrate_camera([frames(level, 5.0) for level in (300, 600, 1200)], [frames(0, 5.0)])
    assert reasons(found) == {"row offsets"}
    assert found.figures.rows == pytest.approx(5.0, rel=0.15)
    assert found.figures.columns == 0
    assert found.figures.gain.q05 < 2 < found.figures.gain.q95 < 2.1
    found = calibrate_camera([frames(level, 0.0) for level in (300, 600, 1200)], [frames(0, 0.0)])
    assert found.figures.rows == found.figures.columns == 0
    assert found.verdict.grade == "good"


def test_offsets_of_rows_that_show_in_darkness_only_make_flats_no_filtered_ones() -> None:
    generator = np.random.default_rng(1)

    def frames(electrons: float) -> Burst:
        bands = generator.standard_normal((8, 96, 1))
        return calibration_burst(
            [np.round(sim.exposed(generator, np.full((96, 96), electrons)) + one) for one in bands]
        )

    found = calibrate_camera([frames(level) for level in (300, 600, 1200, 2400)], [frames(0)])
    assert reasons(found) == {"row offsets"}
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.015)


@pytest.mark.parametrize("filters", [(0.9, 0.8), (0.6, 0.5)])
@pytest.mark.parametrize("shift", [0, 2])
def test_colour_filters_are_no_detail_of_the_scene_and_leave_the_gain_of_a_pair_right(filters, shift) -> None:
    generator = np.random.default_rng(0)
    scene, light = 2 * sim.random_scene(generator, 194), np.ones((192, 192))
    light[::2, ::2], light[1::2, 1::2] = filters  # a Bayer pattern
    long = slice(shift, 192 + shift)
    pair = ExposurePair(
        *(sim.exposed(generator, scale * light) for scale in (scene[:192, :192], 16 * scene[long, long]))
    )
    found = measure_exposures([pair])
    assert found.verdict.grade == "good"
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.04)


def test_light_that_changes_while_rows_of_a_mosaic_are_read_has_bands_in_proportion_to_its_filters() -> None:
    generator, row = np.random.default_rng(3), np.arange(96)[:, None]
    filters = np.where(row % 2, [[1.0, 0.7] * 48], [[0.5, 1.0] * 48])

    def frames(electrons: float) -> Burst:
        waves = [1 + 0.05 * np.sin(2 * np.pi * (row / 30 + phase)) for phase in generator.random(8)]
        return calibration_burst([np.round(sim.exposed(generator, electrons * filters * wave)) for wave in waves])

    found = calibrate_camera([frames(level) for level in (50, 200, 800, 2000)], [frames(0)])
    assert reasons(found) == {"row offsets"}
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.02)


def test_many_frames_of_nine_pixels_are_no_colour_image(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).poisson(100, (50, 3, 3)).astype(np.uint16)
    for name in ("flats.tif", "flats.npy"):
        noiseflow.io.write(tmp_path / name, frames)
        assert read_burst([tmp_path / name], calibration=True).frames.shape == frames.shape
    tifffile.imwrite(tmp_path / "tagged.tif", frames, photometric="rgb")  # as tifffile does by default
    with pytest.warns(UserWarning, match="tagged as colours"):
        found = read_burst([tmp_path / "tagged.tif"], calibration=True)
    assert np.array_equal(found.frames, frames)


def test_a_given_exposure_ratio_tells_the_exponent():
    generator = np.random.default_rng(8)
    scene = sim.random_scene(generator, 192)
    around = scene.mean()
    bent_pair, straight = (
        ExposurePair(
            bent(generator, scene, power, around=around), bent(generator, 16 * scene, power, around=around), 16.0
        )
        for power in (0.95, 1.0)
    )
    found = measure_exposures([bent_pair])
    assert reasons(found) == {"nonlinear response"}
    assert found.figures.gain.median == pytest.approx(1.9, rel=0.05)
    found = measure_exposures([straight])
    assert found.verdict.grade == "good"
    assert found.figures.gain.q95 - found.figures.gain.q05 < 0.1 * found.figures.gain.median


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("second", [1.0, 1.2])
def test_a_second_amplifier_for_the_brighter_part_of_a_scene_is_named(second, across):
    generator = np.random.default_rng(6)
    right = np.linspace(0, 1, 256) * np.ones((256, 1))
    scene = (
        300 * (0.6 + 0.4 * right) * (ndimage.gaussian_filter(1.0 * (generator.random(right.shape) < 0.1), 1.5) < 0.2)
    )
    scene = 20 + ndimage.gaussian_filter(scene, 1.0)
    gain = 1.2 * np.where(right > 0.5, second, 1.0)
    pair = [sim.exposed(generator, time * scene, gain=gain) for time in (1, 10)]
    found = measure_exposures([ExposurePair(*(one.T if across else one for one in pair))])
    assert ("uneven gains" in reasons(found)) == (second > 1)
    assert second == 1 or f"{'upper and lower' if across else 'left and right'} halves" in str(found.verdict.reasons)


@pytest.mark.parametrize(("second", "known"), [(1.1, set()), (1.6, {"unequal frames"})])
def test_frames_of_two_doses_are_no_equal_exposures(second, known):
    generator = np.random.default_rng(7)
    scene = sim.random_scene(generator, 128)
    found = measure_exposures(Burst(np.stack([sim.exposed(generator, scene * (1, second)[i % 2]) for i in range(6)])))
    assert reasons(found) - {"uneven pixels"} == known


@pytest.mark.parametrize("ratio", [None, 16.0])
@pytest.mark.parametrize("second", [1.0, 1.3])
def test_amplifiers_of_a_dark_and_a_bright_half_without_common_levels_are_named_by_their_slopes(second, ratio):
    generator = np.random.default_rng(5)
    bright = np.add.outer(np.arange(256), np.zeros(256)) > 128
    scene = sim.random_scene(generator, contrast=0.5, mean=25.0) * ndimage.gaussian_filter(
        np.where(bright, 10.0, 1.0), 1
    )
    gain = np.where(bright, 2 * second, 2.0)
    found = measure_exposures([ExposurePair(*(sim.exposed(generator, t * scene, gain=gain) for t in (1, 16)), ratio)])
    assert ("uneven gains" in reasons(found)) == (second > 1)
    assert second > 1 or found.verdict.grade == "good"


@pytest.mark.parametrize(
    ("number", "read_noise", "uneven"), [(2, 0.15, 0.0), (2, 0.3, 0.0), (16, 0.3, 2.0), (4, 0.6, 0.0)]
)
def test_dark_frames_of_little_noise_leave_a_healthy_pair_good(number, read_noise, uneven):
    generator = np.random.default_rng(number)
    scene = sim.random_scene(generator, 192)
    offset = 100.3 + uneven * generator.standard_normal(scene.shape)

    def exposed(time):
        return sim.exposed(generator, time * scene, offset=offset, read_noise=read_noise)

    dark = calibration_burst([exposed(0) for _ in range(number)])
    found = measure_exposures([ExposurePair(exposed(1), exposed(16))], dark=dark)
    assert found.verdict.grade == "good"
    for one, true in ((found.figures.gain, 2.0), (found.figures.read_noise, read_noise)):
        width = one.q95 - one.q05
        assert one.q05 - width / 2 < true < one.q95 + width / 2
    assert found.figures.read_noise.q95 < 1.3 * read_noise + 0.2


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("number", [2, 4, 16])
def test_the_pattern_of_few_dark_frames_adds_no_read_noise_to_a_pair(number: int) -> None:
    generator = np.random.default_rng(0)
    scene = sim.random_scene(generator, 160, mean=25)
    offset = 100 + 5 * generator.standard_normal(scene.shape)
    dark = calibration_burst([sim.exposed(generator, 0 * scene, offset=offset) for _ in range(number)])
    found = measure_exposures(
        [ExposurePair(*(sim.exposed(generator, t * scene, offset=offset) for t in (1, 16)))], dark=dark
    )
    assert "nonlinear response" not in reasons(found)
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.05)
    assert found.figures.read_noise.median == pytest.approx(3.0, rel=0.05)


def test_dark_frames_of_another_offset_are_reported():
    generator = np.random.default_rng(1)
    scene = sim.random_scene(generator, 192)
    pair = ExposurePair(*sim.clean(generator, scene))
    for offset in (100.0, 106.0):
        dark = calibration_burst([sim.exposed(generator, 0 * scene, offset=offset) for _ in range(4)])
        found = measure_exposures([pair], dark=dark)
        assert ("offsets differ" in reasons(found)) == (offset > 100)
        effect = found.verdict.evidence["offsets"]
        assert effect["value"] == pytest.approx((offset - 100) / (2 * scene.mean()), abs=4 * effect["error"])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_few_bright_pixels_leave_offset_and_read_noise_right(seed):
    scene = sim.random_scene(np.random.default_rng(15), 128)  # a sixteenth of its pixels has 170 to 3000 electrons
    generator = np.random.default_rng(seed)
    found = measure_exposures(Burst(np.stack([sim.exposed(generator, scene) for _ in range(6)])))
    assert found.verdict.grade == "good"
    assert found.figures.offset.q05 < 100 < found.figures.offset.q95
    assert found.figures.read_noise.q05 < 3 < found.figures.read_noise.q95


def stars(generator, size=160):
    """Electrons per pixel of points, whose brightness is a power law, on a dark sky."""
    sky = np.zeros((size, size))
    np.add.at(sky, tuple(generator.integers(0, size, (2, 500))), 200 * (generator.pareto(1.2, 500) + 0.1).clip(0, 80))
    return 15 + ndimage.gaussian_filter(sky, 0.8)


def squares(generator, size=160):
    """Electrons per pixel of a turned chequerboard, whose edges divide pixels."""
    y, x = (np.indices((4 * size, 4 * size)) + generator.random((2, 1, 1))) / 4
    even = (np.floor((x + 0.2 * y) / 23) + np.floor((y - 0.2 * x) / 23)) % 2
    return (30 + 330 * even).reshape(size, 4, size, 4).mean((1, 3))


@pytest.mark.parametrize(("scene", "long"), [(stars, 1), (stars, 0), (squares, 1), (squares, 0)])
def test_sharp_edges_leave_offset_and_read_noise_right(scene, long):
    generator = np.random.default_rng(7)
    light = scene(generator)
    if long:
        exposures = [ExposurePair(*(sim.exposed(generator, times * light) for times in (1, sim.RATIO)))]
    else:
        exposures = Burst(np.stack([sim.exposed(generator, light) for _ in range(6)]))
    found = measure_exposures(exposures)
    assert found.figures.offset.q05 < 100 < found.figures.offset.q95
    assert found.figures.read_noise.q05 < 3 < found.figures.read_noise.q95
    assert found.figures.gain.q05 < 2 < found.figures.gain.q95
    assert "saturation" not in reasons(found)


def test_a_full_well_of_few_pixels_is_reported():
    generator = np.random.default_rng(0)
    scene = sim.random_scene(generator, 128)
    kept = np.minimum(generator.poisson(scene, (6, 128, 128)), np.quantile(scene, 0.97))
    frames = np.round(100 + 2 * (kept + 3 * generator.standard_normal(kept.shape)))
    assert "saturation" in reasons(measure_exposures(Burst(frames)))


@pytest.mark.parametrize(("step", "zero"), [(16.0, 0.0), (1 / 65535, 0.0), (0.5, -50.3)])
def test_the_unit_of_the_codes_does_not_matter(step, zero):
    generator = np.random.default_rng(8)
    scene = sim.random_scene(generator, 128)
    short, long = (sim.exposed(generator, times * scene, gain=0.4) for times in (1, 4))
    codes, other = (
        measure_exposures([ExposurePair(*pair)]) for pair in ((short, long), (step * short + zero, step * long + zero))
    )
    assert other.verdict.grade == codes.verdict.grade == "good"
    assert vars(other.figures.gain) == pytest.approx(vars(codes.figures.gain.times(step)), rel=1e-3)
    assert other.figures.offset.median == pytest.approx(step * codes.figures.offset.median + zero, abs=0.1 * step)
    assert other.figures.read_noise.median == pytest.approx(codes.figures.read_noise.median, rel=1e-3)
    one, two = (np.unique(collect_pixels(found.pairs).observation).size for found in (codes, other))
    assert one == two


@pytest.mark.parametrize(("count", "scale"), [(1, 1), (3, 1), (4, 1), (1, 65535), (1, 0.5)])
def test_means_of_frames_are_named_and_single_ones_not(count, scale):
    generator = np.random.default_rng(0)
    scene = sim.random_scene(generator, 96)
    means = [np.mean([sim.exposed(generator, scene) for _ in range(count)], 0) for _ in range(6)]
    found = measure_exposures(Burst((np.stack(means) / scale).astype(np.float32)))
    assert ("averaged frames" in reasons(found)) == (count > 1)
    assert "averaged frames" not in reasons(found) or f"1/{count}," in found.verdict.reasons[0]


@pytest.mark.parametrize("averaged", ["", "flat", "dark"])
def test_means_of_flats_or_darks_are_named(averaged):
    generator = np.random.default_rng(1)

    def frames(electrons: float, count: int) -> Burst:
        level = np.full((96, 96), electrons)
        means = [np.mean([sim.exposed(generator, level) for _ in range(count)], 0) for _ in range(4)]
        return calibration_burst(np.float32(means))

    flats = [frames(level, 4 if averaged == "flat" else 1) for level in (100, 400, 1200)]
    dark = frames(0, 4 if averaged == "dark" else 1)
    scene = sim.random_scene(generator, 96)
    burst = Burst(np.stack([sim.exposed(generator, scene) for _ in range(6)]))
    for found in (calibrate_camera(flats, [dark]), measure_exposures(burst, dark=dark, flat=flats[1])):
        assert ("averaged frames" in reasons(found)) == bool(averaged)
        assert not averaged or f"of the {averaged} frames are multiples of 1/4," in " ".join(found.verdict.reasons)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_levels_without_noise_and_values_without_steps_raise_no_warning_of_numpy():
    groups = groups_of(np.r_[np.zeros(200), 1e3], 4, 50)
    assert sorted(np.concatenate(groups)) == list(range(201))
    line, _, _ = _weighted_line(np.arange(4.0), np.array([0.0, 2.0, 4.0, 6.0]), np.full(4, 10.0))
    assert line.rate == pytest.approx(2.0)
    generator = np.random.default_rng(0)
    frames = 20 * generator.poisson(np.linspace(5, 90, 64), (6, 64, 64)) + generator.normal(100, 0.5, (6, 64, 64))
    assert measure_exposures(Burst(frames)).detector is not None


@pytest.mark.parametrize("moved", [1, 2])
def test_each_colour_of_a_mosaic_is_compared_with_itself_where_the_scene_moved(moved):
    generator = np.random.default_rng(0)
    scene, filters = sim.random_scene(generator, 200, mean=40.0), np.tile([[0.5, 1.0], [1.0, 0.35]], (96, 96))
    pair = [scene[4:-4, 4:-4] * filters, 16 * scene[4:-4, 4 + moved : 196 + moved] * filters]
    found = measure_exposures([ExposurePair(*(sim.exposed(generator, one) for one in pair))])
    assert found.verdict.grade == "good"
    assert found.figures.linear.q05 < sim.GAIN < found.figures.linear.q95


@pytest.mark.parametrize("filters", [[[1.0, 1.0], [1.0, 1.0]], [[0.5, 1.0], [1.0, 0.65]]])
def test_a_burst_that_drifts_has_no_image_lag(filters):
    generator = np.random.default_rng(7)
    scene, mosaic = sim.random_scene(generator, 208), np.tile(filters, (96, 96))
    moved = [ndimage.shift(scene, (0.35 * n, -0.2 * n), order=5)[8:-8, 8:-8] * mosaic for n in range(6)]
    found = measure_exposures(Burst(np.stack([sim.exposed(generator, one) for one in moved])))
    assert found.burst.drifting
    assert found.verdict.grade == "good"
    assert found.figures.linear.median == pytest.approx(sim.GAIN, rel=0.03)
    kept = [sim.exposed(generator, one) for one in moved]
    kept = [0.8 * one + 0.2 * before for before, one in pairwise(kept)]
    assert "frames correlated" in reasons(measure_exposures(Burst(np.round(np.stack(kept)))))


def test_amplifiers_with_offsets_of_their_own_are_named_and_dark_frames_mend_them():
    generator = np.random.default_rng(3)
    scene = sim.random_scene(generator, 192)
    offset = np.where(np.arange(192) < 96, 100.0, 112.0) * np.ones((192, 1))
    pair = [ExposurePair(*(sim.exposed(generator, times * scene, offset=offset) for times in (1, sim.RATIO)))]
    assert "amplifiers with offsets of their own" in measure_exposures(pair).verdict.reasons[0]
    dark = calibration_burst([sim.exposed(generator, 0 * scene, offset=offset) for _ in range(6)])
    found = measure_exposures(pair, dark=dark)
    assert found.verdict.grade == "good"
    assert found.figures.gain.q05 < sim.GAIN < found.figures.gain.q95


def test_signed_codes_far_below_zero_are_no_subtracted_offset():
    generator = np.random.default_rng(5)
    scene = sim.random_scene(generator, 192)
    pair = [sim.exposed(generator, times * scene, offset=32_100) - 64_000 for times in (1, sim.RATIO)]
    found = measure_exposures([ExposurePair(*pair, sim.RATIO)])
    assert found.verdict.grade == "good"
    assert found.figures.offset.median == pytest.approx(-31_900, abs=1)


def test_points_of_a_dark_scene_with_bright_detail_lie_on_one_line():
    generator = np.random.default_rng(6)
    scene = 3 + ndimage.gaussian_filter(600 * (generator.random((512, 512)) < 0.01), 1.3)
    pair = ExposurePair(*(sim.exposed(generator, t * scene, read_noise=4.0) for t in (1, 10)), 10.0)
    found = measure_exposures([pair])
    assert found.verdict.grade == "good"
    assert abs(found.detector.line.gain - sim.GAIN) < 2 * found.detector.line.gain_error < 0.05 * sim.GAIN


def test_dark_frames_that_rounding_hides_bound_the_noise_but_not_the_response():
    """10 bits in the upper ones of 16, ten electrons to a code: the noise of darkness is 0.4 codes."""
    generator = np.random.default_rng(2)
    scene = sim.random_scene(generator, 192, mean=40.0)

    def frames(electrons, number):
        return [64 * sim.exposed(generator, electrons, gain=0.1, offset=16, read_noise=4.0) for _ in range(number)]

    found = measure_exposures(Burst(np.stack(frames(scene, 6))), dark=calibration_burst(frames(0 * scene, 8)))
    assert not reasons(found)
    assert found.figures.gain.median == pytest.approx(6.4, rel=0.04)
    assert found.figures.read_noise.q05 < 4.0 < found.figures.read_noise.q95 < 5
    assert abs(found.figures.offset.median - 1024) < 2 * (found.figures.offset.q95 - found.figures.offset.q05)


@pytest.mark.parametrize("offset", [-20.0, 0.0])
def test_dark_frames_clipped_at_zero_determine_no_offset(offset):
    generator = np.random.default_rng(3)
    scene, options = sim.random_scene(generator, 192, mean=300.0), {"gain": 0.5, "offset": offset, "read_noise": 3.0}
    burst = Burst(np.stack([sim.exposed(generator, scene, **options) for _ in range(6)]))
    dark = calibration_burst([sim.exposed(generator, 0 * scene, **options) for _ in range(4)])
    assert (dark.frames.max() == 0) == (offset < 0)
    found = measure_exposures(burst, dark=dark)
    assert reasons(found) == {"clipped darkness"}
    assert found.figures.offset.q05 < offset < found.figures.offset.q95
    flats = [
        calibration_burst([sim.exposed(generator, at + 0 * scene, **options) for _ in range(4)])
        for at in (200, 500, 900)
    ]
    assert "clipped darkness" in reasons(camera := calibrate_camera(flats, [dark]))
    assert camera.figures.gain.q05 < 0.5 < camera.figures.gain.q95


@pytest.mark.slow
def test_the_offset_of_stars_on_a_bright_sky_is_as_uncertain_as_the_ratio_that_they_show():
    """The few stars determine the fitted ratio to a percent, and with it the share of the sky in its level."""
    held = []
    for seed in range(12):
        scene = sim.star_field(np.random.default_rng(seed), sky=20.0)
        pair = ExposurePair(*sim.clean(np.random.default_rng(1000 + seed), scene), 16.0)
        found = measure_exposures([pair]).figures
        held.append(found.offset is not None and found.offset.q05 < sim.OFFSET < found.offset.q95)
    assert sum(held) >= 8  # 0.9 of them, but for chance


@pytest.mark.parametrize("multiplies", [True, False])
def test_multiplied_electrons_leave_no_offset_to_the_shape_of_the_noise(multiplies):
    generator = np.random.default_rng(3)
    scene = sim.random_scene(generator)
    setting = {"gain": 40.0, "offset": 100.0}
    if multiplies:
        pair = [sim.multiplied(generator, t * scene, **setting, read=20.0) for t in (1, 8)]
    else:
        pair = [sim.exposed(generator, t * scene, **setting, read_noise=0.5) for t in (1, 8)]
    found = measure_exposures([ExposurePair(*pair)])
    assert (reasons(found) == {"not Poisson-Gaussian"}) == multiplies
    assert (found.figures.offset is None) == multiplies
    assert found.figures.gain.median == pytest.approx(80 if multiplies else 40, rel=0.06)


def test_a_black_border_is_left_out():
    generator = np.random.default_rng(21)
    short, long = (np.pad(one, 24) for one in sim.clean(generator, sim.random_scene(generator, 176)))
    found = measure_exposures([ExposurePair(short, long)])
    assert found.verdict.grade == "good"
    assert found.figures.gain.q05 < sim.GAIN < found.figures.gain.q95


def test_a_wrong_ratio_leaves_the_true_gain_inside_the_interval():
    generator = np.random.default_rng(31)
    scene = sim.random_scene(generator)
    short, long = (sim.exposed(generator, times * scene) for times in (1, 8))
    found = measure_exposures([ExposurePair(short, long, 7.6)])
    assert "nonlinear response" in reasons(found)
    assert found.figures.gain.q05 < sim.GAIN < found.figures.gain.q95


def test_values_far_from_any_detector_s_are_measured_by_photon_transfer():
    generator = np.random.default_rng(22)
    light = sim.random_scene(generator, 128, mean=12.0, contrast=1.0)
    short, long = (np.where(one < 110, 100, one) for one in (sim.exposed(generator, t * light) for t in (1, 16)))
    found = measure_exposures([ExposurePair(short, long)])
    assert "not Poisson-Gaussian" in reasons(found)
    assert found.figures.source == "photon transfer"


def test_no_flexible_model_learns_the_fault_of_bad_exposures():
    case = CASES["both median-filtered 3 × 3"](5)
    found = calibrate_exposures([ExposurePair(case.short, case.long)])
    assert found.verdict.grade == "bad"
    assert {one.name for one in found.scores} == {*SIMPLE, "signal-gaussian"}


def test_a_good_pair_says_that_it_does_not_show_averaged_frames():
    generator = np.random.default_rng(23)
    scene = sim.random_scene(generator, 128)
    exposures = [ExposurePair(*sim.clean(generator, scene))]
    for number, said in ((2, True), (3, False)):
        dark = calibration_burst([sim.exposed(generator, 0 * scene) for _ in range(number)])
        found = measure_exposures(exposures, dark=dark).verdict
        assert found.grade == "good"
        assert ("averages successive" in found.reasons[0], "successive frames" in found.not_tested) == (said, said)
