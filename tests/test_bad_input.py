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
from noiseflow.cli import main
from tests.bad_files import make_bad_files, make_good_files

SPARE_MEMORY = 600 * 2**20
SECONDS = 30

CASES = """
sample {bad}/missing.safetensors {good}/clean.mrc -o {out}/n.mrc | does not exist
sample {bad}/empty.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/folder {good}/clean.mrc -o {out}/n.mrc | is a folder
sample {bad}/text.mrc {good}/clean.mrc -o {out}/n.mrc | not a noise-model file
sample {bad}/cut.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/huge.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/long.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/pickle.safetensors {good}/clean.mrc -o {out}/n.mrc | not a noise-model file
sample {bad}/torch.safetensors {good}/clean.mrc -o {out}/n.mrc | not a noise-model file
sample {bad}/other.safetensors {good}/clean.mrc -o {out}/n.mrc | not a noiseflow noise model
sample {bad}/future.safetensors {good}/clean.mrc -o {out}/n.mrc | update noiseflow
sample {bad}/unknown.safetensors {good}/clean.mrc -o {out}/n.mrc | unknown kind
sample {bad}/system.safetensors {good}/clean.mrc -o {out}/n.mrc | unknown kind
sample {bad}/arguments.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/list.safetensors {good}/clean.mrc -o {out}/n.mrc | damaged
sample {bad}/deep.safetensors {good}/clean.mrc -o {out}/n.mrc | deep.safetensors
sample {bad}/wide.safetensors {good}/clean.mrc -o {out}/n.mrc | wide.safetensors
sample {bad}/broad.safetensors {good}/clean.mrc -o {out}/n.mrc | do not fit
sample {bad}/mismatch.safetensors {good}/clean.mrc -o {out}/n.mrc | do not fit
sample {bad}/spoilt.safetensors {good}/clean.mrc -o {out}/n.mrc | NaN
sample {good}/model.safetensors {bad}/missing.mrc -o {out}/n.mrc | does not exist
sample {good}/model.safetensors {bad}/empty.mrc -o {out}/n.mrc | is empty
sample {good}/model.safetensors {bad}/empty.tif -o {out}/n.mrc | is empty
sample {good}/model.safetensors {bad}/empty.npy -o {out}/n.mrc | is empty
sample {good}/model.safetensors {bad}/cut.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/stub.mrc -o {out}/n.mrc | 1024 bytes
sample {good}/model.safetensors {bad}/text.mrc -o {out}/n.mrc | no MRC file
sample {good}/model.safetensors {bad}/garbage.mrc -o {out}/n.mrc | no MRC file
sample {good}/model.safetensors {bad}/absurd.mrc -o {out}/n.mrc | claims 10000 x 10000 x 10000
sample {good}/model.safetensors {bad}/negative.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/zero.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/extended.mrc -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/complex.mrc -o {out}/n.mrc | complex
sample {good}/model.safetensors {bad}/mode99.mrc -o {out}/n.mrc | mode 99
sample {good}/model.safetensors {bad}/nan.npy -o {out}/n.mrc | first at (3, 4, 5)
sample {good}/model.safetensors {bad}/inf.npy -o {out}/n.mrc | first at (3, 4, 5)
sample {good}/model.safetensors {bad}/complex.npy -o {out}/n.mrc | complex128
sample {good}/model.safetensors {bad}/words.npy -o {out}/n.mrc | holds <U1
sample {good}/model.safetensors {bad}/objects.npy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/pickle.npy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/four.npy -o {out}/n.mrc | 4 dimensions
sample {good}/model.safetensors {bad}/nothing.npy -o {out}/n.mrc | no pixels
sample {good}/model.safetensors {bad}/absurd.npy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/colour.tif -o {out}/n.mrc | colour
sample {good}/model.safetensors {bad}/cut.tif -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.tif -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/absurd.tif -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/image.jpeg -o {out}/n.mrc | unknown file type
sample {good}/model.safetensors {bad}/text.dm3 -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.dm4 -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.emd -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.ser -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.emi -o {out}/n.mrc | no image
sample {good}/model.safetensors {bad}/text.hspy -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.h5 -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/text.nxs -o {out}/n.mrc | cannot be read
sample {good}/model.safetensors {bad}/absurd.h5 -o {out}/n.mrc | header claims
sample {good}/model.safetensors {bad}/void.h5 -o {out}/n.mrc | no image
sample {good}/model.safetensors {bad}/twins.h5 -o {out}/n.mrc | FILE::NAME
sample {good}/model.safetensors {bad}/twins.h5::/c -o {out}/n.mrc | holds no '/c'
sample {good}/model.safetensors {good}/clean.mrc::/c -o {out}/n.mrc | leave ::/c out
sample {good}/model.safetensors {bad}/void.zarr -o {out}/n.mrc | void.zarr
sample {good}/model.safetensors {bad}/folder -o {out}/n.mrc | without images
sample {good}/model.safetensors {bad}/uneven -o {out}/n.mrc | one size
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.jpeg | name the output
sample {good}/model.safetensors {good}/clean.mrc -o {out}/none/n.mrc | create the folder
sample {good}/model.safetensors {good}/clean.mrc -o {bad}/folder | name the output
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --device cuda | --device cpu
sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --device toaster | choose auto
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {good}/small.mrc | equal sizes
evaluate {good}/model.safetensors --signal {good}/clean.mrc {good}/clean.mrc --observation {good}/clean.mrc | one of each
evaluate {good}/model.safetensors --signal {bad}/nan2d.npy --observation {good}/clean.mrc | NaN
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {bad}/cut.tif | cannot be read
evaluate {bad}/cut.safetensors --signal {good}/clean.mrc --observation {good}/clean.mrc | damaged
evaluate {good}/model.safetensors --signal {good}/clean.mrc --observation {good}/clean.mrc --device cuda | --device cpu
calibrate --short {bad}/missing.tif --long {good}/long.tif -o {out}/m.safetensors | does not exist
calibrate --short {good}/050ms.tif --long {bad}/cut.tif -o {out}/m.safetensors | cannot be read
calibrate --short {good}/050ms.tif --long {good}/050ms.tif -o {out}/m.safetensors | two separate exposures
calibrate --short {good}/050ms.tif --long {good}/clean.mrc -o {out}/m.safetensors | pixels
calibrate --short {good}/small.mrc --long {good}/small.mrc -o {out}/m.safetensors | short and as long
calibrate --short {bad}/saturated.tif --long {good}/long.tif -o {out}/m.safetensors | saturated
calibrate --short {bad}/colour.tif --long {good}/long.tif -o {out}/m.safetensors | colour
calibrate --short {bad}/flat2d.npy --long {good}/long.tif -o {out}/m.safetensors | flat
calibrate --short {bad}/nan2d.npy --long {good}/long.tif -o {out}/m.safetensors | pixels
calibrate --short {good}/050ms.tif -o {out}/m.safetensors | one frame only
calibrate --short {good}/050ms.tif --exposure-ratio 3 -o {out}/m.safetensors | without --long
calibrate --short {good}/050ms.tif --long {good}/long.tif --exposure-ratio 0 -o {out}/m.safetensors | above 1
calibrate --short {good}/050ms.tif --long {good}/long.tif --exposure-ratio nan -o {out}/m.safetensors | above 1
calibrate --short {good}/050ms.tif --long {good}/long.tif --kind magic -o {out}/m.safetensors | magic
calibrate --short {good}/050ms.tif --long {good}/long.tif -o {out}/m.pt | name the output
calibrate --short {good}/050ms.tif --long {good}/long.tif --dark {good}/050ms.tif -o {out}/m.safetensors | one frame only
calibrate --short {good}/050ms.tif --long {good}/long.tif --report {bad}/empty.mrc -o {out}/m.safetensors | is a file
calibrate --short {good}/050ms.tif --long {good}/long.tif -o {out}/m.safetensors --device cuda | --device cpu
simulate {out}/s --size 0 | size
simulate {out}/s --size -3 | size
simulate {out}/s --size 200000 | smaller size
simulate {out}/s --tilts 0:10:0 | tilts
simulate {out}/s --tilts 0:10 | START:STOP:STEP
simulate {out}/s --tilts=0:1e12:1e-6 | 10000 tilts
simulate {out}/s --tilts a:b:c | START:STOP:STEP
simulate {out}/s --tilts nan:10:1 | tilts
simulate {out}/s --phantom unicorn | unicorn
simulate {out}/s --noise {bad}/missing.safetensors | missing.safetensors
simulate {out}/s --noise {bad}/pickle.safetensors | not a noise-model file
simulate {out}/s --mode haadf | linear
simulate {bad}/empty.mrc | empty.mrc
reconstruct {bad}/missing.mrc -o {out}/v.mrc | does not exist
reconstruct {bad}/empty.mrc -o {out}/v.mrc | is empty
reconstruct {bad}/cut.mrc -o {out}/v.mrc | header claims
reconstruct {bad}/absurd.mrc -o {out}/v.mrc | header claims
reconstruct {bad}/text.dm3 -o {out}/v.mrc | cannot be read
reconstruct {good}/clean.mrc -o {out}/v.mrc | one image
reconstruct {good}/alone.mrc -o {out}/v.mrc | no tilt angles
reconstruct {bad}/folder -o {out}/v.mrc | without images
reconstruct {bad}/nan.npy -o {out}/v.mrc | NaN
reconstruct {bad}/inf.npy -o {out}/v.mrc | infinite
reconstruct {bad}/flat.npy -o {out}/v.mrc | flat
reconstruct {good}/tilts.mrc --angles {bad}/missing.tlt -o {out}/v.mrc | does not exist
reconstruct {good}/tilts.mrc --angles {bad}/empty.tlt -o {out}/v.mrc | no angles
reconstruct {good}/tilts.mrc --angles {bad}/blank.tlt -o {out}/v.mrc | no angles
reconstruct {good}/tilts.mrc --angles {bad}/words.tlt -o {out}/v.mrc | line 1
reconstruct {good}/tilts.mrc --angles {bad}/binary.tlt -o {out}/v.mrc | binary.tlt
reconstruct {good}/tilts.mrc --angles {bad}/short.tlt -o {out}/v.mrc | there are 2
reconstruct {good}/tilts.mrc --angles {bad}/nan.tlt -o {out}/v.mrc | NaN
reconstruct {good}/tilts.mrc --angles {bad}/huge.tlt -o {out}/v.mrc | infinite
reconstruct {good}/tilts.mrc --angles {bad}/same.tlt -o {out}/v.mrc | different angles
reconstruct {good}/tilts.mrc --angles {bad}/no.mdoc -o {out}/v.mrc | no angles
reconstruct {good}/tilts.mrc --angles {bad}/folder -o {out}/v.mrc | folder
reconstruct {good}/tilts.mrc --transforms {bad}/missing.xf -o {out}/v.mrc | does not exist
reconstruct {good}/tilts.mrc --transforms {bad}/wrong.xf -o {out}/v.mrc | six numbers
reconstruct {good}/tilts.mrc --transforms {bad}/short.xf -o {out}/v.mrc | 1 transforms
reconstruct {good}/tilts.mrc --method magic -o {out}/v.mrc | choose
reconstruct {good}/tilts.mrc --mode haadf -o {out}/v.mrc | linear
reconstruct {good}/tilts.mrc --thickness 0 -o {out}/v.mrc | thickness
reconstruct {good}/tilts.mrc --thickness -4 -o {out}/v.mrc | thickness
reconstruct {good}/tilts.mrc --weight -1 -o {out}/v.mrc | zero or more
reconstruct {good}/tilts.mrc --weight nan -o {out}/v.mrc | zero or more
reconstruct {good}/tilts.mrc --noise-model {bad}/missing.safetensors -o {out}/v.mrc | does not exist
reconstruct {good}/tilts.mrc --noise-model {bad}/future.safetensors -o {out}/v.mrc | update noiseflow
reconstruct {good}/tilts.mrc --report {bad}/empty.mrc -o {out}/v.mrc | is a file
reconstruct {good}/tilts.mrc -o {out}/v.xyz | name the output
reconstruct {good}/tilts.mrc -o {out}/none/v.mrc | create the folder
reconstruct {good}/tilts.mrc -o {out}/v.mrc --device cuda | --device cpu
compare {bad}/missing.mrc {good}/tilts.mrc | does not exist
compare {good}/tilts.mrc {good}/clean.mrc | shape
compare {bad}/nan.npy {good}/tilts.mrc | NaN
compare {good}/tilts.mrc {bad}/flat.npy | flat
compare {good}/tilts.mrc {bad}/cut.mrc | header claims
demo --out {bad}/empty.mrc | is a file
demo --out {bad}/empty.mrc/below | empty.mrc
"""
ROWS = [tuple(row.rsplit(" | ", 1)) for row in CASES.strip().splitlines()]
USAGE = [
    "",
    "recontruct {good}/tilts.mrc -o {out}/v.mrc",
    "sample",
    "sample {good}/model.safetensors {good}/clean.mrc",
    "simulate {out}/s --size big",
    "reconstruct {good}/tilts.mrc -o {out}/v.mrc --wieght 1",
    "reconstruct {good}/tilts.mrc -o {out}/v.mrc --thickness 3.5",
    "evaluate {good}/model.safetensors --signal {good}/clean.mrc",
    "doctor --out x",
    "reconstruct {good}/tilts.mrc --steps 0 -o {out}/v.mrc",
    "reconstruct {good}/tilts.mrc --steps -5 -o {out}/v.mrc",
    "sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --seed -1",
    "sample {good}/model.safetensors {good}/clean.mrc -o {out}/n.mrc --seed 99999999999999999999",
]


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
    assert "fault of noiseflow" not in message
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
    line = "-m noiseflow.cli sample {good}/model.safetensors {bad}/absurd.mrc -o {out}/n.mrc"
    done = subprocess.run([sys.executable, *words(line, files, tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("noiseflow: ")
