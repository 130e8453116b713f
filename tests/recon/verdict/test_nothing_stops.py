"""A check that is broken on purpose says "not tested"; volume, grade and report are there all the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from noiseflow.checks import Guard, NotTested, Verdict
from recon.report import page
from recon.series import prepare as preparing
from recon.series.tilt_series import TiltSeries
from recon.simulate.simulation import Acquisition
from recon.verdict import judge as judging
from recon.verdict import table
from tests.commands import run_command

Outcome = tuple[TiltSeries, Any]
BEFORE = {"check_contrast": "contrast", "screen": "screening", "_warn_of_outliers": "outliers"}
SHARED = ("coarse_series", "Geometry", "distortions", "expected_images", "first_guess.contrast_slab", "sharp_integrals")
PARTS = [name for name in dir(page) if name.startswith("_add_")]


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    density = np.zeros((16, 16, 16))
    density[5:10, 4:12, 6:11] = 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 5.0))
    return series, recon.reconstruct(series, method="sirt", num_steps=5)


def broken(*_: Any, **__: Any) -> Any:
    raise ZeroDivisionError("broken on purpose")


@pytest.fixture(scope="module")
def verdict(outcome: Outcome) -> Verdict:
    return judging.judge(*outcome)


@pytest.mark.parametrize("value", "01")
@pytest.mark.parametrize("digit", range(len(f"{len(table.CHECKS) - 1:b}")))
def test_a_broken_check_is_not_tested_and_changes_no_other(
    digit: int, value: str, outcome: Outcome, verdict: Verdict, monkeypatch: Any
) -> None:
    """Half of the checks are broken at a time, by a binary digit of their number: of any two, each is once broken alone."""
    named = [name for at, name in enumerate(table.CHECKS) if f"{at:b}".zfill(digit + 1)[-1 - digit] == value]
    for name in named:
        monkeypatch.setitem(table.CHECKS, name, replace(table.CHECKS[name], measure=broken))
    found = judging.judge(*outcome)
    assert {found.not_tested[name] for name in named} == {"ZeroDivisionError: broken on purpose"}
    assert found.evidence == {name: each for name, each in verdict.evidence.items() if name not in named}
    assert found.grade in ("good", "doubtful", "bad")


@pytest.mark.parametrize("part", SHARED)
def test_what_checks_share_may_break(part: str, outcome: Outcome, monkeypatch: Any) -> None:
    monkeypatch.setattr(f"recon.verdict.case.{part}", broken)
    assert "ZeroDivisionError: broken on purpose" in judging.judge(*outcome).not_tested.values()


@pytest.mark.parametrize("part", BEFORE)
def test_a_broken_check_before_the_run_is_not_tested(part: str, outcome: Outcome, monkeypatch: Any) -> None:
    monkeypatch.setattr(preparing, part, broken)
    prepared = recon.prepare(outcome[0])
    assert BEFORE[part] in prepared.guard.not_tested
    assert prepared.tilt_series.num_tilts == outcome[0].num_tilts


@pytest.mark.parametrize("part", ["add_verdict", *PARTS])
def test_a_broken_part_of_the_report_is_left_out(
    part: str, outcome: Outcome, verdict: Verdict, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(page, part, broken)
    guard = Guard()
    report = page.reconstruction_report(*outcome, [], verdict=verdict, guard=guard)
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


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("rows", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("shape", ["ball", "edge"])
def test_checks_of_low_images_apply_or_say_why_not(shape: str, rows: int) -> None:
    """An edge is the same in all rows, and without noise in all their statistics."""
    density = np.zeros((12, rows, 12))
    density[..., 3:] = 1.0
    if shape == "ball":
        density = (
            np.square(np.indices(density.shape) - np.array([6, rows // 2, 5])[:, None, None, None]).sum(0) < 9
        ) * 1.0
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 3.0))
    found = judging.judge(series, recon.reconstruct(series, method="sirt", num_steps=3))
    assert not [reason for reason in found.not_tested.values() if "Error" in reason or "Warning" in reason]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_the_unit_of_the_images_changes_no_check(unit: float) -> None:
    density = np.zeros((20, 20, 20))
    density[6:12, 5:15, 7:13] = 1.0
    acquisition = Acquisition(None, "linear")
    series, _ = recon.clean_tilt_series(density, np.arange(-60, 61, 4.0), acquisition=acquisition)
    noise = np.random.default_rng(0).normal(0, 0.1 * series.images.std(), series.images.shape)

    def judged(unit: float) -> Verdict:
        scaled = preparing.prepare(replace(series, images=((series.images + noise) * unit).astype(np.float32)))
        result = recon.reconstruct(scaled.tilt_series, method="sirt")
        return judging.judge(scaled.tilt_series, result, screening=scaled.screening, guard=scaled.guard)

    found, usual = judged(unit), judged(1.0)
    assert found.not_tested == usual.not_tested
    assert {name: each["cost"] for name, each in found.evidence.items()} == {
        name: pytest.approx(each["cost"], rel=0.01, abs=0.01) for name, each in usual.evidence.items()
    }
