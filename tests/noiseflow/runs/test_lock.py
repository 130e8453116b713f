"""Two runs never write one output; a dead run holds nobody up."""

from __future__ import annotations

import os
import platform
import signal
import threading
import time

import pytest

from noiseflow import io
from noiseflow.runs.ownership import lock_file
from tests.processes import FORK


def hold(output, told):
    with io.locked(output):
        told.touch()
        time.sleep(60)


def holder(output, told):
    process = FORK.Process(target=hold, args=(output, told))
    process.start()
    while not told.exists():
        assert process.is_alive()
        time.sleep(0.005)
    return process


def kill(process):
    os.kill(process.pid, signal.SIGKILL)
    process.join()


def test_the_second_run_is_told_who_holds_the_output_until_that_one_dies(tmp_path):
    output = tmp_path / "volume.mrc"
    process = holder(output, tmp_path / "told")
    try:
        with pytest.raises(BlockingIOError, match=f"process {process.pid} on {platform.node()}"), io.locked(output):
            pass
        with io.locked(tmp_path / "other.mrc"):
            pass
    finally:
        kill(process)
    assert lock_file(output).exists()
    with io.locked(output):
        assert str(os.getpid()) in lock_file(output).read_text()
    assert [file.name for file in tmp_path.iterdir()] == ["told"]


def test_a_link_and_its_target_share_a_lock(tmp_path):
    (tmp_path / "link.mrc").symlink_to(tmp_path / "volume.mrc")
    process = holder(tmp_path / "volume.mrc", tmp_path / "told")
    try:
        with pytest.raises(BlockingIOError), io.locked(tmp_path / "link.mrc"):
            pass
    finally:
        kill(process)


def test_a_block_within_a_block_holds_the_same_lock_and_another_thread_does_not(tmp_path):
    output, refused = tmp_path / "volume.mrc", []

    def other():
        try:
            with io.locked(output):
                pass
        except BlockingIOError as error:
            refused.append(error)

    with io.locked(output):
        with io.locked(output):
            assert lock_file(output).exists()
        assert lock_file(output).exists()
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(refused) == 1
    assert not lock_file(output).exists()


def increments(output, counter):
    for _ in range(40):
        while True:
            try:
                with io.locked(output):
                    value = int(counter.read_text())
                    time.sleep(0.0002)
                    counter.write_text(str(value + 1))
                break
            except BlockingIOError:
                time.sleep(0.0005)


def test_no_two_processes_are_ever_inside(tmp_path):
    """The lock file is removed and made again all the time: none may lock one that is gone already."""
    counter = tmp_path / "counter"
    counter.write_text("0")
    processes = [FORK.Process(target=increments, args=(tmp_path / "volume.mrc", counter)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert counter.read_text() == "160"


def test_a_lock_file_of_nonsense_is_no_obstacle(tmp_path):
    lock_file(tmp_path / "volume.mrc").write_text("{nonsense")
    with io.locked(tmp_path / "volume.mrc"):
        pass
    assert not list(tmp_path.iterdir())


WRITING = {
    "m.safetensors": "calibrate {data}/exposures_miro/channel1_050ms.tif {data}/exposures_miro/channel1_long.tif -o {held}",
    "noisy.npy": "sample {out}/given.safetensors {out}/clean.npy -o {held}",
    "learnt.safetensors": "reconstruct {data}/tilt_needle/needle_aligned.mrc -o {out}/v.mrc --save-noise-model {held}",
    "v.mrc": "reconstruct {data}/tilt_needle/needle_aligned.mrc -o {held} --method wbp",
    "sized.npy": "export {out}/field.safetensors -o {held}",
    "tilts.mrc": "simulate {out} --size 8",
    "batch.csv": "batch {data}/tilt_needle -o {out}",
    "report.html": "demo --out {out}",
}


@pytest.mark.parametrize("name", WRITING)
def test_no_command_writes_what_another_run_is_writing(tmp_path, data, refused, name):
    process = holder(tmp_path / name, tmp_path / "told")
    try:
        said = refused(*WRITING[name].format(out=tmp_path, held=tmp_path / name, data=data).split())
    finally:
        kill(process)
    assert f"process {process.pid}" in said
    assert {file.name for file in tmp_path.iterdir()} <= {"told", lock_file(tmp_path / name).name}
