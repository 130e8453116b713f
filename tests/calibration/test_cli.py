"""`noiseflow calibrate` end to end, and one clear line for each bad input."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import noiseflow
from calibration.detector.models import KINDS, SIMPLE
from calibration.report.exports import read_series
from noiseflow.commands.cli import main
from noiseflow.io import write

from . import simulators as sim
from .conftest import textured_scene

PARTS = (
    *("Photon transfer", "Posterior of gain", "Residuals of the held-out pixels", "QQ", "PIT", "row and column"),
    *("before and after registration", "Verdict", "suffices", "registered to within", "excess noise"),
)
"""What a reader of the report must find."""

RANDOM = np.random.default_rng(1)


@pytest.fixture
def folder(tmp_path, exposures):
    """Good and broken exposures in files, with an empty folder beside them for the output."""
    (tmp_path / "out").mkdir()
    files = {
        "short": exposures.short,
        "long": exposures.long,
        "narrow": exposures.long[:, :-1],
        "flat": np.full_like(exposures.short, 7),
        "nan": np.where(np.indices(exposures.short.shape).sum(0) == 5, np.nan, exposures.short),
        "noise": RANDOM.poisson(50, exposures.short.shape),
        "saturated": np.where(RANDOM.random(exposures.short.shape) < 0.8, 4095, exposures.short),
        "stack3": np.stack([exposures.short] * 5),
        "copy": exposures.short,
        "scaled": 3 * exposures.short + 7,
        "elsewhere": 200 + 400 * textured_scene(np.random.default_rng(77), 192)(*np.mgrid[:192, :192].astype(float)),
    }
    for name, data in files.items():
        write(tmp_path / f"{name}.tif", data.astype(np.float32))
    write(tmp_path / "white.tif", np.full(exposures.short.shape, 65535, np.uint16))
    write(tmp_path / "rgb.tif", np.stack([exposures.short.clip(0, 255)] * 3, -1).astype(np.uint8))
    whole = (tmp_path / "short.tif").read_bytes()
    (tmp_path / "truncated.tif").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.tif").write_bytes(b"")
    return tmp_path


def kind_of(model) -> str:
    """The class of a model, behind the converter."""
    return type(model.model if isinstance(model, noiseflow.Digitised) else model).__name__


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", *arguments])
    return int(stopped.value.code or 0)


@pytest.mark.parametrize(
    ("short", "long", "message"),
    [
        ("missing", "long", "does not exist"),
        ("empty", "long", "empty"),
        ("truncated", "long", "damaged or truncated"),
        ("short", "narrow", "sizes must agree"),
        ("nan", "long", "NaN"),
        ("flat", "long", "flat"),
        ("saturated", "long", "saturated"),
        ("white", "long", "saturated"),
        ("short", "white", "saturated"),
        ("rgb", "long", "colour"),
        ("short", "rgb", "colour"),
        ("copy", "short", "identical pixels"),
        ("short", "scaled", "copy"),
        ("short", "elsewhere", "cannot be registered"),
        ("stack3", "long", "single 2D frame"),
        ("short", "short", "both short and long"),
        ("long", "short", "exchange the two"),
        ("noise", "long", "cannot be registered"),
    ],
)
def test_bad_exposures_give_one_line_and_no_file(folder, capsys, short, long, message):
    code = run(
        "--short", f"{folder}/{short}.tif", "--long", f"{folder}/{long}.tif", "-o", f"{folder}/out/m.safetensors"
    )
    error = capsys.readouterr().err.strip()
    assert code == 1
    assert message in error
    assert "\n" not in error
    assert list((folder / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (("--exposure-ratio", "0.5"), "above 1"),
        (("--exposure-ratio", "1"), "above 1"),
        (("--exposure-ratio", "-2"), "above 1"),
        (("--kind", "gauss"), "unknown kind"),
        (("--device", "tpu"), "choose auto"),
    ],
)
def test_bad_options_are_refused_before_any_work(folder, capsys, extra, message):
    files = ("--short", f"{folder}/short.tif", "--long", f"{folder}/long.tif", "-o", f"{folder}/out/m.safetensors")
    assert run(*files, *extra) == 1
    assert message in capsys.readouterr().err
    assert list((folder / "out").iterdir()) == []


def test_pair_in_model_and_report_out(folder, capsys, monkeypatch):
    monkeypatch.setattr("calibration.detector.models.NUM_STEPS", 100)
    model, report = folder / "out" / "m.safetensors", folder / "out" / "report"
    files = (
        "--short",
        f"{folder}/short.tif",
        "--long",
        f"{folder}/long.tif",
        "-o",
        str(model),
        "--report",
        str(report),
    )
    assert run(*files, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["models"]) == set(SIMPLE)  # nothing is left to improve
    assert {"nll", "jsd", "jsd_floor", "bc", "bd"} <= set(result["models"]["poisson-gaussian"])
    assert result["verdict"]["subjects"] == []  # so small a pair tells it to 8 %
    assert {"rms_px", "inliers", "matrix"} <= set(result["registration"][0])
    for name in ("gain", "offset", "read_noise"):
        assert result["detector"][name]["q05"] <= result["detector"][name]["median"] <= result["detector"][name]["q95"]
    assert result["detector"]["gain"]["median"] == pytest.approx(2.0, rel=0.1)
    assert result["models"][result["kind"]]["excess"] <= result["models"][result["kind"]]["excess_error"]
    assert result["models"]["gaussian"]["excess"] > 4 * result["models"]["gaussian"]["excess_error"]
    assert kind_of(noiseflow.load(model)) == KINDS[result["kind"]].cls
    exported = json.loads((report / "detector.json").read_text(encoding="utf-8"))
    assert 1 / exported["getframes"]["gain_e_per_adu"] == pytest.approx(result["detector"]["gain"]["median"])
    page = (report / "report.html").read_text()
    assert page.count("data:image/png") == 7
    assert all(part in page for part in PARTS)
    assert "excess noise" in result["detector"]["caveat"]


@pytest.mark.parametrize("verbose", [False, True])
def test_exposures_in_order_are_a_short_and_a_long_one_and_the_answer_comes_first(folder, capsys, monkeypatch, verbose):
    """Verdict, figures and file in three lines; every model that was tried only on request."""
    monkeypatch.setattr("calibration.detector.models.NUM_STEPS", 40)
    model = folder / "out" / "m.safetensors"
    files = (f"{folder}/short.tif", f"{folder}/long.tif", "-o", str(model), "--kind", "signal-gaussian")
    assert run(*files, *["--verbose"] * verbose) == 0
    assert kind_of(noiseflow.load(model)) == "SignalDependentGaussian"
    first, second, third, *rest = capsys.readouterr().out.splitlines()
    assert re.search("good|doubtful|bad", first)
    assert all(name in second for name in ("gain", "offset", "read noise"))
    assert str(model) in third
    assert any("held-out NLL" in line for line in rest) == verbose


@pytest.mark.parametrize("words", [("short", "long", "long"), ("short", "--long", "long"), ("--long", "long")])
def test_exposures_that_are_named_in_part_are_refused_in_one_line(folder, capsys, words):
    named = [word if word.startswith("-") else f"{folder}/{word}.tif" for word in words]
    assert run(*named, "-o", f"{folder}/out/m.safetensors") == 1
    error = capsys.readouterr().err.strip()
    assert "--short" in error
    assert "\n" not in error


def test_burst_with_dark_frames(folder, capsys, monkeypatch, exposures):
    monkeypatch.setattr("calibration.detector.models.NUM_STEPS", 20)
    electrons = (exposures.signal - 100) / 2
    noise = RANDOM.standard_normal
    frames = [100 + 2 * (RANDOM.poisson(electrons) + noise(electrons.shape)) for _ in range(3)]
    write(folder / "burst.tif", np.round(frames).astype(np.uint16))
    write(folder / "dark.tif", np.round(100 + 2 * noise((3, *electrons.shape))).astype(np.uint16))
    files = ("--short", f"{folder}/burst.tif", "--dark", f"{folder}/dark.tif", "-o", f"{folder}/out/m.safetensors")
    assert run(*files, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["burst"]["drifting"] is False
    assert result["detector"]["read_noise"]["median"] == pytest.approx(1.0, rel=0.1)
    assert result["detector"]["gain"]["median"] == pytest.approx(2.0, rel=0.05)


def test_one_frame_alone_is_refused(folder, capsys):
    assert run("--short", f"{folder}/short.tif", "-o", f"{folder}/out/m.safetensors") == 1
    assert "only one frame" in capsys.readouterr().err
    assert list((folder / "out").iterdir()) == []


def test_a_burst_that_blinks_is_refused_in_one_line(folder, capsys):
    frames = []
    for _ in range(5):
        lit = np.where(RANDOM.random((128, 128)) < 1e-3, 2500.0, 0.0)
        frames.append(RANDOM.poisson(20 + ndimage.gaussian_filter(lit, 1.3)))
    write(folder / "blinking.tif", np.stack(frames).astype(np.uint16))
    assert run("--short", f"{folder}/blinking.tif", "-o", f"{folder}/out/m.safetensors") == 1
    error = capsys.readouterr().err.strip()
    assert "blinking.tif: the scene changes between frames" in error
    assert "\n" not in error
    assert list((folder / "out").iterdir()) == []


def test_a_region_of_all_frames_is_used_alone(folder, capsys):
    gain = np.where(np.arange(128) < 64, 2.0, 3.0)
    for level in (0, 200, 1000, 4000):
        electrons = RANDOM.poisson(level, (4, 64, 128)) + 3 * RANDOM.standard_normal((4, 64, 128))
        write(folder / f"halves{level}.tif", np.round(100 + gain * electrons).astype(np.uint16))
    words = [part for level in (200, 1000, 4000) for part in ("--flat", f"{folder}/halves{level}.tif")]
    words += ["--dark", f"{folder}/halves0.tif", "-o", f"{folder}/out/right.safetensors", "--region", ":,64:", "--json"]
    assert run(*words) == 0
    found = json.loads(capsys.readouterr().out)["camera"]
    assert found["gain"]["median"] == pytest.approx(3.0, rel=0.04)
    assert noiseflow.io.read(folder / "out" / "right_gain.tif").data.shape == (64, 64)


def test_flats_and_darks_alone_give_figures_maps_and_a_model(folder, capsys):
    for level in (0, 200, 1000, 4000):
        frames = 100 + 2 * (RANDOM.poisson(level, (4, 64, 64)) + 3 * RANDOM.standard_normal((4, 64, 64)))
        write(folder / f"level{level}.tif", np.round(frames).astype(np.uint16))
    flats = [part for level in (200, 1000, 4000) for part in ("--flat", f"{folder}/level{level}.tif")]
    output = folder / "out" / "camera.safetensors"
    assert (
        run(*flats, "--dark", f"{folder}/level0.tif", "-o", str(output), "--report", f"{folder}/out/r", "--json") == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert result["camera"]["gain"]["median"] == pytest.approx(2.0, rel=0.04)
    assert result["camera"]["dark_noise"]["median"] == pytest.approx(3.0, rel=0.05)
    assert all(os.path.exists(path) for path in result["maps"])
    assert isinstance(noiseflow.load(output), noiseflow.WithMaps)
    assert "Photon transfer" in (folder / "out" / "r" / "report.html").read_text()


def test_neither_exposures_nor_flats_is_refused_in_one_line(folder, capsys):
    assert run("--dark", f"{folder}/stack3.tif", "-o", f"{folder}/out/m.safetensors") == 1
    assert "neither --short nor --flat" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["measure_detector", "fit_models"])
def test_interrupt_leaves_no_file_and_says_so(folder, capsys, monkeypatch, part):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"calibration.pipeline.{part}", interrupted)
    files = ("--short", f"{folder}/short.tif", "--long", f"{folder}/long.tif", "-o", f"{folder}/out/m.safetensors")
    assert run(*files, "--report", f"{folder}/out/report") == 130
    assert "run the same command to start again" in capsys.readouterr().err
    assert list((folder / "out").iterdir()) == []


def test_help_needs_no_torch():
    code = "import sys, calibration.cli; sys.exit(any(m in sys.modules for m in ('torch', 'cv2', 'scipy')))"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], env=os.environ).returncode == 0


def test_two_flats_and_two_biases_of_each_setting_give_a_table_and_a_chart_of_the_gains(tmp_path, capsys):
    generator = np.random.default_rng(0)
    table = tmp_path / "gains.csv"
    for setting, gain in ((400, 4.0), (100, 1.0), (100, 1.0)):
        light = np.full((2, 128, 128), 400.0)
        for name, electrons in (("flat", light), ("bias", 0 * light)):
            frames = sim.exposed(generator, electrons, gain=gain)
            write(tmp_path / f"{name}.tif", frames.astype(np.uint16))
        words = ["--flat", f"{tmp_path}/flat.tif", "--dark", f"{tmp_path}/bias.tif", "-o", f"{tmp_path}/m.safetensors"]
        assert run(*words, "--series", str(table), "--setting", str(setting)) == 0
    rows = [row for row in read_series(table) if row["figure"] == "system gain"]
    assert [row["setting"] for row in rows] == ["100", "400"]
    for row, gain in zip(rows, (1.0, 4.0), strict=True):
        assert float(row["value"]) == pytest.approx(gain, rel=0.1)
        assert row["verdict"] == "doubtful"  # one level of light cannot reveal a nonlinear response
    assert (tmp_path / "gains.svg").read_text(encoding="utf-8").startswith("<svg")
    capsys.readouterr()
    assert run(*words, "--series", str(table)) == 1  # without the setting
    assert run(*words, "--series", str(table), "--setting", "nan") == 1
    table.write_text("a,b\n1,2\n", encoding="utf-8")
    assert run(*words, "--series", str(table), "--setting", "100") == 1  # a table of another program
    assert all("series" in line for line in capsys.readouterr().err.strip().splitlines())
