"""Ctrl-C at any moment of any command: one line, exit code 130, and every file whole or not there."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import benchmarks.named
import calibration.report.page
import noiseflow
import recon.commands.results
import recon.simulate.simulation
from noiseflow import io
from noiseflow.commands import cli, console
from recon.commands.volume_run import StopSignal, stoppable
from recon.joint.checkpoint import Journal
from tests.bad_files import make_good_files
from tests.processes import finish, start

COMMANDS = {
    "calibrate": "--short {good}/050ms.tif --long {good}/long.tif -o {out}/m.safetensors --report {out}/report",
    "sample": "{good}/model.safetensors {good}/large.npy -o {out}/noisy.tif",
    "evaluate": "{good}/model.safetensors --signal {good}/large.npy --observation {good}/noisy.npy --baselines",
    "simulate": "{out}/new --size 64",
    "reconstruct": "{good}/series/tilts.mrc -o {out}/v.mrc --method l2 --steps 60 --report {out}/report --fsc",
    "compare": "{good}/series/truth.mrc {good}/series/truth.mrc --angles {good}/series/tilts.rawtlt --report {out}/report",
    "benchmark": "--quick --size 12 --out {out}/benchmark",
    "demo": "--out {out}/demo",
}
LOADED = (calibration.report, benchmarks.named, recon.commands.results, recon.simulate.simulation)
SPAN = {"sample": 0.3, "simulate": 0.8, "compare": 2.0, "evaluate": 4.0, "reconstruct": 6.0}
"""Seconds to stop within; about as long as the command takes, or some of the longer ones' many."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    assert LOADED  # in this process, so that a forked one need not import them
    folder = tmp_path_factory.mktemp("good")
    make_good_files(folder)
    np.save(folder / "large.npy", np.random.default_rng(0).random((700, 700)))
    np.save(folder / "noisy.npy", np.random.default_rng(1).random((700, 700)))
    finish(["simulate", folder / "series", "--size", 24, "--tilts=-60:60:6"], folder / "log")
    return folder


def words(name: str, good: Path, out: Path) -> list[str]:
    return COMMANDS[name].format(good=good, out=out).split()


def require_whole(folder: Path) -> None:
    for path in folder.rglob("*"):
        assert not path.name.startswith("."), path
        if path.suffix == ".safetensors" and "checkpoint" not in str(path):
            noiseflow.load(path)
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".html":
            assert path.read_text().rstrip().endswith("</html>")
        elif path.suffix in io.SUFFIXES:
            io.read(path)


def stop(name: str, good: Path, out: Path, moment: float, times: int = 1) -> int:
    """Stop a command after so many seconds, see that it left all whole, and return its exit code: 130, or 0 if it was done."""
    log = out.with_suffix(".log")
    process = start([name, *words(name, good, out)], log)
    process.join(0.02 + moment)
    for _ in range(times):
        if process.is_alive():
            os.kill(process.pid, signal.SIGINT)
            time.sleep(0.001)
    process.join(60)
    printed = log.read_text()
    assert process.exitcode in (0, 130), f"{process.exitcode}: {printed}"
    assert "Traceback" not in printed
    if process.exitcode == 130:
        last = (printed.strip().splitlines() or [""])[-1]
        assert re.match(
            r"noiseflow: .*(to start again|same command to resume|resume with: noiseflow .* --resume)$", last
        ), printed
    require_whole(out)
    return int(process.exitcode)


def stops(name: str, good: Path, folder: Path, count: int, times: int, randomness: random.Random) -> list[int]:
    codes = []
    for number in range(count):
        out = folder / str(number)
        out.mkdir()
        codes.append(stop(name, good, out, randomness.uniform(0, SPAN.get(name, 10.0)), times))
    return codes


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_ctrl_c_leaves_whole_files_and_one_line(name: str, good: Path, tmp_path: Path) -> None:
    assert stops(name, good, tmp_path, 1, 1, random.Random(name))[0] in (0, 130)  # 0: it was done before


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_ctrl_c_at_any_moment(name: str, times: int, good: Path, tmp_path: Path) -> None:
    assert 130 in stops(name, good, tmp_path, 10, times, random.Random(times))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_program_that_is_stopped_ends_with_130(number: signal.Signals, good: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "noiseflow",
        "reconstruct",
        good / "series" / "tilts.mrc",
        "-o",
        tmp_path / "v.mrc",
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert any("memory: about" in process.stdout.readline() for _ in range(2))  # after the mode
        process.send_signal(number)
        _, printed = process.communicate(timeout=60)
    assert process.returncode == 130, printed
    assert printed.strip().splitlines()[-1].startswith("noiseflow: ")
    assert "Traceback" not in printed
    assert not (tmp_path / "v.mrc").exists()


def test_ctrl_c_while_an_object_is_cleared_away_is_not_lost() -> None:
    program = """
import os, signal, time
from noiseflow.commands.cli import _keep_ctrl_c

class Cleared:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

_keep_ctrl_c()
try:
    Cleared()
    time.sleep(30)
except KeyboardInterrupt:
    print("stopped")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert (done.stdout, done.stderr) == ("stopped\n", "")


def test_ctrl_c_after_the_work_changes_nothing() -> None:
    program = """
import os, signal, sys
from noiseflow.commands import cli

class Last:
    def __del__(self, kill=os.kill, process=os.getpid(), number=signal.SIGINT):
        kill(process, number)

last = Last()  # cleared away when Python has shut down nearly all else
sys.argv = ["noiseflow", "--version"]
cli.main()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_that_became_another_error_is_one_still(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def stopped(*_: object, **__: object) -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ImportError("initialization failed")

    monkeypatch.setattr(cli, "build_app", lambda *_: stopped)
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop:
            cli.main(["doctor"])
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 130
    assert capsys.readouterr().err == f"noiseflow: stopped; {console.START_AGAIN}\n"


def test_ctrl_c_while_a_line_is_written_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Writing:
        def write(self, text: str) -> int:
            raise RuntimeError("reentrant call")

        def flush(self) -> None:
            self.write("")

        def fileno(self) -> int:
            return file.fileno()

    journal = Journal(tmp_path / "journal", {})
    journal.in_fit = True
    with (tmp_path / "told").open("wb") as file, monkeypatch.context() as patch, StopSignal(journal):
        patch.setattr(sys, "stderr", Writing())
        signal.raise_signal(signal.SIGINT)
    assert journal.stop_requested
    assert "finishing this step" in (tmp_path / "told").read_text()


def test_a_second_ctrl_c_while_signals_are_handed_back_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    exit_of_signals = StopSignal.__exit__

    def interrupted(self: StopSignal, *error: object) -> None:
        exit_of_signals(self, *error)
        raise KeyboardInterrupt

    journal = Journal(tmp_path / "journal", {})
    monkeypatch.setattr(StopSignal, "__exit__", interrupted)
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as end, stoppable(journal):
            pass
    finally:
        signal.signal(signal.SIGINT, before)
    assert end.value.code == 130
    assert re.search("resume with: noiseflow reconstruct|to start again", capsys.readouterr().err)


def test_a_file_closed_twice_by_an_interrupt_is_no_fault_of_the_disk(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal", {})
    journal.abandoned = True
    with pytest.raises(SystemExit) as end, stoppable(journal):
        os.close(2**20)
    assert end.value.code == 130
