"""An alignment as a value: IMOD's transforms, files, and other series of the same tilts."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import recon
from noiseflow import io
from recon.series.alignment import Alignment
from recon.series.tilt_series import TiltSeries

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # the transforms of the files are meant

ANGLES = np.array([-40.0, 0.0, 40.0])
IMAGES = np.random.default_rng(0).random((3, 9, 9)).astype(np.float32)


def applied(*rows: list[list[float]], images: np.ndarray = IMAGES) -> TiltSeries:
    transforms = np.array(rows, dtype=float)
    series = TiltSeries(images, ANGLES[: len(images)], mode="linear")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Alignment.of_transforms(transforms, series.tilt_angles).apply(series)


def test_identity_changes_nothing() -> None:
    moved = applied(*[[[1, 0, 0], [0, 1, 0]]] * 3)
    np.testing.assert_array_equal(moved.images, IMAGES)
    assert moved.mask is None


def test_shift_moves_the_image_by_dx_to_the_right_and_dy_down_the_rows() -> None:
    moved = applied(*[[[1, 0, 2], [0, 1, -1]]] * 3)
    np.testing.assert_array_equal(moved.images[:, :-1, 2:], IMAGES[:, 1:, :-2])
    np.testing.assert_array_equal(moved.used[0], np.pad(np.ones((8, 7), bool), ((0, 1), (2, 0))))


def test_rotation_is_about_the_middle_and_turns_x_towards_y() -> None:
    images = np.zeros((2, 9, 9), np.float32)
    images[:, 4, 7] = 1  # three pixels along +x from the middle
    moved = applied(*[[[0, -1, 0], [1, 0, 0]]] * 2, images=images)
    assert np.unravel_index(moved.images[0].argmax(), (9, 9)) == (7, 4)  # along +y


def test_a_transform_and_its_inverse_give_the_image_back() -> None:
    y, x = np.mgrid[:64, :64]
    smooth = np.exp(-((x - 30) ** 2 + (y - 35) ** 2) / 60)[None].repeat(2, 0).astype(np.float32)
    matrix, shift = np.array([[0.98, -0.1], [0.12, 1.03]]), np.array([1.7, -2.3])
    inverse = np.linalg.inv(matrix)
    there = applied(*[np.column_stack([matrix, shift])] * 2, images=smooth)
    back = applied(*[np.column_stack([inverse, -inverse @ shift])] * 2, images=there.images)
    np.testing.assert_allclose(back.images[0, 15:50, 15:50], smooth[0, 15:50, 15:50], atol=2e-3)


def alignment(**more) -> Alignment:
    rng = np.random.default_rng(1)
    stretches = np.eye(2) + rng.normal(scale=0.02, size=(3, 2, 2))
    known = {"stretches": stretches, "refined_angles": ANGLES + 0.5, "image_shape": (16, 24), "pixel_size": 2.0} | more
    return Alignment(88.0, rng.normal(scale=1.5, size=(3, 2)), ANGLES, **known)


def test_json_keeps_everything(tmp_path: Path) -> None:
    kept = alignment()
    assert recon.write_alignment(tmp_path / "a.json", kept) == [tmp_path / "a.json"]
    found = recon.read_alignment(tmp_path / "a.json")
    assert found.as_dict() == kept.as_dict()
    (tmp_path / "a.json").write_text(json.dumps({"alignment": {"tilt_axis_degrees": 3}}))
    with pytest.raises(ValueError, match="not an alignment"):
        recon.read_alignment(tmp_path / "a.json")
    with pytest.raises(FileNotFoundError, match="--save-alignment"):
        recon.read_alignment(tmp_path / "none.json")


def test_imod_files_apply_the_same_transforms(tmp_path: Path) -> None:
    kept = alignment()
    assert [path.name for path in recon.write_alignment(tmp_path / "a.xf", kept)] == ["a.xf", "a.tlt"]
    series = TiltSeries(np.random.default_rng(2).random((3, 16, 24)), ANGLES, mode="linear")
    found = recon.read_alignment(tmp_path / "a.xf", series)
    np.testing.assert_allclose(found.transforms, kept.transforms, atol=1e-3)
    np.testing.assert_allclose(io.read_tilts(tmp_path / "a.tlt").angles, ANGLES + 0.5)
    there, here = found.apply(series), kept.apply(series)
    np.testing.assert_array_equal(there.tilt_angles, ANGLES + 0.5)
    both = there.used & here.used
    np.testing.assert_allclose(there.images[both], here.images[both], atol=0.01)


def test_a_quarter_turn_of_imod_keeps_the_whole_specimen(tmp_path: Path) -> None:
    images = np.random.default_rng(3).random((3, 8, 12)).astype(np.float32)
    (tmp_path / "wide.xf").write_text("0 -1 1 0 0 0\n" * 3)
    series = TiltSeries(images, ANGLES, mode="linear")
    aligned = recon.read_alignment(tmp_path / "wide.xf", series).apply(series)
    assert aligned.mask is None
    np.testing.assert_array_equal(aligned.images, np.rot90(images, -1, axes=(1, 2)))


def test_another_channel_is_joined_by_angle() -> None:
    kept = alignment(refined_angles=None)
    series = TiltSeries(np.random.default_rng(2).random((2, 16, 24)), [40.1, -39.95], mode="linear")
    found = kept.joined(series)
    np.testing.assert_array_equal(found.shifts, kept.shifts[[2, 0]])
    np.testing.assert_array_equal(found.tilt_angles, [40.1, -39.95])


def test_shifts_follow_the_binning() -> None:
    kept = alignment()
    series = TiltSeries(np.random.default_rng(2).random((3, 8, 12)), ANGLES, 4.0, mode="linear")
    np.testing.assert_allclose(kept.joined(series).shifts, kept.shifts / 2)
    assert kept.joined(series).image_shape == (8, 12)


@pytest.mark.parametrize(
    ("shape", "angles", "size", "message"),
    [
        ((3, 16, 24), [-40, 0, 35], 2.0, "no tilt at 35°"),
        ((4, 16, 24), [-40, 0, 0, 40], 2.0, "no tilt at 0°"),
        ((3, 16, 16), ANGLES, 2.0, "not the same field of view"),
        ((3, 8, 12), ANGLES, 2.0, "not the same field of view"),
    ],
)
def test_other_tilts_and_other_fields_of_view_are_refused(shape, angles, size, message) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        series = TiltSeries(np.random.default_rng(2).random(shape), angles, size, mode="linear")
    with pytest.raises(ValueError, match=message):
        alignment().joined(series)


def test_commands_save_and_apply_an_alignment(tmp_path: Path, run) -> None:
    from tests.recon.series.test_alignment import ANGLES as TILTS
    from tests.recon.series.test_alignment import blobs, random_shifts

    raw = blobs(3.0, random_shifts(2.0), shape=(24, 24)).images
    np.save(tmp_path / "haadf.npy", raw)
    np.save(tmp_path / "iron.npy", 2 * raw[::-1])
    np.savetxt(tmp_path / "haadf.tlt", TILTS)
    np.savetxt(tmp_path / "iron.tlt", TILTS[::-1])
    more = ["--mode", "linear", "--method", "wbp"]
    first = run(
        "reconstruct",
        tmp_path / "haadf.npy",
        "-o",
        tmp_path / "haadf.mrc",
        *more,
        "--refine-alignment",
        "--save-alignment",
        tmp_path / "a.json",
    )
    second = run(
        "reconstruct", tmp_path / "iron.npy", "-o", tmp_path / "iron.mrc", *more, "--alignment", tmp_path / "a.json"
    )
    shifts = (np.array(each["alignment"]["shifts_yx_pixels"]) for each in (first, second))
    np.testing.assert_allclose(next(shifts), next(shifts)[::-1])
    haadf, iron = (io.read(tmp_path / f"{name}.mrc").data for name in ("haadf", "iron"))
    np.testing.assert_allclose(iron, 2 * haadf, atol=0.02 * iron.max())
