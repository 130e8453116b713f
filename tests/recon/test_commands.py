"""The commands end to end, and what they answer to bad input."""

import json
import shutil

import mrcfile
import numpy as np
import pytest

import noiseflow
from noiseflow import io
from tests.commands import run_command


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    folder = tmp_path_factory.mktemp("series") / "new"
    run_command("simulate", folder, "--size", 16, "--tilts=-60:60:6")
    return folder


@pytest.fixture(scope="module")
def scaled(series, tmp_path_factory):
    stack = tmp_path_factory.mktemp("scaled") / "tilts.mrc"
    with mrcfile.open(series / "tilts.mrc") as tilts:
        io.write(stack, tilts.data, voxel_size=(7.5, 7.5, 7.5))
    shutil.copy(series / "tilts.rawtlt", stack.with_suffix(".rawtlt"))
    return stack


def psnr_of_volume_with_report(series, scaled, folder, method, *more):
    """PSNR, dB, of the volume a command wrote; its file and its page are as they should be."""
    out, page = folder / "volume.mrc", folder / "report"
    result = run_command("reconstruct", scaled, "-o", out, "--method", method, *more, "--report", page)
    assert result["method"] == method
    with mrcfile.open(out) as volume:
        assert volume.data.shape == (16, 16, 16)
        assert float(volume.voxel_size.z) == pytest.approx(7.5)
        assert np.isfinite(volume.data).all()
    assert 'data-widget="volume"' in (page / "index.html").read_text(encoding="utf-8")
    return run_command("compare", out, series / "truth.mrc")["errors"]["affine"]["psnr"]


@pytest.mark.parametrize("method", ["l2", "tv", "sirt", "wbp"])
def test_every_method_writes_a_volume_and_a_report(series, scaled, tmp_path, method):
    few_steps = [] if method == "wbp" else ["--steps", 20]
    assert psnr_of_volume_with_report(series, scaled, tmp_path, method, *few_steps) > 5


def test_joint_fits_of_the_same_seed_write_the_same_volume(series, scaled, tmp_path):
    options = ["--weight", 0.4, "--steps", 5, "--seed", 3]
    assert psnr_of_volume_with_report(series, scaled, tmp_path, "joint", *options) > 5
    run_command("reconstruct", scaled, "-o", tmp_path / "again.mrc", *options)
    first, again = (io.read(tmp_path / name).data for name in ("volume.mrc", "again.mrc"))
    np.testing.assert_array_equal(first, again)


def test_maps_of_a_detector_correct_the_images(series, tmp_path):
    shutil.copy(series / "tilts.rawtlt", tmp_path / "raw_tilts.rawtlt")
    shutil.copy(series / "tilts.rawtlt", tmp_path / "corrected_tilts.rawtlt")
    images = io.read(series / "tilts.mrc").data
    generator = np.random.default_rng(0)
    gain, offset = generator.uniform(0.5, 2, images.shape[1:]), generator.uniform(0, 3, images.shape[1:])
    camera = noiseflow.WithMaps(noiseflow.Digitised(noiseflow.Gaussian(0.05), 0.01), gain, offset)
    for name, stack, model in (
        ("raw", gain * images + offset, camera),
        ("corrected", images, noiseflow.Gaussian(0.05)),
    ):
        np.save(tmp_path / f"{name}_tilts.npy", stack.astype(">f4"))
        noiseflow.save(model, tmp_path / f"{name}.safetensors")
        options = ["--method", "joint-supervised", "--noise-model", tmp_path / f"{name}.safetensors"]
        options += ["--weight", 0.4, "--steps", 30]
        run_command("reconstruct", tmp_path / f"{name}_tilts.npy", "-o", tmp_path / f"{name}.npy", *options)
    found, wanted = (np.load(tmp_path / f"{name}.npy") for name in ("raw", "corrected"))
    assert np.abs(found - wanted).max() < 1e-3 * np.ptp(wanted)


def test_inverted_tilt_mirrors_the_volume(series, tmp_path):
    for name, more in (("a.npy", []), ("b.npy", ["--invert-tilt"])):
        run_command("reconstruct", series / "tilts.mrc", "-o", tmp_path / name, "--method", "wbp", *more)
    np.testing.assert_allclose(np.load(tmp_path / "a.npy")[::-1], np.load(tmp_path / "b.npy"), atol=1e-5)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda images, angles: (images, angles[:-1]), "21 images, but there are 20"),
        (lambda images, angles: (np.where(images == images.min(), np.nan, images), angles), "NaN"),
        (lambda images, angles: (np.full_like(images, 0.5), angles), "flat"),
        (lambda images, angles: (images[0], angles), "one image"),
    ],
)
def test_bad_series_gives_one_clear_line_and_no_volume(series, tmp_path, damage, words):
    with mrcfile.open(series / "tilts.mrc") as stack:
        images = stack.data.copy()
    images, angles = damage(images, np.loadtxt(series / "tilts.rawtlt"))
    np.save(tmp_path / "bad.npy", images)
    np.savetxt(tmp_path / "bad.tlt", angles)
    with pytest.raises(ValueError, match=words):
        run_command("reconstruct", tmp_path / "bad.npy", "-o", tmp_path / "out.mrc")
    assert not (tmp_path / "out.mrc").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "magic"], "choose one of"),
        (["--mode", "sem"], "linear"),
        (["--weight", "-1"], "zero or more"),
        (["--thickness", "0"], "thickness"),
        (["--noise-model", "none.safetensors"], "none.safetensors"),
    ],
)
def test_bad_options_give_one_clear_line(series, tmp_path, arguments, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        run_command("reconstruct", series / "tilts.mrc", "-o", tmp_path / "out.mrc", *arguments)
    assert not (tmp_path / "out.mrc").exists()


def test_output_that_cannot_be_written_is_refused_before_the_work(series, tmp_path):
    with pytest.raises(FileNotFoundError, match="create the folder"):
        run_command("reconstruct", series / "tilts.mrc", "-o", tmp_path / "none" / "out.mrc")


def test_strict_makes_a_bad_verdict_an_error_after_the_volume_is_written(tmp_path, capsys):
    run_command("simulate", tmp_path / "new", "--size", 24)
    angles = np.random.default_rng(0).permutation(io.read_tilts(tmp_path / "new" / "tilts.rawtlt").angles)
    np.savetxt(tmp_path / "wrong.tlt", angles, fmt="%.2f")
    out = tmp_path / "volume.mrc"
    words = ["reconstruct", tmp_path / "new" / "tilts.mrc", "-o", out, "--method", "sirt", "--strict", "--angles"]
    assert run_command(*words, tmp_path / "new" / "tilts.rawtlt")["verdict"]["grade"] == "good"
    out.unlink()
    with pytest.raises(ValueError, match=r"--strict: bad verdict \(.* is written\)"):
        run_command(*words, tmp_path / "wrong.tlt")
    effects = json.loads(capsys.readouterr().out.splitlines()[-1])["verdict"]["evidence"].values()
    assert "angles" in {effect["reason"] for effect in effects if effect["cost"] > 1}
    assert io.read(out).data.shape == (24, 24, 24)
