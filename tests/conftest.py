"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from noiseflow.commands.cli import main
from tests.seconds import TABLE
from tests.shares import shares

DATA = Path(__file__).parent.parent / "noiseflow" / "data"
# a shell's background jobs ignore Ctrl-C, and the programs under test would inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


gc.disable()  # a quarter of the time of the collection, in which nothing becomes garbage


def pytest_collection_finish() -> None:
    """What stays for the whole run is looked through no more."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of the table as slow; keep one share of the slow tests where ``NOISEFLOW_SLOW_SHARD`` asks for it, as
    ``K/N``: the same share every time."""
    seconds = json.loads(TABLE.read_text(encoding="utf-8"))
    for item in items:
        if item.nodeid in seconds:
            item.add_marker(pytest.mark.slow)
    wanted = os.environ.get("NOISEFLOW_SLOW_SHARD")
    if wanted is None:
        return
    share, count = map(int, wanted.split("/"))
    slow = {item.nodeid: item for item in items if item.get_closest_marker("slow")}
    kept = shares(list(slow), seconds, count)[share]
    left_out = {item for name, item in slow.items() if name not in kept}
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """A command that was stopped ignores Ctrl-C from then on; the programs of later tests would inherit that."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def data() -> Path:
    """Folder of the shipped microscope data."""
    return DATA


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Run a command that must succeed; returns its JSON result."""

    def call(*arguments: str | Path) -> dict[str, Any]:
        with pytest.raises(SystemExit) as stop:
            main([*map(str, arguments), "--json"])
        captured = capsys.readouterr()
        assert stop.value.code in (0, None), captured.err
        result: dict[str, Any] = json.loads(captured.out.splitlines()[-1])
        return result

    return call


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must fail with exit 1 and one line on stderr; returns that line."""

    def call(*arguments: str | Path) -> str:
        with pytest.raises(SystemExit) as stop:
            main([*map(str, arguments)])
        captured = capsys.readouterr()
        assert stop.value.code == 1, captured.err
        lines = captured.err.strip().splitlines()
        assert len(lines) == 1, captured.err
        assert lines[0].startswith("noiseflow: ")
        assert "Traceback" not in captured.err
        return lines[0]

    return call
