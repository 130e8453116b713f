"""Console output never decides whether the work is saved, and moves no cursor."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import noiseflow
from noiseflow import io
from noiseflow.report import Report

ESCAPE = "\x1b[31mred\u202e"


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path]:
    """A short command that prints and writes, and what it writes."""
    folder = tmp_path_factory.mktemp("console")
    noiseflow.save(noiseflow.Gaussian(0.1), folder / "model.safetensors")
    io.write(folder / "clean.npy", np.ones((9, 8), np.float32))
    words = ["sample", str(folder / "model.safetensors"), str(folder / "clean.npy"), "-o", str(folder / "noisy.npy")]
    return [sys.executable, "-m", "noiseflow", *words], folder / "noisy.npy"


@pytest.fixture(scope="module")
def volumes(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A command that prints ``Å`` before it writes a page."""
    folder = tmp_path_factory.mktemp("volumes")
    generator = np.random.default_rng(0)
    volume = generator.random((16, 16, 16), np.float32)
    for name in "ab":
        io.write(folder / f"{name}.mrc", volume, voxel_size=(2.0, 2.0, 2.0))
        volume = volume + generator.random((16, 16, 16), np.float32) / 4
    words = ["compare", str(folder / "a.mrc"), str(folder / "b.mrc"), "--report"]
    return [sys.executable, "-m", "noiseflow", *words]


def shell(words: list[str], redirection: str, **environment: str) -> subprocess.CompletedProcess[str]:
    script = f'"$@" {redirection}'
    return subprocess.run(
        ["bash", "-c", script, "bash", *words],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize(
    "redirection", ["2>&-", ">&-", ">&- 2>&- <&-", "| true; exit ${PIPESTATUS[0]}", "2>/dev/full", "2>&1 | head -c 1"]
)
def test_the_work_is_saved_whatever_becomes_of_its_output(command: tuple[list[str], Path], redirection: str) -> None:
    words, output = command
    output.unlink(missing_ok=True)
    done = shell(words, redirection)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert io.read(output).data.shape == (9, 8)


def test_a_result_that_nobody_could_read_is_told(command: tuple[list[str], Path]) -> None:
    words, output = command
    done = shell([*words, "--json"], ">/dev/full")
    assert done.returncode == 1
    assert done.stderr.endswith("noiseflow: console output was lost (no space left on device); all files are written\n")
    assert output.exists()


def test_a_narrow_encoding_stops_nothing(volumes: list[str], tmp_path: Path) -> None:
    done = shell([*volumes, str(tmp_path / "report")], "", PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert "\\xc5" in done.stdout
    assert (tmp_path / "report" / "index.html").exists()


def test_errors_still_exit_with_1_and_no_word_without_stderr(command: tuple[list[str], Path]) -> None:
    words, _ = command
    done = shell([*words[:-1], "/none/n.npy"], "2>&-")
    assert (done.returncode, done.stdout) == (1, "")


def test_no_output_file_takes_the_number_of_a_closed_standard_file(command: tuple[list[str], Path]) -> None:
    words, output = command
    assert shell([*words, "--debug"], ">&- 2>&-").returncode == 0
    assert output.stat().st_size == 1024 + 9 * 8 * 4


def test_names_of_files_move_no_cursor(tmp_path: Path, refused, capsys) -> None:
    image = tmp_path / f"{ESCAPE}.npy"
    io.write(image, np.ones((9, 8), np.float32))
    noiseflow.save(noiseflow.Gaussian(0.1), tmp_path / "model.safetensors")
    with pytest.raises(SystemExit):
        noiseflow.commands.cli.main(
            ["sample", str(tmp_path / "model.safetensors"), str(image), "-o", str(image) + ".npy"]
        )
    told = capsys.readouterr()
    assert "wrote" in told.out
    assert "?[31mred?.npy.npy" in told.out
    assert not set("\x1b\u202e") & set(told.out + told.err)
    assert "\x1b" not in refused("sample", tmp_path / "none\x1b.safetensors", image, "-o", tmp_path / "n.npy")


@pytest.mark.parametrize("words", [["sample", f"--{ESCAPE}"], [ESCAPE], ["simulate", "new", "--size", ESCAPE]])
def test_what_was_typed_wrongly_moves_no_cursor(words: list[str], capsys) -> None:
    with pytest.raises(SystemExit) as end:
        noiseflow.commands.cli.main(words)
    told = capsys.readouterr()
    assert end.value.code == 2
    assert "Usage" in told.err
    assert not set("\x1b\u202e") & set(told.out + told.err)


def test_pages_hold_no_control_characters(tmp_path: Path) -> None:
    report = Report(ESCAPE, ESCAPE)
    report.text(ESCAPE)
    report.text(f"noiseflow sample '{ESCAPE}'", kind="command")
    report.table(["a", ESCAPE], [["b", os.fsdecode(b"\xff\x07")]], caption=ESCAPE)
    page = report.save(tmp_path / "index.html").read_text(encoding="utf-8")
    assert not set("\x1b\u202e\x07\udcff") & set(page)
    assert "red" in page


def test_json_tells_the_name_as_it_is(tmp_path: Path, run) -> None:
    noiseflow.save(noiseflow.Gaussian(0.1), tmp_path / "model.safetensors")
    io.write(tmp_path / "clean.npy", np.ones((9, 8), np.float32))
    target = tmp_path / f"{ESCAPE}.npy"
    assert run("sample", tmp_path / "model.safetensors", tmp_path / "clean.npy", "-o", target)["output"] == str(target)
    assert json.dumps(str(target)).isascii()
