"""What a killed program left beside its outputs is cleared by the next run, and nothing else."""

from __future__ import annotations

import os
import pathlib
import shutil
import signal
import time

import numpy as np
import pytest

from noiseflow import io
from noiseflow.commands.console import end_stopped
from noiseflow.runs import outputs
from noiseflow.runs.ownership import REPLACED, _prefix, clear_all_leftovers
from tests.processes import FORK


def hold(path, folder):
    with (outputs.atomic_folder if folder else io.atomic_path)(path) as partial:
        target = partial / "part" if folder else partial
        target.write_bytes(b"half")
        time.sleep(60)


def killed_while_writing(path, *, folder=False):
    process = FORK.Process(target=hold, args=(path, folder))
    process.start()
    leftover = wait_for_part(path.parent, process)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    return leftover


def wait_for_part(folder, process):
    while not (found := [part for part in folder.iterdir() if f"-{process.pid}-" in part.name]):
        assert process.is_alive()
        time.sleep(0.005)
    return found[0]


@pytest.mark.parametrize("again", [io.check_output, lambda path: io.write(path, np.zeros((3, 4), np.float32))])
def test_the_next_run_clears_what_a_killed_one_left(tmp_path, again):
    path = tmp_path / "a[1] long name.mrc"
    leftover = killed_while_writing(path)
    assert leftover.exists()
    again(path)
    assert not leftover.exists()
    assert {file.name for file in tmp_path.iterdir()} <= {path.name}


def test_files_of_running_programs_and_other_names_stay(tmp_path):
    path, other = tmp_path / "volume.mrc", tmp_path / "volume-2.mrc"
    stay = [
        killed_while_writing(other),
        tmp_path / ".volume-abcdefgh.mrc.part",
        tmp_path / ".volume-00000000-999999999-abcdefgh.mrc.part",
    ]
    stay += [tmp_path / f"{_prefix('volume')}abcdefgh.mrc.part", tmp_path / ".volume-notes.mrc"]
    for file in stay[1:]:
        file.touch()
    io.check_output(path)
    assert all(file.exists() for file in stay)


def test_a_folder_that_was_being_replaced_is_put_back(tmp_path):
    path = tmp_path / "volume.zarr"
    leftover = killed_while_writing(path, folder=True)
    (leftover / REPLACED).mkdir()
    (leftover / REPLACED / "whole").touch()
    clear_all_leftovers(tmp_path)
    assert leftover.exists()
    outputs.clear_leftovers(path)
    assert (path / "whole").exists()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_names_nearly_as_long_as_the_disk_allows_are_written(tmp_path):
    path = tmp_path / ("雑" * 80 + ".mrc")
    io.write(path, np.zeros((3, 4), np.float32))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_all_leftovers_of_dead_programs_in_a_folder_are_cleared_and_nothing_else(tmp_path):
    for name in ("fit-001.safetensors", "run.json"):
        killed_while_writing(tmp_path / name)
    stay = [tmp_path / f"{_prefix('volume')}abcdefgh.mrc.part", tmp_path / "notes.part"]
    for file in stay:
        file.mkdir()
    clear_all_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(stay)


def test_what_libraries_leave_beside_their_file_is_cleared_too(tmp_path):
    """safetensors writes to a name of its own, which a killed run would leave for ever."""
    path = tmp_path / "current.safetensors"
    leftover = killed_while_writing(path)
    (leftover / ".tmpAbCdEf").touch()
    io.check_output(path, suffixes=frozenset({".safetensors"}))
    assert not list(tmp_path.iterdir())


def test_the_old_file_is_there_whole_until_the_new_one_is(tmp_path):
    """Renamed, not copied: whoever has the old file open goes on reading it, and nobody sees half a file."""
    path = tmp_path / "volume.npy"
    io.write(path, np.zeros((3, 4), np.float32))
    number = path.stat().st_ino
    with path.open("rb") as old:
        before = old.read()
        io.write(path, np.ones((3, 4), np.float32))
        old.seek(0)
        assert old.read() == before
    assert path.stat().st_ino != number


def test_a_link_stays_a_link_and_its_target_is_written(tmp_path):
    (tmp_path / "disk").mkdir()
    for name, target in (("volume.mrc", "disk/data.mrc"), ("volume.zarr", "disk/data.zarr"), ("new.tif", "disk/new")):
        link = tmp_path / name
        link.symlink_to(target)
        if "new" not in name:
            io.write(tmp_path / target, np.zeros((3, 4), np.float32))
        io.write(link, np.ones((3, 4), np.float32))
        assert link.is_symlink()
        assert not (tmp_path / target).is_symlink()
        assert (io.read(link).data == 1).all()
    assert len(list(tmp_path.iterdir())) == 4
    assert len(list((tmp_path / "disk").iterdir())) == 3


@pytest.mark.parametrize("function", ["mkdir", "rmtree"])
def test_ctrl_c_while_a_temporary_folder_comes_or_goes_leaves_none(tmp_path, monkeypatch, function):
    def interrupted(*words, **more):
        with monkeypatch.context() as patch:
            patch.setattr(owner, function, original)
            original(*words, **more) if function == "mkdir" else None
        monkeypatch.undo()
        raise KeyboardInterrupt

    owner = {"mkdir": pathlib.Path, "rmtree": shutil}[function]
    original = getattr(owner, function)
    monkeypatch.setattr(owner, function, interrupted)
    with pytest.raises(KeyboardInterrupt):
        io.write(tmp_path / "volume.npy", np.zeros((3, 4), np.float32))
    monkeypatch.undo()
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit):
            end_stopped("stopped")
    finally:
        signal.signal(signal.SIGINT, before)
    assert {file.name for file in tmp_path.iterdir()} <= {"volume.npy"}


def test_ctrl_c_while_a_folder_is_replaced_keeps_the_old_one(tmp_path, monkeypatch):
    path, rename = tmp_path / "volume.zarr", pathlib.Path.rename
    path.mkdir()
    (path / "whole").touch()

    def interrupted(source, target):
        rename(source, target)
        if target.name == REPLACED:
            monkeypatch.undo()
            raise KeyboardInterrupt

    monkeypatch.setattr(pathlib.Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt), outputs.atomic_folder(path):
        pass
    assert (path / "whole").exists()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
