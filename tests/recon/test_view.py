"""`noiseflow view` serves a report or a volume, on this machine only, until it is stopped."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from noiseflow import io
from noiseflow.report import Report
from recon.commands.view import view
from tests.processes import FORK, wait_for
from tests.test_report_browser import ARGUMENTS, CHROMIUM

Viewer = Callable[[Path], str]


def _serve(output: Path, log: Path) -> None:
    with log.open("w", buffering=1) as sys.stdout:
        view(output, port=0, browser=False, json=True)
        print("ended in order")


@pytest.fixture
def viewed(tmp_path: Path) -> Iterator[Viewer]:
    """Start the command; returns its address. It must end in order when it is interrupted."""
    started = []

    def start(output: Path) -> str:
        log = tmp_path / f"log{len(started)}"
        process = FORK.Process(target=_serve, args=(output, log))
        process.start()
        started.append((process, log))
        wait_for(lambda: log.exists() and '"address"' in log.read_text(), process)
        found = re.search(r'"address": "([^"]+)"', log.read_text())
        assert found is not None
        return found[1]

    yield start
    for process, log in started:
        os.kill(process.pid, signal.SIGINT)
        process.join(10)
        assert process.exitcode == 0
        assert "ended in order" in log.read_text()


def got(address: str, **headers: str) -> str:
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
        return str(answer.read().decode())


@pytest.fixture
def volume(tmp_path: Path) -> Path:
    """A volume with error bars."""
    values = np.random.default_rng(0).random((6, 7, 8), dtype=np.float32)
    for name in ("volume", "volume_std", "volume_bias", "volume_wedge"):
        io.write(tmp_path / f"{name}.mrc", values)
    return tmp_path / "volume.mrc"


def reported(volume: Path) -> Path:
    """A report of a run that wrote the volume."""
    page = Report("the report of this volume").save(volume.parent / "report" / "index.html")
    options = f"# noiseflow 1\nout = '{volume}'\nreport = '{page.parent}'\n"
    volume.with_name("volume.mrc.options.toml").write_text(options)
    return page


def test_a_report_is_served_and_nothing_else(volume: Path, viewed: Viewer) -> None:
    address = viewed(reported(volume).parent)
    assert address.startswith("http://127.0.0.1:")
    assert "the report of this volume" in got(address)
    for more, headers in (("../volume.mrc", {}), ("options.toml", {}), ("", {"Host": "elsewhere.example"})):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            got(address + more, **headers)


def test_a_volume_is_shown_in_its_report_unless_it_is_newer(volume: Path, viewed: Viewer) -> None:
    page = reported(volume)
    assert "the report of this volume" in got(viewed(volume))
    later = page.stat().st_mtime + 10
    os.utime(volume, (later, later))
    assert "the report of this volume" not in got(viewed(volume))


def test_what_cannot_be_shown_is_refused_with_the_fix(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="--report"):
        view(tmp_path / "empty", browser=False)
    np.save(tmp_path / "flat.npy", np.zeros((4, 4)))
    with pytest.raises(ValueError, match="volume"):
        view(tmp_path / "flat.npy", browser=False)


@pytest.mark.skipif(CHROMIUM is None or shutil.which("chromium") is None, reason="needs Chromium")
def test_the_volume_and_its_error_bars_are_drawn_in_a_browser(volume: Path, viewed: Viewer) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    address, faults = viewed(volume), list[str]()
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: faults.append(request.url) if outside(request.url) else None)

        def outside(url: str) -> bool:
            return not url.startswith(("data:", address))

        page.goto(address)
        page.wait_for_selector("html[data-ready]")
        assert page.locator("canvas[aria-label='slice xy']").count() == 4
        assert "could not be shown" not in page.locator("main").inner_text()
        browser.close()
    assert [fault for fault in faults if "favicon" not in fault] == []
