"""A check that is broken on purpose says "not tested"; volume, grade and report are there all the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from noiseflow.checks import Guard, NotTested
from recon.report import page
from recon.series import prepare as preparing
from recon.series.tilt_series import TiltSeries
from recon.verdict import case, table
from recon.verdict import judge as judging
from tests.commands import run_command

Outcome = tuple[TiltSeries, Any]
BEFORE = {"check_contrast": "contrast", "screen": "screening", "_warn_of_outliers": "outliers"}
SHARED = ("coarse_series", "Geometry", "distortions", "expected_images", "contrast_slab", "sharp_integrals")
PARTS = [name for name in dir(page) if name.startswith("_add_")]


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    density = np.zeros((16, 16, 16))
    density[5:10, 4:12, 6:11] = 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 5.0))
    return series, recon.reconstruct(series, method="sirt", num_steps=5)


def broken(*_: Any, **__: Any) -> Any:
    raise ZeroDivisionError("broken on purpose")


@pytest.mark.parametrize("name", table.CHECKS)
def test_a_broken_check_is_not_tested(name: str, outcome: Outcome, monkeypatch: Any) -> None:
    monkeypatch.setitem(table.CHECKS, name, replace(table.CHECKS[name], measure=broken))
    verdict = judging.judge(*outcome)
    assert verdict.not_tested[name] == "ZeroDivisionError: broken on purpose"
    assert verdict.grade in ("good", "doubtful", "bad")


@pytest.mark.parametrize("part", SHARED)
def test_what_checks_share_may_break(part: str, outcome: Outcome, monkeypatch: Any) -> None:
    monkeypatch.setattr(case, part, broken)
    assert "ZeroDivisionError: broken on purpose" in judging.judge(*outcome).not_tested.values()


@pytest.mark.parametrize("part", BEFORE)
def test_a_broken_check_before_the_run_is_not_tested(part: str, outcome: Outcome, monkeypatch: Any) -> None:
    monkeypatch.setattr(preparing, part, broken)
    prepared = recon.prepare(outcome[0])
    assert BEFORE[part] in prepared.guard.not_tested
    assert prepared.tilt_series.num_tilts == outcome[0].num_tilts


@pytest.mark.parametrize("part", ["add_verdict", *PARTS])
def test_a_broken_part_of_the_report_is_left_out(part: str, outcome: Outcome, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(page, part, broken)
    guard = Guard()
    report = page.reconstruction_report(*outcome, [], verdict=judging.judge(*outcome), guard=guard)
    assert [name for name in guard.not_tested if name.startswith("report: ")]
    assert "broken on purpose" in report.save(tmp_path / "index.html").read_text(encoding="utf-8")


def test_a_run_with_every_check_broken_keeps_its_volume(outcome: Outcome, tmp_path: Path, monkeypatch: Any) -> None:
    recon.write_tilt_series(tmp_path / "tilts.mrc", outcome[0])
    for name in table.CHECKS:
        monkeypatch.setitem(table.CHECKS, name, replace(table.CHECKS[name], measure=broken))
    for part in BEFORE:
        monkeypatch.setattr(preparing, part, broken)
    for part in ("add_verdict", *PARTS):
        monkeypatch.setattr(page, part, broken)
    options = ("--method", "sirt", "--steps", 5, "--fsc", "--report", tmp_path / "report")
    found = run_command("reconstruct", tmp_path / "tilts.mrc", "-o", tmp_path / "v.mrc", *options)
    assert (tmp_path / "v.mrc").exists()
    assert (tmp_path / "report" / "index.html").exists()
    assert found["verdict"]["grade"] == "good"
    assert set(table.CHECKS) | set(BEFORE.values()) <= set(found["verdict"]["not_tested"])


def test_a_check_that_does_not_apply_gives_its_reason() -> None:
    def check() -> int:
        raise NotTested("no second axis")

    def stopped() -> int:
        raise KeyboardInterrupt

    guard = Guard()
    assert guard("dual axis", check, otherwise=3) == 3
    assert guard.not_tested == {"dual axis": "no second axis"}
    with pytest.raises(KeyboardInterrupt):
        guard("stopped", stopped, otherwise=3)
