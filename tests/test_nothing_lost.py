"""Users' files, and what a run has reached: lost to no other command, no second run, no full disk and no kill."""

from __future__ import annotations

import errno
import json
import os
import resource
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

import noiseflow
import recon.commands.results
import recon.scale.blocks  # noqa: F401
from noiseflow import io
from noiseflow.commands.cli import main
from noiseflow.runs.ownership import _prefix, require_own
from noiseflow.runs.run_folder import discard_states, write_state
from tests.processes import finish, start, wait_for

CALIBRATE = (
    "calibrate --flat {files}/flat200.npy --flat {files}/flat1000.npy --flat {files}/flat4000.npy --dark {files}/flat0.npy "
    "-o {out}/camera.safetensors --report {out}/page"
)
WRITERS = {
    "sample {files}/model.safetensors {files}/clean.npy -o {out}/noisy.mrc": ["noisy.mrc"],
    "sample {files}/model.safetensors {files}/clean.npy -o {out}/noisy.npy": ["noisy.npy"],
    "simulate {out}/new --size 8 --tilts=-60:60:30": [
        "new/tilts.mrc",
        "new/truth.mrc",
        "new/clean.mrc",
        "new/tilts.rawtlt",
    ],
    "compare {files}/new/truth.mrc {files}/new/clean8.mrc --report {out}/page": ["page/index.html"],
    "reconstruct {files}/new/tilts.mrc -o {out}/volume.mrc --method wbp": ["volume.mrc"],
    "reconstruct {files}/new/tilts.mrc -o {out}/volume.npy --method wbp --report {out}/page": ["page/index.html"],
    "reconstruct {files}/new/tilts.mrc -o {out}/volume.tif --method l2 --weight 0.4 --steps 3 "
    "--save-noise-model {out}/noise.safetensors": ["noise.safetensors"],
    "reconstruct {files}/new/tilts.mrc -o {out}/volume.mrc --method l2 --weight 0.4 --steps 3 --uncertainty 2": [
        "volume_std.mrc",
        "volume_bias.mrc",
        "volume_wedge.mrc",
        "volume_fsc.csv",
    ],
    "batch {files}/series.csv -o {out} --options '--method wbp'": ["batch.csv"],
    "batch {files}/series.csv -o {out} --table {out}/table.json --options '--method wbp'": ["table.json"],
    CALIBRATE: ["camera.safetensors", "page/report.html", "camera_offset.tif"],
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    noiseflow.save(noiseflow.Gaussian(0.1), folder / "model.safetensors")
    io.write(folder / "clean.npy", np.ones((9, 8), np.float32))
    generator = np.random.default_rng(2)
    for level in (0, 200, 1000, 4000):
        frames = 100 + 2 * (generator.poisson(level, (4, 32, 32)) + 3 * generator.standard_normal((4, 32, 32)))
        io.write(folder / f"flat{level}.npy", np.round(frames).astype(np.uint16))
    finish(["simulate", folder / "new", "--size", 16, "--tilts=-60:60:10"], folder / "log")
    truth = io.read(folder / "new" / "truth.mrc").data
    io.write(
        folder / "new" / "clean8.mrc",
        truth + np.float32(0.01) * np.random.default_rng(0).random(truth.shape, np.float32),
    )
    (folder / "series.csv").write_text(f"tilts\n{folder / 'new' / 'tilts.mrc'}\n")
    return folder


@pytest.mark.parametrize("line", WRITERS)
def test_files_of_others_stay_unless_overwrite_is_given(line: str, files: Path, tmp_path: Path, run, refused) -> None:
    """Each refuses alone; with leave, all are replaced at once."""
    words, every = shlex.split(line.format(files=files, out=tmp_path)), [tmp_path / name for name in WRITERS[line]]
    for mine in every:
        mine.parent.mkdir(exist_ok=True)
        mine.write_text("years of work")
        assert "--overwrite" in refused(*words)
        assert [file for file in tmp_path.rglob("*") if file.is_file()] == [mine]
        assert mine.read_text() == "years of work"
        mine.unlink()
    for mine in every:
        mine.write_text("years of work")
    run(*words, "--overwrite")
    assert b"years of work" not in [mine.read_bytes() for mine in every]
    run(*words)  # now they are ours


@pytest.mark.parametrize("line", [line for line in WRITERS if "sample" in line])
def test_a_linked_output_stays_a_link(line: str, files: Path, tmp_path: Path, run) -> None:
    (tmp_path / "disk").mkdir()
    link = tmp_path / WRITERS[line][0]
    link.symlink_to(tmp_path / "disk" / link.name)
    run(*shlex.split(line.format(files=files, out=tmp_path)))
    assert link.is_symlink()
    assert io.read(tmp_path / "disk" / link.name).data.shape == (9, 8)


def test_simulate_writes_through_links(tmp_path: Path, run) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "truth.mrc").symlink_to(tmp_path / "disk" / "truth.mrc")
    run("simulate", tmp_path / "new", "--size", "8", "--tilts=-60:60:30")
    assert (tmp_path / "new" / "truth.mrc").is_symlink()
    assert io.read(tmp_path / "disk" / "truth.mrc").data.shape == (8, 8, 8)


