"""Frames are checked once, and every mistake gets one clear line."""

import numpy as np
import pytest
import tifffile

from calibration.exposures.frames import Burst, ExposurePair, frames_of, read_burst, read_pairs, saturation_level
from calibration.exposures.masks import broken_lines, defects
from calibration.exposures.processing import wavelet_compressed
from calibration.exposures.scaling import one_sigma, spread_by_level
from calibration.pipeline import measure_exposures
from calibration.registration.bursts import align_burst
from noiseflow.io import write
from tests.calibration.simulators import exposed, multiplied, random_scene

RANDOM = np.random.default_rng(0)
GOOD, OTHER = RANDOM.poisson(50, (2, 40, 40)).astype(np.float64)


def broken(**change):
    frame = GOOD.copy()
    if "nan" in change:
        frame[3, 4] = np.nan
    return frame


@pytest.mark.parametrize(
    ("short", "long", "message"),
    [
        (GOOD, np.zeros((40, 41)) + np.arange(41), "sizes must agree"),
        (broken(nan=True), OTHER, "NaN"),
        (np.ma.masked_greater(GOOD, 60), OTHER, "masked"),
        (GOOD + 0j, OTHER, "not real-valued"),
        (np.full((40, 40), 7.0), OTHER, "flat"),
        (np.full((40, 40), 65535, np.uint16), OTHER, "saturated"),
        (np.where(RANDOM.random((40, 40)) < 0.7, 4095, GOOD), OTHER, "saturated"),
        (np.stack([GOOD] * 3, -1), OTHER, "colour"),
        (np.stack([GOOD] * 3), OTHER, "colour"),
        (np.stack([GOOD] * 7), OTHER, "single 2D frame"),
        (GOOD[:16, :16], OTHER[:16, :16], "at least 32"),
        (GOOD, GOOD, "identical"),
    ],
)
def test_unusable_frames_are_refused(short, long, message):
    with pytest.raises(ValueError, match=message):
        ExposurePair(short, long)


@pytest.mark.parametrize("ratio", [1.0, 0.5, -2.0, np.inf, np.nan])
def test_exposure_ratio_must_exceed_one(ratio):
    with pytest.raises(ValueError, match="above 1"):
        ExposurePair(GOOD, OTHER, ratio)


def test_saturation_level_is_the_rail_only_where_one_shows():
    frame = RANDOM.poisson(200, (200, 200))
    assert saturation_level(frame) == np.inf
    assert saturation_level(np.minimum(frame, 215)) == 215
    np.minimum(frame, 215, out=frame)  # what was found before does not count for a frame that has changed
    assert saturation_level(frame) == 215
    assert saturation_level(np.array([3, 255, 7], np.uint8)) == 255


def test_burst_needs_two_different_frames():
    with pytest.raises(ValueError, match="only one frame"):
        Burst(GOOD[None])
    with pytest.raises(ValueError, match="frames 0 and 1"):
        Burst(np.stack([GOOD, GOOD]))
    assert Burst(np.stack([GOOD, OTHER])).frames.shape == (2, 40, 40)


def test_pairs_are_read_in_the_order_given(tmp_path):
    for name, frame in (("a.tif", GOOD), ("b.tif", OTHER), ("long.mrc", GOOD + OTHER)):
        write(tmp_path / name, frame.astype(np.float32))
    pairs = read_pairs([tmp_path / "b.tif", tmp_path / "a.tif"], [tmp_path / "long.mrc"], exposure_ratio=2)
    np.testing.assert_array_equal(pairs[0].short, OTHER)
    np.testing.assert_array_equal(pairs[1].short, GOOD)
    assert pairs[0].exposure_ratio == 2
    with pytest.raises(ValueError, match="1 short and 2 long"):
        read_pairs([tmp_path / "a.tif"], [tmp_path / "b.tif", tmp_path / "long.mrc"])
    with pytest.raises(ValueError, match="both short and long"):
        read_pairs([tmp_path / "a.tif"], [tmp_path / "a.tif"])


def test_burst_is_read_from_a_stack_or_from_files(tmp_path):
    write(tmp_path / "stack.tif", np.stack([GOOD, OTHER]).astype(np.float32))
    write(tmp_path / "a.npy", GOOD)
    write(tmp_path / "b.npy", OTHER)
    stack, files = read_burst([tmp_path / "stack.tif"]), read_burst([tmp_path / "a.npy", tmp_path / "b.npy"])
    np.testing.assert_array_equal(stack.frames, files.frames)
    with pytest.raises(ValueError, match=r"a\.npy contains only one frame"):
        read_burst([tmp_path / "a.npy"])
    with pytest.raises(ValueError, match="the dark frames contain only one frame"):
        read_burst([tmp_path / "a.npy"], name="the dark frames", calibration=True)


def test_a_few_pixels_of_little_noise_may_repeat_a_frame():
    frames = np.random.default_rng(0).integers(100, 102, (2000, 3, 3))  # some of them constant
    Burst(frames, calibration=True).require_unsaturated()
    with pytest.raises(ValueError, match="flat"):
        Burst(np.full((4, 3, 3), 100), calibration=True).require_unsaturated()
    Burst(np.full((4, 3, 3), 100), calibration=True).require_unsaturated(dark=True)
    with pytest.raises(ValueError, match="identical"):
        Burst(np.stack([np.arange(1024.0).reshape(32, 32)] * 2), calibration=True)


