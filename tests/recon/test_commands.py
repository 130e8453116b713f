"""The commands end to end, and what they answer to bad input."""

import json

import mrcfile
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from recon import cli


def program():
    app = typer.Typer(pretty_exceptions_enable=False)
    for command in (cli.simulate, cli.reconstruct, cli.compare):
        app.command(command.__name__)(command)
    return app


def run(*arguments):
    result = CliRunner().invoke(program(), [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return json.loads(result.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    folder = tmp_path_factory.mktemp("series") / "new"
    run("simulate", folder, "--size", 16, "--tilts=-60:60:6", "--json")
    return folder


@pytest.mark.parametrize("method", ["joint", "l2", "tv", "sirt", "wbp"])
def test_every_method_writes_a_volume_and_a_report(series, tmp_path, method):
    with mrcfile.open(series / "tilts.mrc", "r+") as stack:
        stack.voxel_size = 7.5
    out, page = tmp_path / "volume.mrc", tmp_path / "report"
    result = run(
        "reconstruct", series / "tilts.mrc", "-o", out, "--method", method, "--steps", 20, "--report", page, "--json"
    )
    assert result["method"] == method
    with mrcfile.open(out) as volume:
        assert volume.data.shape == (16, 16, 16)
        assert float(volume.voxel_size.z) == pytest.approx(7.5)
        assert np.isfinite(volume.data).all()
    assert 'data-widget="volume"' in (page / "index.html").read_text(encoding="utf-8")
    assert run("compare", out, series / "truth.mrc", "--json")["errors"]["affine"]["psnr"] > 5


def test_response_of_every_tilt_is_told(series, tmp_path):
    command = ["reconstruct", series / "tilts.mrc", "-o", tmp_path / "v.npy", "--method", "l2", "--weight", 0.3]
    result = run(*command, "--steps", 20, "--defocus", 0.1, "--json")
    told = result["response"]
    assert len(told["tilt_angles"]) == len(told["intensity"]) == len(told["offset"]) == 21
    assert all(0.8 < value < 1.2 for value in told["intensity"])
    assert result["choices"]["defocus"].startswith("0.1, blurs up to")
    assert run(*command[:3], tmp_path / "s.npy", "--method", "sirt", "--steps", 3, "--json")["response"] is None


def test_same_seed_same_volume(series, tmp_path):
    for name in ("a.npy", "b.npy"):
        run(
            "reconstruct",
            series / "tilts.mrc",
            "-o",
            tmp_path / name,
            "--steps",
            5,
            "--weight",
            0.4,
            "--seed",
            3,
            "--json",
        )
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))


def test_inverted_tilt_mirrors_the_volume(series, tmp_path):
    for name, more in (("a.npy", []), ("b.npy", ["--invert-tilt"])):
        run("reconstruct", series / "tilts.mrc", "-o", tmp_path / name, "--method", "wbp", *more, "--json")
    np.testing.assert_allclose(np.load(tmp_path / "a.npy")[::-1], np.load(tmp_path / "b.npy"), atol=1e-5)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda images, angles: (images, angles[:-1]), "21 images and there are 20"),
        (lambda images, angles: (np.where(images == images.min(), np.nan, images), angles), "NaN"),
        (lambda images, angles: (np.full_like(images, 0.5), angles), "flat"),
        (lambda images, angles: (images[0], angles), "one image"),
        (lambda images, angles: (-1 - images, angles), "linear"),
    ],
)
def test_bad_series_gives_one_clear_line_and_no_volume(series, tmp_path, damage, words):
    with mrcfile.open(series / "tilts.mrc") as stack:
        images = stack.data.copy()
    images, angles = damage(images, np.loadtxt(series / "tilts.rawtlt"))
    np.save(tmp_path / "bad.npy", images)
    np.savetxt(tmp_path / "bad.tlt", angles)
    with pytest.raises(ValueError, match=words):
        run("reconstruct", tmp_path / "bad.npy", "-o", tmp_path / "out.mrc")
    assert not (tmp_path / "out.mrc").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "magic"], "choose one of"),
        (["--mode", "haadf"], "linear"),
        (["--weight", "-1"], "zero or more"),
        (["--thickness", "0"], "thickness"),
        (["--noise-model", "none.safetensors"], "none.safetensors"),
    ],
)
def test_bad_options_give_one_clear_line(series, tmp_path, arguments, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        run("reconstruct", series / "tilts.mrc", "-o", tmp_path / "out.mrc", *arguments)
    assert not (tmp_path / "out.mrc").exists()


def test_output_that_cannot_be_written_is_refused_before_the_work(series, tmp_path):
    with pytest.raises(FileNotFoundError, match="create the folder"):
        run("reconstruct", series / "tilts.mrc", "-o", tmp_path / "none" / "out.mrc")
