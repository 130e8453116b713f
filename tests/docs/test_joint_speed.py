"""The rows of the joint fit's speed can be measured."""

from __future__ import annotations

import pytest


def test_steps_and_skipping_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.pages import joint_speed

    monkeypatch.setattr(joint_speed, "_STEPS", 3)
    row = joint_speed.steps("shells", 16, repeats=1)
    assert row["ratio"] == pytest.approx(row["everywhere"] / row["skipping"])
    row = joint_speed.skipping("shells", 16, joint_speed.VoxelField, repeats=1)
    assert row["all accelerations on, volume PSNR"] > 15
