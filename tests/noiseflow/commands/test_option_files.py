"""Options from a file, options written by a run, and the groups of the help."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from noiseflow.commands.cli import main


def run(*words: object) -> None:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    if end.value.code:
        raise RuntimeError(end.value.code)


@pytest.fixture
def tilts(tmp_path: Path) -> Path:
    angles = np.arange(-60.0, 61.0, 6.0)
    images = np.random.default_rng(0).normal(5.0, 0.2, (len(angles), 6, 12)).astype(np.float32)
    images[:, :, 4:8] += 4
    np.save(tmp_path / "tilts.npy", images)
    np.savetxt(tmp_path / "tilts.rawtlt", angles)
    return tmp_path / "tilts.npy"


def test_options_of_a_file_are_used_and_words_of_the_command_take_precedence(tilts: Path) -> None:
    file = tilts.with_name("run.toml")
    file.write_text('mode = "linear"\nmethod = "sirt"\nsteps = 3\nreport = "nowhere"\n', encoding="utf-8")
    report = tilts.with_name("report")
    run("reconstruct", tilts, "-o", tilts.with_name("a.npy"), "--options", file, "--report", report, "--thickness", 12)
    written = tomllib.loads(tilts.with_name("a.npy.options.toml").read_text(encoding="utf-8"))
    assert (written["mode"], written["method"], written["steps"], written["thickness"]) == ("linear", "sirt", 3, 12)
    assert written["report"] == str(report)
    assert not tilts.with_name("nowhere").exists()


def test_every_run_writes_the_options_that_repeat_it(tilts: Path) -> None:
    first = tilts.with_name("first.npy")
    run("reconstruct", tilts, "-o", first, "--mode", "linear", "--method", "SIRT", "--steps", 4)
    before = np.load(first)
    first.unlink()
    run("reconstruct", "--options", tilts.with_name("first.npy.options.toml"))
    assert np.array_equal(np.load(first), before)


def test_every_command_that_writes_files_writes_its_options(tilts: Path) -> None:
    folder, detector = tilts.parent, files("noiseflow") / "data" / "zoo" / "tooth-xray.safetensors"
    np.save(folder / "clean.npy", np.linspace(50.0, 90.0, 64, dtype=np.float32).reshape(8, 8))
    run("sample", detector, folder / "clean.npy", "-o", folder / "noisy.npy", "--seed", 3)
    run("simulate", folder / "made", "--size", 8, "--tilts=-60:60:20")
    run("compare", folder / "made" / "truth.mrc", folder / "made" / "truth.mrc", "--report", folder / "compared")
    assert np.load(folder / "noisy.npy").shape == (8, 8)
    found = [
        tomllib.loads((folder / name).read_text(encoding="utf-8"))
        for name in ("noisy.npy.options.toml", "made/options.toml", "compared/options.toml")
    ]
    assert [values.get("seed") for values in found] == [3, None, None]
    assert found[1]["tilts"] == "-60:60:20"
    assert found[2]["report"] == str(folder / "compared")


def test_a_dry_run_and_a_refused_run_write_no_options(tilts: Path) -> None:
    out, written = tilts.with_name("a.npy"), tilts.with_name("a.npy.options.toml")
    run("reconstruct", tilts, "-o", out, "--dry-run")
    with pytest.raises(RuntimeError, match="1"):
        run("reconstruct", tilts, "-o", out, "--method", "nothing")
    assert not written.exists()
    written.write_text("mine = 1\n", encoding="utf-8")
    with pytest.raises(RuntimeError, match="1"):
        run("reconstruct", tilts, "-o", out, "--method", "sirt")
    assert written.read_text(encoding="utf-8") == "mine = 1\n"
    assert not out.exists()


def test_an_unknown_option_of_a_file_is_named_with_the_nearest_one(
    tilts: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tilts.with_name("run.toml")
    file.write_text("depth_thickness = 3\n", encoding="utf-8")
    with pytest.raises(RuntimeError, match="1"):
        run("reconstruct", tilts, "-o", tilts.with_name("a.npy"), "--options", file)
    assert "'depth_thickness'" in (told := capsys.readouterr().err)
    assert "thickness" in told


@pytest.mark.parametrize("text", ["mode: linear", "\x00", "mode = \n"])
def test_a_file_that_is_no_toml_is_refused(tilts: Path, text: str) -> None:
    tilts.with_name("run.toml").write_text(text, encoding="utf-8")
    with pytest.raises(RuntimeError, match="1"):
        run("reconstruct", tilts, "-o", tilts.with_name("a.npy"), "--options", tilts.with_name("run.toml"))
    assert not tilts.with_name("a.npy").exists()


def test_help_shows_few_options_and_help_all_every_one(capsys: pytest.CaptureFixture[str]) -> None:
    run("reconstruct", "-h")
    short = capsys.readouterr().out
    run("reconstruct", "--help-all")
    everything = capsys.readouterr().out
    assert "--mode" in short
    assert "--checkpoint-interval" not in short
    assert "--checkpoint-interval" in everything
    assert short.count("\n") < 60


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        ("reconstruct --method si", "sirt"),
        ("reconstruct --mode ", "linear"),
        ("reconstruct --regulariser ", "total-variation"),
        ("calibrate --kind sp", "spline"),
        ("simulate --phantom sh", "shells"),
        ("sample --device c", "cuda"),
    ],
)
def test_the_shell_completes_values(typed: str, value: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setenv("_NOISEFLOW_COMPLETE", "complete_zsh")
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", f"noiseflow {typed}")
    run()
    assert f'"{value}"' in capsys.readouterr().out


WRONG_ENDINGS = (
    "calibrate short.tif long.tif -o model",
    "sample model.safetensors clean.tif -o noisy.jpg",
    "reconstruct tilts.mrc -o volume",
    "reconstruct tilts.mrc -o volume.mrc --save-alignment alignment.txt",
    "reconstruct tilts.mrc -o volume.mrc --save-field field",
    "reconstruct tilts.mrc -o volume.mrc --save-noise-model model",
    "export field.safetensors -o volume",
    "batch folder -o volumes --table table",
)


@pytest.mark.parametrize("command", WRONG_ENDINGS)
def test_the_ending_of_an_output_is_checked_before_any_file_is_looked_for(command: str, capsys) -> None:
    with pytest.raises(RuntimeError):
        run(*command.split())
    assert command.split()[-1] in capsys.readouterr().err


def test_a_wrong_ending_is_refused_without_torch() -> None:
    code = (
        "import sys; from noiseflow.commands.cli import main\n"
        f"try: main({WRONG_ENDINGS[0].split()})\nexcept SystemExit as end: assert end.code == 1\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0