def test_columns_of_large_frames_are_sampled_alike():
    deviation = np.tile([1.0, 3.0], 1024)
    residual = np.random.default_rng(0).normal(0, deviation, (512, 2048)).ravel()
    spread = spread_by_level(np.random.default_rng(1).random(residual.size), residual, step=0.0, num_levels=1)[1]
    assert spread.mean() == pytest.approx(np.sqrt(5), rel=0.05)


@pytest.mark.parametrize("named", [True, False])
def test_one_of_two_channels_is_chosen_and_none_is_taken_silently(tmp_path, named):
    images = np.random.default_rng(0).poisson(100, (2, 40, 48)).astype(np.uint16)
    path = tmp_path / "two.ome.tif"
    channel = {"Channel": {"Name": ["GFP", "RFP"]}} if named else {}
    tifffile.imwrite(path, images, ome=True, metadata={"axes": "CYX", **channel})
    np.testing.assert_array_equal(frames_of(path, channel="RFP" if named else "1")[0], images[1])
    if named:
        with pytest.raises(ValueError, match="'GFP', 'RFP'"):
            frames_of(path)
        np.testing.assert_array_equal(frames_of(f"{path}::GFP")[0], images[0])
    else:  # a stack, as some programs save frames as channels
        np.testing.assert_array_equal(frames_of(path)[0], images)


@pytest.mark.parametrize("size", [1, 2, 3, 50, 1000, 1001])
def test_one_sigma_is_that_of_the_percentiles(size):
    values = np.random.default_rng(size).normal(size=size).round(2)
    np.testing.assert_allclose(one_sigma(values), np.percentile(values, (15.87, 50, 84.13)), atol=1e-12)


@pytest.mark.parametrize("mean", [1.0, 3.0])
def test_skewed_noise_of_few_electrons_is_no_change_of_the_scene(mean):
    generator = np.random.default_rng(5)
    scene = random_scene(generator, 96, mean=mean)
    frames = np.stack([multiplied(generator, scene, gain=60.0, offset=300.0, read=12.0) for _ in range(30)])
    pairs, _ = align_burst(Burst(frames))
    assert pairs[0].counts.restless < 0.01 * scene.size


@pytest.mark.parametrize("turned", [False, True])
def test_broken_lines_are_defects_even_where_the_scene_is_as_dark(turned):
    generator = np.random.default_rng(0)
    lines = generator.choice(128, 6, replace=False)
    frames = np.stack([exposed(generator, times * random_scene(generator, 128, mean=20.0)) for times in (1, 8)])
    frames[:, :, lines], frames[:, :, lines[:2]] = 100.0, 4095.0
    found = np.zeros((128, 128), bool)
    found[:, lines] = True
    frames, found = (frames.swapaxes(1, 2), found.T) if turned else (frames, found)
    np.testing.assert_array_equal(broken_lines(frames), found)
    assert np.all(np.any(defects(frames), axis=0)[found])


@pytest.mark.parametrize("seed", [0, 1])
def test_broken_lines_are_no_mark_of_a_compressor(seed):
    generator = np.random.default_rng(seed)
    frame = np.round(100 + 2.0 * generator.poisson(1000, (64, 64)) + generator.normal(0, 3, (64, 64)))
    frame[:, generator.choice(64, 5, replace=False)] = 100.0
    assert not wavelet_compressed(frame)


def test_equal_values_of_few_photons_are_no_broken_lines():
    frames = np.random.default_rng(0).poisson(0.01, (2, 40, 200)).astype(float)
    assert np.any(np.ptp(frames, axis=1) == 0)
    assert not broken_lines(frames).any()


def test_hot_pixels_of_the_dark_frames_are_left_out():
    generator = np.random.default_rng(3)
    scene, size = random_scene(generator, 128), (128, 128)
    hot = (generator.random(size) < 0.01) * generator.exponential(400, size)
    short, long = (exposed(generator, times * scene + hot) for times in (1, 16))
    dark = Burst(np.stack([exposed(generator, hot) for _ in range(10)]), "dark", True)
    found = measure_exposures([ExposurePair(short, long)], dark=dark)
    assert not found.pairs[0].mask[hot > 100].any()
    assert found.figures.offset.median == pytest.approx(100, abs=0.1)
    assert found.figures.read_noise.median == pytest.approx(3, rel=0.1)
    assert found.verdict.grade == "good", found.verdict.reasons


@pytest.mark.parametrize("wrong", [[], (GOOD, OTHER), [(GOOD, OTHER)], ExposurePair(GOOD, OTHER), GOOD])
def test_what_is_no_list_of_pairs_is_refused(wrong):
    with pytest.raises(TypeError, match="list of ExposurePair"):
        measure_exposures(wrong)
    with pytest.raises(TypeError, match="Bursts"):
        measure_exposures([ExposurePair(GOOD, OTHER)], dark=np.stack([GOOD, OTHER]))