def test_foreign_files_among_the_states_stay(tmp_path: Path) -> None:
    write_state(tmp_path / "fit-001.safetensors", {"a": 1})
    (tmp_path / f"{_prefix('fit-002')}abcdefgh.safetensors.part").mkdir()
    dead = tmp_path / f".fit-003-{_prefix('x').split('-')[1]}-999999999-abcdefgh.safetensors.part"
    dead.mkdir()
    (dead / ".tmpAbCdEf").touch()
    save_file({"weights": np.ones(3)}, tmp_path / "mine.safetensors")
    save_file({"weights": np.ones(3)}, tmp_path / "current.safetensors")
    with pytest.raises(FileExistsError, match="not a reconstruction state"):
        write_state(tmp_path / "current.safetensors", {"a": 1})
    discard_states(tmp_path)
    left = {file.name for file in tmp_path.iterdir()}
    assert left >= {"mine.safetensors", "current.safetensors"}
    assert not left & {"fit-001.safetensors", dead.name}


def test_files_of_others_in_the_folder_of_a_checkpoint_stay(files: Path, tmp_path: Path, run, refused) -> None:
    """Noise models and volumes that noiseflow wrote are no states either."""
    out, folder = tmp_path / "volume.npy", tmp_path / "volume.npy.checkpoint"
    (folder / "blocks-mine").mkdir(parents=True)
    noiseflow.save(noiseflow.Gaussian(), folder / "mine.safetensors")
    io.write(folder / "blocks-mine" / "volume.npy", np.ones((3, 4), np.float32))
    (folder / "run.json").write_text('{"mine": 1}')
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert "run.json was not written by noiseflow" in refused(*reconstruct(files, out, "--steps", 3))
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before
    (folder / "run.json").unlink()
    del before[folder / "run.json"]
    run(*reconstruct(files, out, "--steps", 3))
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


def test_a_noise_model_that_bears_the_name_of_a_state_is_not_replaced(tmp_path: Path) -> None:
    path = noiseflow.save(noiseflow.Gaussian(), tmp_path / "current.safetensors")
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="not a reconstruction state"):
        write_state(path, {"a": 1})
    assert path.read_bytes() == before


def test_no_series_of_a_batch_is_replaced_by_the_volume_of_another(files: Path, tmp_path: Path, refused) -> None:
    for name in "ab":
        shutil.copytree(files / "new", tmp_path / name)
    table = tmp_path / "series.csv"
    table.write_text("tilts,out\na/tilts.mrc,b/tilts.mrc\nb/tilts.mrc,b/volume.mrc\n")
    before = (tmp_path / "b" / "tilts.mrc").read_bytes()
    words = ["batch", table, "-o", tmp_path / "out", "--options", "--method wbp"]
    for more in ([], ["--overwrite"]):
        assert "is an input of" in refused(*words, *more)
    assert (tmp_path / "b" / "tilts.mrc").read_bytes() == before
    assert "is also an input" in refused("batch", table, "-o", tmp_path / "out", "--table", table, "--overwrite")
    assert table.read_text().startswith("tilts,out")


def test_no_image_of_a_folder_that_is_the_input_is_replaced(files: Path, tmp_path: Path, refused) -> None:
    """Neither asked nor unasked: they may have been written by noiseflow."""
    stack = io.read(files / "new" / "tilts.mrc").data
    for number, image in enumerate(stack):
        io.write(tmp_path / f"{number:02d}.tif", image)
    shutil.copy(files / "new" / "tilts.rawtlt", tmp_path)
    for more in ([], ["--overwrite"]):
        assert "is also an input" in refused(
            "reconstruct", tmp_path, "-o", tmp_path / "03.tif", "--method", "wbp", *more
        )
    assert np.array_equal(io.read(tmp_path / "03.tif").data, stack[3])


