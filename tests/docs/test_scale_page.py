"""The scale benchmark's measures of volumes and processes are right."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest

from noiseflow import io
from recon.metrics.metrics import compare
from recon.scale.blocks import HALO, blocks


def test_a_seam_is_the_jump_across_a_border() -> None:
    from benchmarks.pages.scale_measure import middle_rows, psnr, seams, seams_beside

    generator = np.random.default_rng(0)
    truth = generator.random((6, 64, 8), dtype=np.float32)
    found = truth + np.float32(0.01) * generator.standard_normal(truth.shape, dtype=np.float32)
    assert seams_beside(found, truth, truth, 20) == pytest.approx(1, abs=0.02)
    found[:, blocks(64, 20, HALO)[2].rows.start :] += 5
    said = seams(found, truth, 20)
    assert said["blocks"] == 4
    assert said["seam"] > 10
    assert said["seam of the truth"] == pytest.approx(1, abs=0.3)
    assert seams_beside(found, truth, truth, 20) > 10
    assert psnr(found, truth) == pytest.approx(compare(found, truth).psnr, rel=1e-5)
    assert psnr(found, truth, rows=slice(0, 20)) > 35
    assert middle_rows(512) == slice(224, 288)
    assert middle_rows(40) == slice(0, 40)
    assert said["seam in vacuum"] is None
    half = truth.copy()
    half[:, 40:] = 0
    beyond = half.copy()
    beyond[:, blocks(64, 20, HALO)[3].rows.start :] = 1e-3
    said = seams(beyond, half, 20)
    assert said["seam"] == said["seam of the truth"], "a border in vacuum has no neighbours to be compared with"
    assert said["seam in vacuum"] == pytest.approx(3e-3, rel=0.1)
    empty = np.zeros_like(truth)
    assert seams(empty, empty, 20)["seam"] == 1
    assert seams(found, truth, None)["seam"] is None


def test_memory_of_a_command_is_that_of_its_own_process(tmp_path: Path) -> None:
    from benchmarks.pages.scale_measure import run

    array = np.random.default_rng(0).random((8, 8, 8), dtype=np.float32)
    io.write(tmp_path / "v.mrc", array)
    held = np.ones(2**28, np.uint8)  # of this process, and not of the child's
    figures, said = run("compare", tmp_path / "v.mrc", tmp_path / "v.mrc", threads=1)
    assert said["errors"]["raw"]["mse"] == 0
    inherited = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # a child begins with its parent's peak
    assert 0.05 < figures["peak GiB"] < max(1.0, 1.01 * inherited)
    assert figures["processor seconds"] > 0.1
    del held
    with pytest.raises(RuntimeError, match=r"missing\.mrc"):
        run("compare", tmp_path / "missing.mrc", tmp_path / "v.mrc", threads=1)
