"""Tilt series in and out, and every refusal."""

from pathlib import Path

import numpy as np
import pytest
import torch

from noiseflow import io
from recon.series.files import read_tilt_series, write_tilt_series
from recon.series.prepare import prepare
from recon.series.tilt_series import TiltSeries, Volume, VolumeGrid
from tests.independent_scenes import independent_series

ANGLES = np.array([-40.0, 0.0, 40.0])


def images():
    return np.random.default_rng(0).random((3, 6, 8)).astype(np.float32)


def test_round_trip_keeps_pixels_angles_and_pixel_size(tmp_path):
    series = TiltSeries(images(), ANGLES, 4.5, "linear")
    write_tilt_series(tmp_path / "tilts.mrc", series)
    back = read_tilt_series(tmp_path / "tilts.mrc", mode="linear")
    np.testing.assert_array_equal(back.images, series.images)
    np.testing.assert_allclose(back.tilt_angles, ANGLES)
    assert back.pixel_size == pytest.approx(4.5)


def test_volume_carries_its_voxel_size(tmp_path):
    Volume(images(), 4.5).write(tmp_path / "volume.mrc")
    assert io.read(tmp_path / "volume.mrc").voxel_size == pytest.approx((4.5, 4.5, 4.5))


def test_grid_of_a_series():
    assert VolumeGrid.of(TiltSeries(images(), ANGLES, 2.0)).shape == (8, 6, 8)
    assert VolumeGrid.of(TiltSeries(images(), ANGLES), thickness=5).shape == (5, 6, 8)
    with pytest.raises(ValueError, match="thickness"):
        VolumeGrid.of(TiltSeries(images(), ANGLES), thickness=0)


@pytest.mark.parametrize(
    ("stack", "angles", "options", "words"),
    [
        (images(), ANGLES[:2], {}, "3 images, but there are 2"),
        (images()[0], ANGLES[:1], {}, "stack"),
        (images()[:1], ANGLES[:1], {}, "at least two"),
        (np.where(np.arange(8) == 3, np.nan, images()), ANGLES, {}, "NaN"),
        (np.ones((3, 6, 8)), ANGLES, {}, "flat"),
        (images(), np.array([0.0, np.nan, 1.0]), {}, "NaN"),
        (images(), np.zeros(3), {}, "different angles"),
        (images().repeat(2, 2)[:, :, :7].repeat(2, 0)[:5], np.arange(7.0), {}, "axis x has 7 entries"),
        (images(), ANGLES, {"mode": "haadf"}, "linear"),
        (images(), ANGLES, {"mask": np.zeros(images().shape, bool)}, "every pixel"),
    ],
)
def test_wrong_series_is_refused(stack, angles, options, words):
    with pytest.raises(ValueError, match=words):
        TiltSeries(stack, angles, **options)


def test_repeated_angles_are_pointed_out():
    with pytest.warns(UserWarning, match="more than once"):
        prepare(TiltSeries(images(), np.array([-40.0, 0.0, 0.0])))


@pytest.mark.filterwarnings("ignore:the tilt angles span")
@pytest.mark.parametrize(("count", "shown"), [(8, r"\(1°, .*8°\)"), (9, r"\(1°, .*8°, …\)")])
def test_of_many_angles_the_first_eight_are_named(count, shown):
    stack = np.random.default_rng(0).random((2 * count, 6, 8))
    with pytest.warns(UserWarning, match=f"more than once {shown}"):
        prepare(TiltSeries(stack, np.arange(1.0, count + 1).repeat(2)))


@pytest.mark.parametrize("words", ["more than once", "radians"])
def test_angles_are_warned_of_once(words):
    angles = np.linspace(-60, 60, 13)
    images = independent_series("beads", "Poisson 100", angles, size=32).series.images.copy()
    images[9] = images[9, 0, 0]  # which is left out, so that the rest are other angles
    angles = np.deg2rad(angles) if words == "radians" else np.where(np.arange(13) < 11, angles, 50)
    with pytest.warns(UserWarning, match=words) as told:
        prepare(TiltSeries(images, angles, mode="linear"))
    assert sum(words in str(each.message) for each in told) == 1


def test_missing_and_broken_angle_files(tmp_path):
    io.write(tmp_path / "tilts.mrc", images())
    with pytest.raises(FileNotFoundError, match="--angles"):
        read_tilt_series(tmp_path / "tilts.mrc")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_tilt_series(tmp_path / "tilts.mrc", angles=tmp_path / "none.tlt")
    broken = tmp_path / "broken.tlt"
    broken.write_text("1.0\nabc\n")
    with pytest.raises(ValueError, match="line 2: 'abc'"):
        io.read_tilts(broken)
    broken.write_bytes(b"\xef\xbb\xbf-60\r\n60\r\n")  # as Windows editors write it
    assert io.read_tilts(broken).angles.tolist() == [-60, 60]
    broken.write_text("\n")
    with pytest.raises(ValueError, match="no angles"):
        io.read_tilts(broken)


def test_angles_are_found_beside_the_stack(tmp_path):
    io.write(tmp_path / "tilts.mrc", images())
    (tmp_path / "tilts.tlt").write_text("-40\n0\n\n40\n")
    np.testing.assert_allclose(read_tilt_series(tmp_path / "tilts.mrc").tilt_angles, ANGLES)


def test_microscope_file_reads_with_the_angles_of_its_tags():
    needle = Path(__file__).parents[4] / "shared" / "data" / "tilt_needle" / "needle_raw.dm3"
    if not needle.exists():
        pytest.skip("the raw needle series is not here")
    series = read_tilt_series(needle, mode="linear")
    assert series.images.shape == (91, 64, 64)
    assert series.images.dtype == np.uint16
    np.testing.assert_allclose(series.tilt_angles, np.arange(-90, 91, 2))
    assert series.pixel_size == pytest.approx(179.949, rel=1e-5)


def test_tensors_are_taken_and_the_value_tells_what_it_holds():
    series = TiltSeries(torch.from_numpy(images()), ANGLES, 4.5, "linear")
    assert isinstance(series.images, np.ndarray)
    assert repr(series) == "TiltSeries(3 x 6 x 8 float32, -40° to 40°, 4.5 Å per pixel, linear)"
    assert repr(Volume(images())) == "Volume(3 x 6 x 8 float32, unknown voxel size)"


def test_masked_pixels_may_hold_any_number():
    images = np.random.default_rng(0).random((5, 8, 8))
    mask = images < 0.9
    given = np.where(mask, images, 1e30)
    assert TiltSeries(given, np.arange(5.0), mask=mask).num_tilts == 5
    with pytest.raises(ValueError, match="mask wrong ones"):
        TiltSeries(given, np.arange(5.0))
    with pytest.raises(ValueError, match="flat"):
        TiltSeries(np.where(mask, 2.0, images), np.arange(5.0), mask=mask)
