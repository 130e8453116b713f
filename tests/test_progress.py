"""Progress: bars on a terminal of 80 columns, plain lines in logs, nothing with --json."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import sys
import termios
from pathlib import Path

import numpy as np
import pytest
import torch

from noiseflow import progress
from noiseflow.commands.cli import main
from noiseflow.fitting import signal_models
from tests.bad_files import ANGLES, make_good_files

COLUMNS = 80
COMMANDS = {
    "calibrate": "--short {good}/050ms.tif --long {good}/long.tif -o {out}/m.safetensors",
    "simulate": "{out}/new --size 32",
    "reconstruct": "{good}/tilts.mrc -o {out}/v.mrc --method l2 --weight 0.1 --steps 12",
    "sample": "{good}/model.safetensors {good}/tilts.mrc -o {out}/noisy.npy",
    "evaluate": "{good}/model.safetensors --signal {good}/long.tif --observation {good}/050ms.tif --baselines",
    "compare": "{good}/tilts.mrc {good}/tilts.mrc --angles {good}/tilts.rawtlt",
    "demo": "--out {out}/demo",
    "sirt": "{good}/tilts.mrc -o {out}/v.mrc --method sirt --steps 30",
}
QUICK = ("simulate", "sample", "evaluate", "compare", "reconstruct", "sirt")
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("calibrate", "demo")]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    make_good_files(folder)
    assert len(np.loadtxt(folder / "tilts.rawtlt")) == len(ANGLES)
    return folder


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images are sampled in several pieces, as large ones are."""
    monkeypatch.setattr(signal_models, "PART", 1000)


def words(name: str, good: Path, out: Path) -> list[str]:
    command = "reconstruct" if name == "sirt" else name
    return [command, *COMMANDS[name].format(good=good, out=out).split()]


def on_a_terminal(arguments: list[str]) -> str:
    """What a command shows on a terminal of 80 columns."""
    process, terminal = pty.fork()
    if process == 0:
        fcntl.ioctl(1, termios.TIOCSWINSZ, struct.pack("4H", 24, COLUMNS, 0, 0))
        os.environ |= {"TERM": "xterm", "COLUMNS": str(COLUMNS)}
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        torch.set_num_threads(1)
        try:
            main(arguments)
        finally:
            sys.stdout.flush()
            os._exit(0)
    shown = b""
    while part := _read(terminal):
        shown += part
    os.waitpid(process, 0)
    return shown.decode()


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 2**16)
    except OSError:  # the other end is closed
        return b""


@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_bars_fit_a_terminal_and_tell_rate_and_time(name: str, good: Path, tmp_path: Path) -> None:
    shown = on_a_terminal(words(name, good, tmp_path))
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    bars = [line for line in re.split(r"[\r\n]+", plain) if "━" in line]
    assert bars, shown
    assert max(map(len, bars)) <= COLUMNS
    assert any(re.search(r"\d+/\d+ +[\d.]+/s +(\d+:\d\d|-:--)", line) for line in bars), bars[-3:]
    assert not any("…" in line.partition("━")[0] for line in bars), bars[-3:]


@pytest.mark.parametrize("name", [*QUICK, *SLOW])
def test_logs_have_plain_lines_and_json_none(name: str, good: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(progress, "_LOG_SECONDS", -1.0)
    for more in ([], ["--json"]):
        with pytest.raises(SystemExit) as ended:
            main([*words(name, good, tmp_path), *more, "--debug"])  # an error shows where it comes from
        printed = capsys.readouterr()
        assert not ended.value.code, printed.err
        lines = re.findall(r"^\S.*: \d+/\d+, [\d.e-]+ steps/s, [\d.]+ (?:s|min|h) left.*$", printed.err, re.MULTILINE)
        assert bool(lines) != bool(more), printed.err
        assert "\x1b" not in printed.out + printed.err
        if more:
            assert printed.out.count("\n") == 1


def test_the_rate_is_that_of_the_last_half_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    rate = progress._Rate()
    assert rate("fit", 1) == 0
    for done in range(2, 101):  # a hundred quick steps, then slow ones
        now += 0.1
        assert rate("fit", done) == pytest.approx(10)
    for done in range(101, 131):
        now += 1.0
        found = rate("fit", done)
    assert found == pytest.approx(1)
    assert rate("verdict", 1) == 0
