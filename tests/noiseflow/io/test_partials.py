"""What a killed program left beside its outputs is cleared by the next run, and nothing else."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from noiseflow import io
from noiseflow.io.partials import partial_prefix
from tests.processes import FORK


def hold(path, folder):
    with (io.files.atomic_folder if folder else io.atomic_path)(path) as partial:
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
        tmp_path / ".volume-abcdefgh.mrc",
        tmp_path / ".volume-00000000-999999999-abcdefgh.mrc",
    ]
    stay += [tmp_path / f"{partial_prefix('volume')}abcdefgh.mrc", tmp_path / ".volume-notes.mrc"]
    for file in stay[1:]:
        file.touch()
    io.check_output(path)
    assert all(file.exists() for file in stay)


def test_a_folder_that_was_being_replaced_is_put_back(tmp_path):
    path = tmp_path / "volume.zarr"
    leftover = killed_while_writing(path, folder=True)
    old = leftover.with_name(leftover.name + ".old")
    old.mkdir()
    (old / "whole").touch()
    io.files.clear_leftovers(path)
    assert (path / "whole").exists()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_names_nearly_as_long_as_the_disk_allows_are_written(tmp_path):
    path = tmp_path / ("雑" * 80 + ".mrc")
    io.write(path, np.zeros((3, 4), np.float32))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
