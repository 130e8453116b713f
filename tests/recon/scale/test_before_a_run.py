"""What is found out before a volume is reconstructed: its plan, in the memory of a few slices, and its blocks, once."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from noiseflow.commands.console import Output
from recon.commands.options import ReconstructOptions
from recon.commands.volume_run import VolumeRun
from recon.fields.kinds.grids import MultiresolutionField
from recon.joint.checkpoint import Journal
from recon.joint.joint import JointReconstructor
from recon.methods import find_method
from recon.scale.blocks import HALO, SETTLED_ON, assemble, blocks, fitted_slices
from recon.scale.memory import needed_memory
from recon.series.files import write_tilt_series
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series


@pytest.fixture(scope="module")
def series():
    """A series of 80 slices, of which those in the middle show something."""
    clean, _ = clean_tilt_series(
        make_phantom("shells", 32, generator=np.random.default_rng(1), count=6), np.arange(-60, 61, 12.0)
    )
    tall = np.ones((clean.num_tilts, 80, 32), np.float32)
    tall[:, 24:56] = clean.images
    return add_noise(TiltSeries(tall, clean.tilt_angles), ACQUISITIONS["clipped"].noise(), seed=2)


@pytest.fixture
def tilts(series, tmp_path):
    write_tilt_series(tmp_path / "tilts.mrc", series)
    return tmp_path / "tilts.mrc"


def test_planning_makes_no_field_of_the_whole_volume(series):
    """`--dry-run` of a volume that does not fit into memory must not need that memory."""
    heights = []

    def make_field(shape, **options):
        heights.append(shape[1])
        return MultiresolutionField(shape, **options)

    grid, fit = VolumeGrid.of(series), JointReconstructor(make_field=make_field, slab=8)
    _, slab, share = fit.plan(series, grid)
    assert heights
    assert max(heights) <= 16
    assert slab == 8
    assert share == pytest.approx(fit.signal_model(series, grid).occupancy.share, abs=1e-6)


def test_a_dry_run_names_blocks_memory_disk_and_time(tilts, tmp_path, run):
    command = ["reconstruct", tilts, "-o", tmp_path / "v.mrc", "--dry-run"]
    whole, parts = run(*command), run(*command, "--slices-at-once", 20)
    assert whole["slices_at_once"] is None
    assert whole["disk"].startswith("blocks: none; disk: about")
    assert parts["slices_at_once"] == 20
    assert re.fullmatch("blocks: 4 of at most 20 slices; disk: about [1-9][0-9]* MiB during the run", parts["disk"])
    assert parts["memory"].startswith("memory: about")
    assert parts["expected_seconds"] > 0
    assert not (tmp_path / "v.mrc").exists()
    assert not (tmp_path / "v.mrc.checkpoint").exists()


def test_slices_of_a_halo_are_fitted_twice():
    wide = [part.wide for part in blocks(80, 20, HALO)]
    assert fitted_slices(80, 20) == sum(each.stop - each.start for each in wide) + SETTLED_ON
    assert fitted_slices(30, 30) == 60


def test_a_run_that_resumes_keeps_its_blocks_however_much_memory_is_free(tilts, tmp_path, run, refused, monkeypatch):
    """With other blocks, those that are done would be computed again."""
    solved = []
    command = ["reconstruct", tilts, "-o", tmp_path / "v.mrc", "--method", "sirt", "--steps", 4]

    def no_room(*_):
        raise OSError(28, "No space left on device")

    def counted(method, tilt_series, block, files, solve=None):
        solved.append(files.finished(block))
        original(method, tilt_series, block, files)

    from recon.scale import blocks as scale

    original = scale.solve_block
    monkeypatch.setattr("recon.scale.blocks.solve_block", counted)
    monkeypatch.setattr("recon.commands.volume_run.choose_slices", lambda *_, **__: 16)
    monkeypatch.setattr("recon.scale.blocks.assemble", no_room)
    assert "--resume" in refused(*command)
    assert solved == [False] * 5
    monkeypatch.setattr("recon.commands.volume_run.choose_slices", lambda *_, **__: None)
    monkeypatch.setattr("recon.scale.blocks.assemble", assemble)
    solved.clear()
    assert run(*command, "--resume")["slices_at_once"] == 16
    assert solved == [True] * 5
    assert run(*command)["slices_at_once"] is None  # a new run chooses for itself


def test_workers_cannot_join_a_volume_that_was_begun_in_one_piece(series, tmp_path):
    grid, kept = VolumeGrid.of(series), Journal(tmp_path / "kept", {})
    chosen = {
        workers: VolumeRun(ReconstructOptions([], tmp_path, method="l2", workers=workers), Output(False), "cpu").slices
        for workers in (None, 1, 2)
    }
    assert chosen[None](kept, series, grid) is None
    kept.keep()  # writes
    again = Journal(tmp_path / "kept", {}, resume=True)
    with pytest.raises(ValueError, match=r"in one piece.*remove --workers"):
        chosen[2](again, series, grid)
    assert chosen[2](Journal(tmp_path / "kept", {}), series, grid) == 40
    assert chosen[1](Journal(tmp_path / "new", {}), series, grid) is None


@pytest.mark.parametrize("option", [("--workers", 2), ("--scheduler", "tcp://127.0.0.1:9")])
def test_workers_of_a_method_without_blocks_are_refused(tilts, tmp_path, refused, option):
    said = refused("reconstruct", tilts, "-o", tmp_path / "v.mrc", "--method", "wbp-denoised", *option)
    assert f"{option[0]}: method wbp-denoised" in said
    assert "wbp, or remove" in said


_PEAK = "print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')).split()[1])"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs the peak memory that Linux records")
@pytest.mark.parametrize("field", ["grids", "gaussians", "network"])
@pytest.mark.parametrize("size", [32, 56])
def test_the_expected_memory_suffices(tmp_path, size, field):
    density = make_phantom("particles", size, generator=np.random.default_rng(0))
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 2.0), acquisition=ACQUISITIONS["low-dose"])
    series = add_noise(clean, ACQUISITIONS["low-dose"].noise(), seed=1)
    write_tilt_series(tmp_path / "tilts.mrc", series)
    command = ["reconstruct", tmp_path / "tilts.mrc", "-o", tmp_path / "v.mrc", "--mode", "linear", "--device", "cpu"]
    words = [str(word) for word in (*command, "--field", field, "--steps", 8, "--weight", 1)]
    code = f"from noiseflow.commands.cli import main\ntry: main({words})\nexcept SystemExit: {_PEAK}"
    peak = 1024 * int(subprocess.check_output([sys.executable, "-c", code], text=True).splitlines()[-1])
    expected = needed_memory(series, VolumeGrid.of(series), more=find_method("joint").more_memory(field))
    assert 0.4 * expected < peak <= expected
