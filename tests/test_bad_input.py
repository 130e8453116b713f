"""Every mistake we could think of, through every command: one line, nothing left behind, no memory, no hang."""

from __future__ import annotations

import os
import resource
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import calibration
import noiseflow
import recon
from noiseflow import io
from noiseflow.commands.cli import main
from tests.bad_cases import ROWS, USAGE
from tests.bad_files import make_bad_files, make_good_files

SPARE_MEMORY = 600 * 2**20
SECONDS = 30


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {name: tmp_path_factory.mktemp(name) for name in ("good", "bad")}
    make_good_files(folders["good"])
    make_bad_files(folders["bad"])
    assert torch.__version__
    assert calibration.read_pairs
    assert recon.read_tilt_series
    return folders


@pytest.fixture(autouse=True)
def bounds() -> Iterator[None]:
    """No case may take much memory (as the system counts it) or time."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + SPARE_MEMORY, hard))
    signal.signal(signal.SIGPROF, _give_up)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    yield
    signal.setitimer(signal.ITIMER_PROF, 0)
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY if hard == resource.RLIM_INFINITY else hard, hard))


def _give_up(*_: object) -> None:
    pytest.fail(f"still running after {SECONDS} s")


def words(line: str, files: dict[str, Path], out: Path) -> list[str]:
    return shlex.split(line.format(out=out, **files))


def snapshot(*folders: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for folder in folders for path in sorted(folder.rglob("*"))}


@pytest.mark.parametrize(("line", "fragment"), ROWS, ids=[line for line, _ in ROWS])
def test_one_line_and_nothing_left(line: str, fragment: str, files: dict[str, Path], tmp_path: Path, refused) -> None:
    if "cuda" in line and torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    before = snapshot(tmp_path, *files.values())
    message = refused(*words(line, files, tmp_path))
    assert fragment in message
    assert "bug in noiseflow" not in message
    assert len(message) < 500
    assert snapshot(tmp_path, *files.values()) == before


@pytest.mark.parametrize("line", USAGE)
def test_wrong_usage_exits_with_2(line: str, files: dict[str, Path], tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        main(words(line, files, tmp_path))
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert "Usage" in captured.err + captured.out
    assert "Traceback" not in captured.err
    assert not list(tmp_path.iterdir())


def test_debug_shows_the_traceback(files: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is empty"):
        main(["compare", str(files["bad"] / "empty.mrc"), str(files["good"] / "clean.mrc"), "--debug"])


@pytest.mark.parametrize("suffix", ["mrc", "tif", "npy", "zarr"])
def test_full_disk_leaves_nothing(suffix: str, files: dict[str, Path], tmp_path: Path, refused) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, hard))
    try:
        line = f"sample {{good}}/model.safetensors {{good}}/clean.mrc -o {{out}}/n.{suffix}"
        message = refused(*words(line, files, tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert "another disk" in message
    assert not list(tmp_path.iterdir())


def test_folder_without_permission(tmp_path: Path, files: dict[str, Path], refused, monkeypatch) -> None:
    if os.geteuid() == 0:  # root may write anywhere
        monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    tmp_path.chmod(0o500)
    message = refused(*words("sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc", files, tmp_path))
    tmp_path.chmod(0o700)
    assert "not writable" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read anything")
def test_file_without_permission(tmp_path: Path, files: dict[str, Path], capsys) -> None:
    secret = tmp_path / "secret.mrc"
    io.write(secret, np.zeros((4, 4)))
    secret.chmod(0)
    with pytest.raises(SystemExit) as stop:
        main(words(f"compare {secret} {{good}}/clean.mrc", files, tmp_path))
    assert stop.value.code == 2
    assert "is not readable" in " ".join(capsys.readouterr().err.split())


TRUNCATED = ["whole.mrc", "whole.tif", "inf.npy", "twins.h5", "sound.safetensors"]


@pytest.mark.parametrize("name", TRUNCATED)
def test_truncation_at_every_kilobyte_is_told(name: str, files: dict[str, Path], tmp_path: Path) -> None:
    whole = (files["bad"] / name).read_bytes()
    step = 1000 if len(whole) > 2000 else 50
    for size in range(step, len(whole), step):
        path = tmp_path / f"cut{Path(name).suffix}"
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"cut\..* (cannot be read|is not a noise-model|holds)"):
            noiseflow.load(path) if path.suffix == ".safetensors" else io.read(path)


def test_a_whole_process_answers_in_one_line(files: dict[str, Path], tmp_path: Path) -> None:
    line = "-m noiseflow sample {good}/model.safetensors {bad}/absurd.mrc -o {out}/n.mrc"
    done = subprocess.run([sys.executable, *words(line, files, tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("noiseflow: ")