@pytest.mark.parametrize("looks", range(1, 4))
def test_a_state_that_is_deleted_while_it_is_looked_at_is_not_taken_for_a_foreign_file(
    looks: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / "current.safetensors"
    write_state(state, {"a": 1})
    stat, seen = Path.stat, []

    def deleted_after(path: Path, **options: bool) -> os.stat_result:
        answer = stat(path, **options)
        if path == state:
            seen.append(answer)
            if len(seen) == looks:
                path.unlink()
        return answer

    monkeypatch.setattr(Path, "stat", deleted_after)
    require_own(state, overwrite=False)
    monkeypatch.undo()
    assert len(seen) < looks or not state.exists()


def reconstruct(files: Path, out: Path, *more: object) -> list[object]:
    options = ["--method", "l2", "--weight", 0.4, "--steps", 60, "--checkpoint-interval", 0]
    return ["reconstruct", files / "new" / "tilts.mrc", "-o", out, *options, *more]


def saved(out: Path) -> bool:
    """Whether a run that makes this output has saved a state."""
    return bool(list(out.with_name(f"{out.name}.checkpoint").glob("*.safetensors")))


def kill(process) -> None:
    os.kill(process.pid, signal.SIGKILL)
    process.join()


def test_the_second_run_with_one_output_is_refused_and_the_first_ends_well(
    files: Path, tmp_path: Path, refused
) -> None:
    out = tmp_path / "volume.npy"
    process = start(reconstruct(files, out), tmp_path / "log")
    wait_for(lambda: saved(out), process)
    os.kill(process.pid, signal.SIGSTOP)
    try:
        message = refused(*reconstruct(files, out, "--steps", 3))
        assert f"process {process.pid} on " in message
        assert saved(out)
    finally:
        os.kill(process.pid, signal.SIGCONT)
    process.join(120)
    assert process.exitcode == 0, (tmp_path / "log").read_text()
    assert {file.name for file in tmp_path.iterdir()} == {"volume.npy", "volume.npy.options.toml", "log"}


def test_the_lock_of_a_killed_run_holds_nobody_up(files: Path, tmp_path: Path) -> None:
    out = tmp_path / "volume.npy"
    process = start(reconstruct(files, out), tmp_path / "log")
    wait_for(lambda: saved(out), process)
    kill(process)
    finish(reconstruct(files, out, "--resume"), tmp_path / "log")
    assert {file.name for file in tmp_path.iterdir()} == {"volume.npy", "volume.npy.options.toml", "log"}


def test_what_a_killed_run_in_blocks_left_is_cleared(files: Path, tmp_path: Path) -> None:
    out = tmp_path / "volume.npy"
    words = [
        "reconstruct",
        files / "new" / "tilts.mrc",
        "-o",
        out,
        "--method",
        "sirt",
        "--steps",
        400,
        "--slices-at-once",
        4,
    ]
    process = start(words, tmp_path / "log")
    wait_for(lambda: bool(list(tmp_path.glob("volume.npy.checkpoint/blocks-*/volume-*.npy"))), process)
    kill(process)
    assert list(tmp_path.glob(".volume-*"))
    finish(["sample", files / "model.safetensors", files / "clean.npy", "-o", tmp_path / "other.npy"], tmp_path / "log")
    assert list(tmp_path.glob(".volume-*"))
    finish([*words[:-3], 5, "--slices-at-once", 4], tmp_path / "log")
    written = {"volume.npy", "other.npy"}
    assert {file.name for file in tmp_path.iterdir()} == {
        *written,
        *(f"{name}.options.toml" for name in written),
        "log",
    }


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_a_full_disk_stops_with_one_line_and_the_run_goes_on_when_there_is_room(files: Path, tmp_path: Path) -> None:
    expected = tmp_path / "whole.npy"
    finish(reconstruct(files, expected), tmp_path / "log")
    out = tmp_path / "volume.npy"
    with no_file_larger_than(20_000):
        process = start(reconstruct(files, out), tmp_path / "log")
    process.join(120)
    told = (tmp_path / "log").read_text().strip().splitlines()[-1]
    assert process.exitcode == 1, told
    assert "bug in noiseflow" not in told
    assert "raise the limit (ulimit -f)" in told
    assert told.endswith("--resume")
    assert saved(out)
    finish(shlex.split(told.partition("resume with: noiseflow ")[2]), tmp_path / "log")
    np.testing.assert_allclose(np.load(out), np.load(expected), rtol=0, atol=1e-5 * np.abs(np.load(expected)).max())
    written = {"volume.npy", "whole.npy"}
    assert {file.name for file in tmp_path.iterdir()} == {
        *written,
        *(f"{name}.options.toml" for name in written),
        "log",
    }


@pytest.mark.parametrize(
    "line",
    [
        "compare {files}/new/truth.mrc {files}/new/clean8.mrc --report {out}/new/page",
        "reconstruct {files}/new/tilts.mrc -o {out}/v.npy --method l2 --weight 0.4 --steps 3 --checkpoint-interval 0",
        "simulate {out}/a/b --size 8 --tilts=-60:60:30",
        "batch {files}/series.csv -o {out}/a/b --options '--method wbp'",
        CALIBRATE.replace("camera.safetensors", "c.safetensors"),
    ],
)
def test_folders_made_for_outputs_that_found_no_room_are_gone(line: str, files: Path, tmp_path: Path, refused) -> None:
    with no_file_larger_than(100):
        message = refused(*shlex.split(line.format(files=files, out=tmp_path)))
    assert "ulimit -f" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems tell no process that its parent died")
def test_a_killed_batch_leaves_no_process_that_holds_its_outputs(files: Path, tmp_path: Path) -> None:
    options = "--method l2 --weight 0.4 --steps 1000000"
    words = ["batch", files / "series.csv", "-o", tmp_path / "out", "--options", options]
    process, lock = start(words, tmp_path / "log"), tmp_path / "out" / ".tilts.mrc.lock"
    wait_for(lambda: lock.exists() and lock.stat().st_size > 0, process)
    holder = json.loads(lock.read_text())["process"]
    kill(process)
    deadline = time.monotonic() + 60
    try:
        while lock.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not lock.exists()
        with io.locked(tmp_path / "out" / "tilts.mrc"):
            assert json.loads(lock.read_text())["process"] == os.getpid()
    finally:
        with suppress(ProcessLookupError):
            os.kill(holder, signal.SIGKILL)


def test_a_batch_that_is_stopped_tells_how_far_it_came(files: Path, tmp_path: Path) -> None:
    words = [
        "batch",
        files / "series.csv",
        "-o",
        tmp_path / "out",
        "--options",
        "--method l2 --weight 0.4 --steps 5000",
    ]
    process = start(words, tmp_path / "log")

    def begun() -> set[Path]:
        """What a series has begun; the table's lock comes before."""
        return {*tmp_path.glob("out/*"), *tmp_path.glob("out/.*")} - {tmp_path / "out" / ".batch.csv.lock"}

    wait_for(lambda: any(path.suffix in (".checkpoint", ".lock") for path in begun()), process)
    os.kill(process.pid, signal.SIGINT)
    process.join(120)
    assert process.exitcode == 130
    told = (tmp_path / "log").read_text().strip().splitlines()[-1]
    assert told.endswith("0 of 1 series are done; continue with --resume")


def test_an_output_folder_that_is_deleted_is_told(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    folder.mkdir()
    process = start(reconstruct(files, folder / "volume.npy"), tmp_path / "log")
    wait_for(lambda: saved(folder / "volume.npy"), process)
    os.kill(process.pid, signal.SIGSTOP)
    shutil.rmtree(folder)
    os.kill(process.pid, signal.SIGCONT)
    process.join(120)
    told = (tmp_path / "log").read_text()
    assert process.exitcode == 1, told
    last = told.strip().splitlines()[-1]
    assert last.startswith("noiseflow: ")
    assert "no longer exists" in last
    assert "--resume" not in last
    assert "Traceback" not in told


@pytest.mark.parametrize("name", ["a.tif", "a.mrc", "a.npy"])
def test_an_image_on_a_full_disk_is_an_error_of_the_system_and_leaves_the_old_one(name: str, tmp_path: Path) -> None:
    """NumPy says only how many pixels it wrote."""
    path = tmp_path / name
    io.write(path, np.zeros((3, 4), np.float32))
    before = path.read_bytes()
    with no_file_larger_than(50_000), pytest.raises(OSError, match=r"space|too large") as error:
        io.write(path, np.ones((300, 300), np.float32))
    assert error.value.errno in (errno.ENOSPC, errno.EFBIG)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_a_noise_model_on_a_full_disk_leaves_the_old_one(tmp_path: Path) -> None:
    path = noiseflow.save(noiseflow.Gaussian(0.1), tmp_path / "model.safetensors")
    before = path.read_bytes()
    with no_file_larger_than(10_000), pytest.raises(OSError, match="File too large"):
        noiseflow.save(noiseflow.SplineFlow(), path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["model.safetensors"]


@pytest.mark.parametrize("name", ["batch", "calibrate", "compare", "demo", "reconstruct", "sample", "simulate"])
def test_commands_that_write_say_how_to_overwrite(name: str, capsys) -> None:
    with pytest.raises(SystemExit):
        main([name, "--help-all" if name in ("calibrate", "reconstruct") else "-h"])
    assert "--overwrite" in capsys.readouterr().out
