"""`noiseflow compare`: errors in three dimensions and in projections, shell correlation, pictures, and what it refuses."""

import tracemalloc

import mrcfile
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from noiseflow import io
from noiseflow.io import mapped
from recon.metrics.comparison import compare_volumes, project
from recon.metrics.metrics import compare, compare_images, fourier_shell_correlation, resolution
from recon.series.tilt_series import Volume
from recon.simulate.phantoms import make_phantom
from tests.commands import run_command


@pytest.fixture(scope="module")
def volumes():
    truth = make_phantom("shells", 24, generator=np.random.default_rng(0))
    noise = np.random.default_rng(1).normal(size=truth.shape).astype(np.float32)
    return truth, truth + 0.1 * noise


def write(path, array, voxel_size=10.0):
    with mrcfile.new(path, data=array.astype(np.float32)) as mrc:
        mrc.voxel_size = voxel_size
    return path


def test_command_tells_all_and_draws_it(volumes, tmp_path):
    truth, noisy = volumes
    (tmp_path / "angles.tlt").write_text("-30\n0\n45\n")
    result = run_command("compare", 
        write(tmp_path / "a.mrc", 3 * noisy - 1), write(tmp_path / "b.mrc", truth), "--angles", tmp_path / "angles.tlt",
        "--report", tmp_path / "page",
    )  # fmt: skip
    left = (
        0.01 * truth.var() / (0.01 + truth.var()) / float(np.ptp(truth)) ** 2
    )  # a least-squares gain shrinks the noise
    assert result["errors"]["affine"]["mse"] == pytest.approx(left, rel=0.05)
    assert result["errors"]["raw"]["psnr"] < result["errors"]["affine"]["psnr"] - 5
    assert set(result["projections"]) == {"raw", "affine", "min-max"}
    assert 0 < result["fsc_0.5"] < result["fsc_0.143"] <= 0.5
    page = (tmp_path / "page" / "index.html").read_text()
    assert page.count("<img") == 1  # slices; the correlation is a chart in the colours of the theme
    assert page.count("<svg") > 0


def test_projections_in_parts_are_those_of_the_whole(monkeypatch):
    volume, angles = np.random.default_rng(0).random((6, 7, 8), dtype=np.float32), np.linspace(-60, 60, 5)
    whole = project(volume, angles)
    monkeypatch.setattr(mapped, "PART", volume[:, :4].nbytes)  # four rows and two tilts at a time
    np.testing.assert_allclose(project(volume, angles), whole, rtol=1e-5)


def test_projections_are_compared_image_by_image(volumes):
    truth, noisy = volumes
    angles = np.array([-40.0, 10.0])
    found = compare_volumes(Volume(noisy), Volume(truth), tilt_angles=angles, mode="transmission").projections["affine"]
    pairs = zip(project(noisy, angles, mode="transmission"), project(truth, angles, mode="transmission"), strict=True)
    by_hand = [compare(one, other, scaling="affine") for one, other in pairs]
    assert found.psnr == pytest.approx(np.mean([errors.psnr for errors in by_hand]))
    assert found.dssim == pytest.approx(np.mean([errors.dssim for errors in by_hand]))


def test_every_image_is_scaled_by_itself():
    images = np.random.default_rng(0).random((3, 16, 16))
    gains = np.array([1.0, 5.0, 0.2])[:, None, None]
    assert compare_images(gains * images + gains, images, scaling="affine").mse == pytest.approx(0, abs=1e-20)
    with pytest.raises(ValueError, match="shapes"):
        compare_images(images, images[:2])


def test_resolution_is_where_the_curve_crosses():
    frequency = np.linspace(0, 0.5, 6)
    correlation = np.array([0.0, 1.0, 0.8, 0.4, 0.1, 0.0])
    assert resolution(frequency, correlation, 0.5) == pytest.approx(0.275)
    assert resolution(frequency, correlation, 0.143) == pytest.approx(0.3 + 0.1 * (0.4 - 0.143) / 0.3)
    assert resolution(frequency, np.ones(6), 0.5) == 0.5
    assert resolution(frequency, np.zeros(6), 0.5) == 0.0


def test_blurring_costs_resolution():
    noise = np.random.default_rng(0).normal(size=(32, 32, 32))
    other = np.random.default_rng(1).normal(size=(32, 32, 32))
    crossings = [
        resolution(*fourier_shell_correlation(gaussian_filter(noise, blur) + 0.05 * other, noise), 0.5)
        for blur in (0.7, 1.0, 1.4)
    ]
    assert crossings == sorted(crossings, reverse=True)
    # a Gaussian of width b leaves half the correlation where exp(-(2π f b)²/2) = 0.05 / √3
    expected = [np.sqrt(2 * np.log(np.sqrt(3) / 0.05)) / (2 * np.pi * blur) for blur in (1.4,)]
    assert crossings[2] == pytest.approx(expected[0], abs=0.02)


