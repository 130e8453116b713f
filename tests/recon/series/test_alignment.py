"""Raw series, rotated and shifted by known amounts, are aligned to a fraction of a pixel."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import rotate

from recon.projection.classical import sirt
from recon.projection.projector import SliceProjector
from recon.series.alignment import Alignment
from recon.series.alignment_search import AxisUndetermined, find_alignment
from recon.series.files import read_tilt_series
from recon.series.prepare import prepare
from recon.series.tilt_series import TiltSeries
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series

ANGLES = np.arange(-60, 61, 4.0)


def blobs(axis, shifts, *, shape=(40, 40), noise=0.05, mode="linear", seed=0):
    """Projections of Gaussian blobs, exactly, as a microscope with this axis (degrees) and these shifts (y, x) sees them."""
    generator = np.random.default_rng(seed)
    centres = generator.uniform(-0.28, 0.28, (14, 3)) * min(shape)  # z, y, x
    widths = generator.uniform(1.2, 2.5, 14)
    theta, axis = np.deg2rad(ANGLES), np.deg2rad(axis)
    rows, columns = (np.arange(size) - (size - 1) / 2 for size in shape)
    images = np.zeros((len(ANGLES), *shape))
    for (z, y, x), width in zip(centres, widths, strict=True):
        u = x * np.cos(theta) + z * np.sin(theta)
        down = y * np.cos(axis) + u * np.sin(axis) + shifts[:, 0]
        across = u * np.cos(axis) - y * np.sin(axis) + shifts[:, 1]
        squares = (rows - down[:, None])[:, :, None] ** 2 + (columns - across[:, None])[:, None, :] ** 2
        images += np.exp(-squares / (2 * width**2))
    if mode == "transmission":
        images = 100 * np.exp(-images / images.max())
        noise *= 30
    images += noise * generator.normal(size=images.shape)
    return TiltSeries(images.astype(np.float32), ANGLES, 2.0, mode)


def shift_errors(found, axis, shifts):
    """Root mean squares along and across the axis, without what only moves the object."""
    axis, theta = np.deg2rad(axis), np.deg2rad(ANGLES)
    error = found.shifts - shifts
    along = error @ [np.cos(axis), -np.sin(axis)]
    across = error @ [np.sin(axis), np.cos(axis)]
    moves = np.stack([np.cos(theta), np.sin(theta)], 1)
    across = across - moves @ np.linalg.lstsq(moves, across, rcond=None)[0]
    return along.std(), np.sqrt(np.mean(across**2))


def random_shifts(size=3.0, offset=(0.0, 2.5)):
    return np.random.default_rng(5).uniform(-size, size, (len(ANGLES), 2)) + offset


@pytest.mark.parametrize(
    ("axis", "shape", "mode", "seed"),
    [
        (-79.0, (28, 28), "linear", 0),
        pytest.param(4.0, (40, 40), "linear", 0, marks=pytest.mark.slow),
        pytest.param(-5.0, (48, 36), "transmission", 0, marks=pytest.mark.slow),
        pytest.param(
            -5.0, (48, 36), "transmission", 2, marks=pytest.mark.slow
        ),  # equal to -36° until both are refined again
    ],
)
def test_shifts_axis_and_offset_are_found(axis, shape, mode, seed):
    shifts = random_shifts()
    found = find_alignment(blobs(axis, shifts, shape=shape, mode=mode, seed=seed))
    assert found.tilt_axis == pytest.approx(axis, abs=2.5)  # half a pixel at the edge of what is there
    along, across = shift_errors(found, axis, shifts)
    assert along < 0.2
    assert across < 0.2


@pytest.mark.slow
def test_known_axis_is_kept_to_and_large_shifts_are_found():
    shifts = random_shifts(8.0)
    found = find_alignment(blobs(2.0, shifts, shape=(56, 56), seed=3), tilt_axis=0.0)
    assert found.tilt_axis == pytest.approx(2.0, abs=1.0)
    assert max(shift_errors(found, 2.0, shifts)) < 0.3


def test_an_object_far_from_the_axis_is_moved_onto_it():
    theta = np.deg2rad(ANGLES)
    drift = 7 * np.cos(theta) - 5 * np.sin(theta)
    raw = blobs(0.0, np.stack([0 * theta, drift], 1), shape=(48, 48))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        aligned = find_alignment(raw, tilt_axis=0.0).apply(raw)
    volume = sirt(aligned.images, SliceProjector(tilt_angles=ANGLES, depth=48, width=48), num_iterations=20)
    place = np.arange(48) - 23.5
    for others in ((1, 2), (0, 1)):
        mass = volume.sum(others)
        assert abs(mass @ place / mass.sum()) < 2  # noise that SIRT keeps positive fills the field, unevenly


def test_aligned_images_are_those_of_an_aligned_microscope():
    shifts = random_shifts(2.0)
    raw = blobs(5.0, shifts, noise=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        aligned = Alignment(5.0, shifts, ANGLES).apply(raw)
    wanted = blobs(0.0, np.zeros_like(shifts), noise=0.0)
    error = np.abs(aligned.images - wanted.images)[aligned.used]
    assert error.max() < 0.02 * wanted.images.max()
    assert 0.7 < aligned.used.mean() < 1


def test_quarter_turn_swaps_the_sides_and_keeps_the_readings():
    images = np.random.default_rng(0).integers(0, 1000, (3, 5, 8), dtype=np.uint16)
    series = TiltSeries(images, np.array([-10.0, 0.0, 10.0]), 1.0, "linear")
    turned = Alignment(-90.0, np.zeros((3, 2)), series.tilt_angles).apply(series)
    assert turned.images.dtype == np.uint16
    assert turned.mask is None
    np.testing.assert_array_equal(turned.images, np.rot90(images, -1, axes=(1, 2)))
    same = Alignment(0.0, np.zeros((3, 2)), series.tilt_angles).apply(series)
    np.testing.assert_array_equal(same.images, images)


def test_axis_offset_is_told_apart_from_where_the_object_is():
    theta = np.deg2rad(ANGLES)
    across = 2.5 + 4 * np.cos(theta) - 7 * np.sin(theta)
    assert Alignment(0.0, np.stack([0 * across, across], 1), ANGLES).axis_offset == pytest.approx(2.5)
    assert Alignment(90.0, np.stack([across, 0 * across], 1), ANGLES).axis_offset == pytest.approx(2.5)


def test_few_tilts_and_images_moved_out_of_view_are_refused():
    series = TiltSeries(np.random.default_rng(0).random((4, 8, 8)), np.arange(4.0) * 5, mode="linear")
    with pytest.raises(ValueError, match="too few"):
        find_alignment(series)
    with pytest.raises(ValueError, match="out of view"):
        Alignment(0.0, np.full((4, 2), 9.0), series.tilt_angles).apply(series)
    with pytest.raises(ValueError, match="shifts do not match"):
        Alignment(0.0, np.zeros((3, 2)), series.tilt_angles).apply(series)


def test_command_aligns_and_reports(tmp_path, run):
    shifts = random_shifts(2.0)
    np.save(tmp_path / "raw.npy", blobs(3.0, shifts, shape=(24, 24)).images)
    np.savetxt(tmp_path / "raw.tlt", ANGLES)
    command = ["reconstruct", tmp_path / "raw.npy", "-o", tmp_path / "v.npy", "--mode", "linear", "--method", "wbp"]
    result = run(*command, "--refine-alignment", "--tilt-axis", 0, "--report", tmp_path / "report")
    alignment = result["alignment"]
    assert result["choices"]["tilt axis (°)"] == f"{alignment['tilt_axis_degrees']:.2f}"
    assert len(alignment["shifts_yx_pixels"]) == len(ANGLES)
    assert "axis offset (pixels)" in result["choices"]
    assert "axis offset" in (tmp_path / "report" / "index.html").read_text()
    only_turned = run(*command, "--tilt-axis", 90)
    assert only_turned["alignment"]["tilt_axis_degrees"] == 90
    assert run(*command)["alignment"] is None


@pytest.mark.slow
def test_raw_microscope_file_becomes_a_volume_in_one_command(tmp_path, run, data):
    raw = data.parent.parent.parent / "shared" / "data" / "tilt_needle" / "needle_raw.dm3"
    if not raw.exists():
        pytest.skip("the raw series is not at hand")
    options = ["--mode", "linear", "--refine-alignment", "--method", "sirt"]
    result = run("reconstruct", raw, "-o", tmp_path / "volume.mrc", *options)
    assert abs(result["alignment"]["tilt_axis_degrees"]) == pytest.approx(79.75, abs=0.7)
    aligned = read_tilt_series(raw.with_name("needle_aligned.mrc"), mode="linear")
    assert float(result["figures"]["residual rms"]) < 0.05 * aligned.images.std()


def revolution(kind, size=32, axis=30.0):
    """Equal images at all angles: a body of revolution about the tilt axis, or a ball, shifted from tilt to tilt."""
    generator = np.random.default_rng(0)
    y, x = np.meshgrid(*(np.arange(size) - (size - 1) / 2,) * 2, indexing="ij")
    theta, images = np.deg2rad(axis), []
    for down, right in generator.uniform(-0.06, 0.06, (len(ANGLES), 2)) * size:
        along = (y - down) * np.cos(theta) - (x - right) * np.sin(theta)
        across = (y - down) * np.sin(theta) + (x - right) * np.cos(theta)
        length, radius = {"rod": (0.35, 0.12), "ball": (0.3, 0.3)}[kind]
        ends = 0 if kind == "rod" else (along / length / size) ** 2
        thickness = np.sqrt(np.maximum(1 - (across / radius / size) ** 2 - ends, 0))
        images.append(thickness * (np.abs(along) <= length * size) * size * radius)
    images = np.stack(images) + 0.02 * np.max(images) * generator.normal(size=(len(ANGLES), size, size))
    return TiltSeries(images.astype(np.float32), ANGLES, None, "linear")


@pytest.mark.parametrize("kind", ["rod", "ball"])
def test_images_that_fit_any_axis_are_no_answer(kind):
    series = revolution(kind)
    with pytest.raises(AxisUndetermined, match="--tilt-axis") as caught:
        find_alignment(series)
    first, second = caught.value.candidates[:2]
    assert abs((first.axis - second.axis + 90) % 180 - 90) >= 20
    for named in (first, second):
        assert f"--tilt-axis {named.axis:.0f}" in str(caught.value)


@pytest.mark.slow
def test_noise_that_a_volume_fits_does_not_turn_the_axis_of_a_dense_slab():
    angles, acquisition = np.arange(-70, 71, 3.0), ACQUISITIONS["low-dose"]
    clean, _ = clean_tilt_series(
        make_phantom("slab", 64, generator=np.random.default_rng(1)), angles, acquisition=acquisition
    )
    turned = rotate(
        clean.images.astype(float), 33.0, axes=(2, 1), reshape=False, order=3, cval=clean.images.min()
    ).clip(0)
    found = find_alignment(add_noise(replace(clean, images=turned), acquisition.noise(), seed=1))
    assert abs(found.tilt_axis) == pytest.approx(33.0, abs=1.5)  # unsmoothed, 8° and more off


def test_a_stated_axis_decides_where_the_images_do_not():
    found = find_alignment(replace(revolution("rod"), tilt_axis=27.0))
    assert found.tilt_axis == pytest.approx(30, abs=6)
    with pytest.raises(ValueError, match="determine"):
        prepare(revolution("rod"), refine_alignment=True)


def test_a_wrong_axis_is_contradicted_by_the_images():
    shifts = random_shifts(2.0)
    raw = blobs(10.0, shifts, shape=(28, 28))
    with pytest.warns(UserWarning, match="the given direction is used"):
        kept = find_alignment(raw, tilt_axis=100.0)
    assert kept.tilt_axis == pytest.approx(100, abs=20)
    assert kept.margin < 0
    with pytest.warns(UserWarning, match="the direction from the images is used"):
        found = find_alignment(replace(raw, tilt_axis=100.0))
    assert (found.tilt_axis - 10 + 90) % 180 - 90 == pytest.approx(0, abs=2.5)
    assert found.margin > 4
    assert max(shift_errors(found, 10.0, shifts)) < 0.3


def test_masked_pixels_do_not_mislead_the_alignment():
    shifts = random_shifts(2.0)
    raw = blobs(2.0, shifts, shape=(28, 28))
    images, mask = raw.images.copy(), np.ones(raw.images.shape, dtype=bool)
    images[:, 10:13, 5:9], mask[:, 10:13, 5:9] = images.max() * 3, False
    found = find_alignment(replace(raw, images=images, mask=mask), tilt_axis=0.0)
    assert max(shift_errors(found, 2.0, shifts)) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("hint", [None, 90.0])
def test_raw_needle_is_aligned_or_its_axis_asked_for(hint):
    raw = Path(__file__).parents[4] / "shared" / "data" / "tilt_needle_256" / "needle_256_raw.mrc"
    if not raw.exists():
        pytest.skip("the raw series is not at hand")
    series = replace(read_tilt_series(raw, mode="linear"), tilt_axis=None)
    found = find_alignment(series, tilt_axis=hint)
    assert (found.tilt_axis - 92.8 + 90) % 180 - 90 == pytest.approx(0, abs=2)
    assert found.residual < 0.01


def test_a_raw_series_whose_file_states_another_axis_is_asked_to_be_aligned():
    raw = replace(blobs(90.0, random_shifts(6.0), shape=(28, 28)), tilt_axis=90.0)
    with pytest.raises(ValueError, match=r"axis of 90°.*do not fit.*--refine-alignment.*--tilt-axis 0"):
        prepare(raw)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="do not fit"):  # as before, where the axis is said to be along y
            prepare(raw, tilt_axis=0.0)
    aligned = replace(
        blobs(0.0, np.zeros((len(ANGLES), 2)), shape=(28, 28)), tilt_axis=90.0
    )  # the title is of the raw one
    with pytest.warns(UserWarning, match=r"assumed to be aligned.*--refine-alignment"):
        assert prepare(aligned).alignment is None


def test_an_alignment_of_one_tilt_lacks_the_others():
    one = Alignment(0.0, np.zeros((1, 2)), np.array([10.0]))
    with pytest.raises(ValueError, match="no tilt at 20°"):
        one.order_of(TiltSeries(np.random.default_rng(0).random((2, 8, 8)), np.array([10.1, 20.0])))


@pytest.mark.parametrize("shape", [(1, 16), (1, 24)])  # the last is lower than its coarsest binning
def test_a_row_and_a_tilt_that_shows_nothing_are_aligned_without_a_fault(shape: tuple[int, int]) -> None:
    images = np.zeros((25, *shape), np.float32)
    images[:, :, 5:9] = 1.0
    images[3] = 0.0
    found = find_alignment(TiltSeries(images, np.arange(-60, 61, 5.0), mode="linear"), tilt_axis=0.0)
    assert np.isfinite(found.shifts).all()
