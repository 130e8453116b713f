"""`noiseflow simulate`: the same series streamed as in memory, and every file in its place."""

import mrcfile
import numpy as np
import pytest
import torch

import noiseflow
from recon.projection.defocused_projector import DefocusedProjector
from recon.projection.projector import SliceProjector
from recon.series.files import read_tilt_series
from recon.simulate import simulation
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import (
    ACQUISITIONS,
    Simulation,
    add_noise,
    angles_between,
    clean_tilt_series,
    tilt_range,
)
from tests.commands import run_command


def data(path):
    with mrcfile.open(path) as mrc:
        return np.array(mrc.data)


@pytest.mark.parametrize("noise", ["clipped", "low-dose", "8-bit"])
def test_streamed_series_is_the_one_made_in_memory(tmp_path, monkeypatch, noise):
    monkeypatch.setattr("noiseflow.io.mapped.PART", 4 * 16**2 * 5)  # blocks of five slices, two tilts at a time
    angles, acquisition = tilt_range("-60:60:12"), ACQUISITIONS[noise]
    steps = []
    plan = Simulation(
        "shells", 16, {"clean": angles, "test": np.array([-50.0, 5.0])}, acquisition, acquisition.noise(), 3, 0.0
    )
    unit = plan.write(tmp_path / "new", lambda task, done, total, note: steps.append(done))
    density = make_phantom("shells", 16, generator=np.random.default_rng(3))
    clean, expected_unit = clean_tilt_series(density, angles, acquisition=acquisition)
    assert unit == pytest.approx(expected_unit, rel=1e-5)
    np.testing.assert_allclose(data(tmp_path / "new" / "clean.mrc"), clean.images, rtol=2e-5)
    np.testing.assert_allclose(data(tmp_path / "new" / "truth.mrc"), density * unit, rtol=1e-5)
    noisy = add_noise(clean, acquisition.noise(), seed=3).images
    close = np.isclose(data(tmp_path / "new" / "tilts.mrc"), noisy, rtol=1e-4, atol=1e-4)
    assert close.mean() > 0.999  # a count may fall on the other side of a rounding edge
    np.testing.assert_allclose(read_tilt_series(tmp_path / "new" / "tilts.mrc").tilt_angles, angles)
    assert steps == list(range(1, plan.num_steps + 1))


def test_judging_projections_are_at_other_angles_and_of_the_same_volume(tmp_path):
    result = run_command("simulate", tmp_path / "s", "--size", 16, "--tilts=-60:60:3")
    names = {path.name for path in (tmp_path / "s").iterdir()}
    assert names == {"options.toml"} | {f"{name}.mrc" for name in ("tilts", "clean", "validation", "test", "truth")} | {
        f"{name}.rawtlt" for name in ("tilts", "clean", "validation", "test")
    }
    assert (len(result["validation_angles"]), len(result["test_angles"])) == (14, 20)
    angles = np.concatenate([tilt_range("-60:60:3"), result["validation_angles"], result["test_angles"]])
    assert len(np.unique(angles)) == len(angles)
    truth = data(tmp_path / "s" / "truth.mrc")
    line_integrals = simulation.SliceProjector(tilt_angles=result["test_angles"], depth=16, width=16)(
        torch.from_numpy(truth)
    )
    np.testing.assert_allclose(data(tmp_path / "s" / "test.mrc"), np.exp(-line_integrals.numpy()), rtol=1e-4)


def test_clipping_puts_rails_on_any_noise(tmp_path):
    run_command("simulate", tmp_path / "s", "--size", 16, "--tilts=-60:60:12", "--noise", "gaussian", "--clip")
    images = data(tmp_path / "s" / "tilts.mrc")
    assert images.min() >= 0
    assert images.max() == 1
    assert 0.01 < (images == 1).mean() < 0.6


@pytest.mark.parametrize("kind", [noiseflow.SplineFlow, noiseflow.Gaussian])
def test_noise_of_a_fitted_model_comes_at_its_own_signals(tmp_path, kind):
    signal = torch.linspace(100, 300, 4096)
    model = kind()
    noisy = signal + 8 * torch.randn(4096, generator=torch.Generator().manual_seed(0))
    noiseflow.fit(model, signal, noisy, num_steps=30)
    noiseflow.save(model, tmp_path / "model.safetensors")
    run_command(
        "simulate", tmp_path / "s", "--size", 16, "--tilts=-60:60:12", "--noise", tmp_path / "model.safetensors"
    )
    clean, tilts = data(tmp_path / "s" / "clean.mrc"), data(tmp_path / "s" / "tilts.mrc")
    assert clean.max() == pytest.approx(300, rel=0.01)
    assert (tilts - clean)[clean > 200].std() == pytest.approx(8, rel=0.15)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--phantom", "cube"], "choose one of"),
        (["--noise", "magic"], "noise-model file"),
        (["--noise", "low-dose", "--mode", "transmission"], "with --mode transmission, choose none, clipped, gaussian"),
        (
            ["--mode", "linear"],
            "--noise clipped is for transmission; with --mode linear, choose none, low-dose or",
        ),
        (["--noise", "none", "--clip"], "choose noise with --noise"),
        (["--noise", "8-bit", "--clip"], "already has clipping limits"),
        (["--tilts=0:0:1"], "two tilts"),
        (["--defocus", -0.1], "0 to 1"),
        (["--defocus", "nan"], "0 to 1"),
        (["--size", 7], "too small; give at least 8"),
    ],
)
def test_mistakes_are_answered_and_leave_nothing(tmp_path, arguments, words):
    with pytest.raises(ValueError, match=words):
        run_command("simulate", tmp_path / "s", "--size", 16, *arguments)
    assert not list(tmp_path.rglob("*.mrc"))
    assert not list(tmp_path.rglob(".simulate*"))


def test_angles_between_tilts_are_spread_evenly():
    between = angles_between(np.arange(-60, 61, 2.0), 10, share=0.5)
    assert len(between) == 10
    assert between[0] == -59
    assert between[-1] == 59
    assert np.diff(between).max() < 1.5 * np.diff(between).min()
    assert len(angles_between(np.array([0.0, 1.0, 2.0]), 10, share=0.5)) == 2


def test_defocus_blurs_the_tilts_by_depth_and_not_the_images_to_judge_by(tmp_path, monkeypatch):
    monkeypatch.setattr("noiseflow.io.mapped.PART", 4 * 5 * 24**2)  # blocks of five slices, less than the blur reaches
    for name, options in (("sharp", []), ("blurred", ["--defocus", 0.2])):
        run_command("simulate", tmp_path / name, "--size", 24, "--tilts=-60:60:30", "--noise", "none", *options)
    truth, sharp, blurred = (
        data(tmp_path / name) for name in ("sharp/truth.mrc", "sharp/clean.mrc", "blurred/clean.mrc")
    )
    projector = SliceProjector(tilt_angles=np.arange(-60, 61, 30.0), depth=24, width=24)
    expected = np.exp(-DefocusedProjector(projector, 0.2)(torch.from_numpy(truth)).numpy())
    np.testing.assert_allclose(blurred, expected, rtol=1e-5)
    assert np.abs(blurred - sharp).max() > 0.05
    np.testing.assert_array_equal(data(tmp_path / "blurred" / "test.mrc"), data(tmp_path / "sharp" / "test.mrc"))
    np.testing.assert_array_equal(data(tmp_path / "blurred" / "tilts.mrc"), blurred)