def test_what_cannot_be_compared_gets_one_clear_line(volumes, tmp_path):
    truth, noisy = volumes
    a = write(tmp_path / "a.mrc", truth)
    with pytest.raises(ValueError, match=r"24 x 24 x 24 voxels and the reference 24 x 24 x 20"):
        run_command("compare", a, write(tmp_path / "small.mrc", truth[..., :20]))
    with pytest.raises(ValueError, match="10 Å in the volume and 12 Å"):
        run_command("compare", a, write(tmp_path / "coarse.mrc", noisy, voxel_size=12.0))
    with pytest.raises(ValueError, match="give a volume \\(z, y, x\\)"):
        run_command("compare", a, write(tmp_path / "image.mrc", truth[0]))
    with pytest.raises(ValueError, match="flat"):
        run_command("compare", a, write(tmp_path / "flat.mrc", np.ones_like(truth)))
    infinite = np.where(truth > truth.mean(), np.inf, truth)[..., :20]
    with pytest.raises(ValueError, match="24 x 24 x 20"):  # without warnings of numpy
        run_command("compare", a, write(tmp_path / "infinite.mrc", infinite.astype(np.float32)))


def test_volumes_larger_than_memory_are_compared_section_by_section(tmp_path, monkeypatch):
    generator = np.random.default_rng(0)
    truth = generator.random((96, 64, 80), dtype=np.float32)
    found = truth + 0.1 * generator.standard_normal(truth.shape, dtype=np.float32)
    angles = np.array([-30.0, 0.0, 30.0])
    whole = compare_volumes(Volume(found), Volume(truth), tilt_angles=angles)
    for name, array in (("found", found), ("truth", truth)):
        np.save(tmp_path / name, array)
    mapped = [Volume(np.load(tmp_path / f"{name}.npy", mmap_mode="r")) for name in ("found", "truth")]
    for name, value in (("IN_MEMORY", 0), ("PART", 2**16)):
        monkeypatch.setattr(f"noiseflow.io.mapped.{name}", value)
    tracemalloc.start()
    try:
        parts = compare_volumes(*mapped)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < truth.nbytes
    with_angles = compare_volumes(*mapped, tilt_angles=angles)
    assert parts.volume["affine"] == pytest.approx(whole.volume["affine"])
    assert with_angles.projections["raw"].mse == pytest.approx(whole.projections["raw"].mse, rel=1e-5)
    np.testing.assert_allclose(parts.correlation, whole.correlation, atol=1e-5)


@pytest.mark.parametrize(
    ("turn", "axes", "flipped"),
    [
        (lambda v: v, None, None),
        (lambda v: v[::-1], "zyx", "z"),
        (lambda v: v[:, :, ::-1], "zyx", "x"),
        (lambda v: v.transpose(1, 0, 2), "yzx", ""),
        (lambda v: v.transpose(2, 0, 1)[:, ::-1], "yxz", "z"),
    ],
)
def test_a_flip_or_an_axis_order_that_fits_much_better_is_named(tmp_path, turn, axes, flipped, run):
    noise = np.random.default_rng(0)
    z, y, x = np.mgrid[:30, :30, :30]
    truth = np.exp(-((z - 8) ** 2 + (y - 12) ** 2 + (x - 20) ** 2) / 20).astype(np.float32)
    io.write(tmp_path / "truth.mrc", truth)
    io.write(tmp_path / "volume.mrc", np.ascontiguousarray(turn(truth + 0.02 * noise.normal(size=truth.shape))))
    found = run("compare", tmp_path / "volume.mrc", tmp_path / "truth.mrc")["better_orientation"]
    assert (axes, flipped) == (None, None) if found is None else (found["axes"], found["flipped"]) == (axes, flipped)


def test_an_axis_order_of_another_shape_is_named(tmp_path, refused):
    truth = np.random.default_rng(0).random((8, 12, 16)).astype(np.float32)
    io.write(tmp_path / "truth.mrc", truth)
    io.write(tmp_path / "volume.mrc", np.ascontiguousarray(truth.transpose(1, 0, 2)))
    assert "(y, z, x)" in refused("compare", tmp_path / "volume.mrc", tmp_path / "truth.mrc")
