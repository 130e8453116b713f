"""Two tilt axes: registration, one series of both, and commands."""

import numpy as np
import pytest
import torch

import recon
from benchmarks.rays import march, view_rays
from noiseflow import io
from recon.projection.projector import SliceProjector
from recon.series.orientation import about, own_images, stacked, turned_images
from recon.series.registration import register
from recon.series.tilt_series import TiltSeries
from recon.simulate.phantoms import make_phantom
from recon.verdict.judge import judge

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # frames turned by 90° are cut

ANGLES = np.arange(-60, 61, 5.0)


def tilt(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])  # of coordinates (x, y, z)


def turn(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def pair(size=32, *, axis=93.0, offsets=(1.5, -2.0), shift=(1.0, -1.5, 0.5), sign=1.0, noise=0.3):
    """Two series of a phantom; the second by the general ray marcher, in the frame `tilt @ turn @ tilt @ (r - shift)`."""
    volume = make_phantom("shells", size, generator=np.random.default_rng(0)).astype(np.float64)
    first = SliceProjector(tilt_angles=ANGLES, depth=size, width=size, dtype=torch.float64)(torch.from_numpy(volume))
    rotation = tilt(offsets[1]) @ turn(axis) @ tilt(offsets[0])
    views = np.stack([(tilt(angle) @ rotation)[::-1, ::-1] for angle in ANGLES])
    origins, directions = view_rays(views, height=size, width=size)
    second = march(torch.from_numpy(volume), origins + torch.tensor(shift[::-1], dtype=torch.float64), directions)
    generator = np.random.default_rng(1)
    noisy = [stack.numpy() + generator.normal(0, noise * float(stack.std()), stack.shape) for stack in (first, second)]
    one = TiltSeries(noisy[0].astype(np.float32), ANGLES, 2.0, "linear")
    return one, TiltSeries(noisy[1].astype(np.float32), sign * ANGLES, 2.0, "linear"), volume


@pytest.mark.parametrize(("axis", "sign"), [(93.0, 1.0), (-84.0, -1.0)])
def test_registration_finds_rotation_shift_and_sign(axis, sign):
    one, other, _ = pair(axis=axis, sign=sign)
    found = register(one, other)
    assert found.inverted == (sign < 0)
    assert found.axis == pytest.approx(axis, abs=0.2)
    assert (found.first_offset, found.second_offset) == pytest.approx((1.5, -2.0), abs=0.3)
    np.testing.assert_allclose(found.shift[::-1], tilt(1.5) @ [1.0, -1.5, 0.5], atol=0.1)
    assert min(found.explained) > 0.9


@pytest.mark.parametrize(("axis", "sign"), [(93.0, 1.0), (-84.0, -1.0)])
def test_registered_series_agree_with_one_volume(axis, sign):
    one, other, truth = pair(axis=axis, sign=sign)
    prepared = recon.prepare(one, second_axis=other)
    series = prepared.tilt_series
    assert series.num_tilts == 50
    assert set(series.axes) == {0.0, prepared.registration.stored_axis}
    both = recon.reconstruct(series, method="sirt", num_steps=20)
    others = [recon.reconstruct(each, method="sirt", num_steps=20) for each in (one, stacked(one, other))]
    single, unregistered, registered = (
        recon.compare(each.volume.attenuation, truth, scaling="affine").psnr for each in (*others, both)
    )
    assert registered > single + 0.4  # 1 dB without the interpolation of the second series
    assert registered > unregistered + 2
    verdict = judge(series, both)
    assert verdict.grade != "bad"
    assert set(verdict.evidence) == {"first axis", "second axis"}


def test_unrelated_specimens_are_refused():
    one, *_ = pair()
    other = recon.clean_tilt_series(make_phantom("filaments", 32, generator=np.random.default_rng(3)), ANGLES)[0]
    with pytest.raises(ValueError, match="mode"):
        register(one, other)
    line = TiltSeries(1 - other.images, ANGLES, mode="linear")
    with pytest.raises(ValueError, match="one specimen"):
        register(one, line)


def test_turned_images_come_back():
    images = np.random.default_rng(0).random((3, 4, 6))
    np.testing.assert_array_equal(own_images(turned_images(images)), images)
    first = TiltSeries(np.random.default_rng(1).random((3, 6, 4)), [-30, 0, 30], mode="linear")
    second = TiltSeries(images, [-20, 0, 20], mode="linear", mask=images > 0.1)
    whole = stacked(first, second, axis=88.0)
    np.testing.assert_array_equal(about(whole, second=False).images, first.images)
    again = about(whole, second=True)
    np.testing.assert_array_equal(again.images, images)
    np.testing.assert_array_equal(again.mask, images > 0.1)
    assert again.axes is None
    mixed = whole.select(np.array([3, 0, 5, 1]))
    assert mixed.axes.tolist() == [88.0, 0.0, 88.0, 0.0]
    assert mixed.tilt_angles[mixed.rising].tolist() == [-30.0, 0.0, -20.0, 20.0]
    with pytest.raises(ValueError, match="do not fit"):
        stacked(first, first)


def test_order_of_the_tilts_does_not_matter():
    one, other, _ = pair(size=16)
    whole = stacked(one, other)
    order = np.random.default_rng(0).permutation(whole.num_tilts)
    plain = recon.reconstruct(whole, method="sirt", num_steps=5)
    mixed = recon.reconstruct(whole.select(order), method="sirt", num_steps=5)
    np.testing.assert_array_equal(mixed.volume.attenuation, plain.volume.attenuation)
    np.testing.assert_array_equal(mixed.projections, plain.projections[order])


@pytest.mark.slow
def test_one_noise_model_and_volume_of_both_axes():
    one, other, truth = pair(axis=90.0, offsets=(0.0, 0.0), shift=(0.0, 0.0, 0.0), noise=0.5)
    psnr = []
    for series in (one, stacked(one, other)):  # seeds differ by 0.3 dB
        found = [recon.reconstruct(series, seed=seed) for seed in range(3)]
        psnr.append(np.mean([recon.compare(each.volume.attenuation, truth).psnr for each in found]))
    assert psnr[1] > psnr[0] + 1
    result = found[0]
    assert result.projections.shape == (50, 32, 32)
    assert sum(1 for _ in result.noise_model.modules()) > 0


def test_commands_simulate_and_reconstruct_two_axes(tmp_path, run):
    made = run("simulate", tmp_path / "s", "--size", "24", "--tilts=-60:60:6", "--noise", "gaussian", "--dual-axis")
    assert io.read(made["tilts_second"]).data.shape == (21, 24, 24)
    options = ["--method", "sirt", "--steps", "20"]
    command = ["reconstruct", made["tilts"], "--second-axis", made["tilts_second"], "-o", tmp_path / "v.mrc", *options]
    found = run(*command)
    registration = found["second_axis"]["registration"]
    assert abs(abs(registration["axis_degrees"]) - 90) < 1
    np.testing.assert_allclose(registration["shift_zyx_pixels"], 0, atol=0.2)
    truth = io.read(made["truth"]).data
    single = run("reconstruct", made["tilts"], "-o", tmp_path / "w.mrc", *options)
    assert single["second_axis"] is None
    psnr = [recon.compare(io.read(tmp_path / name).data, truth, scaling="affine").psnr for name in ("w.mrc", "v.mrc")]
    assert psnr[1] > psnr[0] + 0.7


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--slices-at-once", "8"], "blocks"),
        (["--method", "wbp"], "does not support"),
        (["--defocus", "0.1", "--method", "l2"], "one tilt axis"),
        (["--alignment", "a.json"], "one series"),
    ],
)
def test_what_two_axes_do_not_allow_is_refused(tmp_path, options, message):
    from tests.commands import run_command

    one, other, _ = pair(size=16)
    for name, series in (("a", one), ("b", other)):
        recon.write_tilt_series(tmp_path / f"{name}.mrc", series)
    recon.write_alignment(tmp_path / "a.json", recon.Alignment(0.0, np.zeros((25, 2)), ANGLES))
    options = [tmp_path / each if each == "a.json" else each for each in options]
    command = ["reconstruct", tmp_path / "a.mrc", "--second-axis", tmp_path / "b.mrc", "-o", tmp_path / "v.mrc"]
    with pytest.raises(ValueError, match=message):
        run_command(*command, "--mode", "linear", *options)
