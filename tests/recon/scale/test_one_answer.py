"""Blocks give the volume of a whole fit: as good, and without seams; on Dask workers too, though one of them dies."""

import gc
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from noiseflow import Gaussian
from recon.joint.checkpoint import Journal
from recon.joint.joint import JointReconstructor
from recon.joint.run import run_fit
from recon.methods import reconstruct
from recon.metrics.metrics import compare
from recon.projection.tiles import Tile
from recon.scale.blocks import (
    HALO,
    BlockFiles,
    Blockwise,
    block_memory,
    blocks,
    client_of,
    reconstruct_in_blocks,
)
from recon.scale.memory import _group_available, choose_slices, needed_memory
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series


def scene(phantom, size, step=3.0):
    density = make_phantom(phantom, size, generator=np.random.default_rng(1))
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, step), acquisition=ACQUISITIONS["clipped"])
    return density * unit, add_noise(clean, ACQUISITIONS["clipped"].noise(), seed=2)


@pytest.mark.slow
@pytest.mark.parametrize("phantom", ["shells", "slab"])
def test_blocks_are_as_good_as_a_whole_fit_and_show_no_seam(phantom, tmp_path):
    truth, noisy = scene(phantom, 48)
    whole = reconstruct(noisy, method="joint").volume.attenuation
    found = reconstruct(noisy, method="joint", slices_at_once=16, scratch=tmp_path / "v.npy").volume.attenuation
    # of the slab, which leaves no vacuum, blocks as low as these lose a little; blocks of 64 slices have fewer borders
    assert compare(found, truth).psnr > compare(whole, truth).psnr - (0.02 if phantom == "shells" else 0.04)
    jumps = [np.abs(np.diff(volume, axis=1)).mean((0, 2)) for volume in (truth, whole, found)]
    for border in (15, 31):
        near = [index for index in range(border - 8, border + 9) if index != border]
        of_truth, of_whole, of_found = (jump[border] / np.median(jump[near]) for jump in jumps)
        assert of_found < 1.1 * max(of_truth, of_whole)


def test_blocks_cover_every_slice_once():
    for height, at_once in ((65, 64), (64, 64), (7, 100), (100, 7)):
        parts = blocks(height, at_once, 8)
        assert [row for part in parts for row in range(height)[part.rows]] == list(range(height))
        assert max(part.rows.stop - part.rows.start for part in parts) <= at_once


def test_blocks_of_a_low_volume_that_see_the_same_slices_are_files_of_their_own(tmp_path):
    """Their shares of the power by shell differ."""
    files, parts = BlockFiles(tmp_path, error_bars=True), blocks(16, 8, HALO)
    assert parts[0].wide == parts[1].wide
    for part in parts:
        assert not files.finished(part)
        files.write(part, *(np.full((2, 2, 2), part.rows.start, np.float32) for _ in files.names))
    assert [int(files.read(part)[0].max()) for part in parts] == [0, 8]


def test_a_finished_block_is_not_computed_again(tmp_path):
    _, noisy = scene("shells", 28, 12.0)
    options = {"method": "l2", "weight": 0.5, "num_steps": 8, "slices_at_once": 14}
    journal = Journal(tmp_path / "kept", {})
    options |= {"run_fit": journal.fit, "forget": journal.forget}
    first = reconstruct(noisy, scratch=tmp_path / "a.npy", keep=journal.keep, **options).volume.attenuation
    states = [file.name for file in (tmp_path / "kept").glob("*.safetensors")]
    assert states  # of what is settled for all blocks, and none of a finished block
    assert not [name for name in states if name.startswith("slices")]
    (part,) = [part for part in blocks(28, 14, HALO) if part.rows.start == 0]
    files = BlockFiles(journal.keep())
    volume, projections = (np.array(array) for array in files.read(part))
    files.write(part, volume + 1, projections)
    again = Journal(tmp_path / "kept", {}, resume=True)
    options |= {"run_fit": again.fit, "forget": again.forget}
    second = reconstruct(noisy, scratch=tmp_path / "b.npy", keep=again.keep, **options).volume.attenuation
    np.testing.assert_allclose(second[:, :10], first[:, :10] + 1, atol=1e-5)
    np.testing.assert_array_equal(second[:, 18:], first[:, 18:])
    again.discard()
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize("density", [0.0, 0.1])
def test_a_block_of_vacuum_takes_no_step(density):
    """The lower half holds nothing, and the images say so: no fit. Where they show a faint object there, it is fitted."""
    generator = np.random.default_rng(0)
    images = np.ones((21, 64, 32), np.float32)
    images[:, 8:20, 10:22] = 0.5
    images[:, 40:52, 10:22] -= density
    images += 0.02 * generator.standard_normal(images.shape).astype(np.float32)
    noisy, grid, rows, names = TiltSeries(images, np.arange(-60, 61, 6.0)), VolumeGrid(32, 64, 32), slice(32, 64), []

    def counted(name, *arguments, **options):
        names.append(name)
        return run_fit(name, *arguments, **options)

    # at half this weight, the largest of 512 sums of noise asks for a block in one of three draws
    fit = JointReconstructor(weight=8.0, num_steps=20, noise_model=Gaussian, run_fit=counted)
    settled = fit.settle(noisy, grid)
    settled = replace(settled, response={name: torch.zeros_like(value) for name, value in settled.response.items()})
    if density:  # too little for the coarse volume to show
        settled = replace(settled, start=replace(settled.start, rough=settled.start.rough.clone()))
        settled.start.rough[:, settled.start.rough.shape[1] // 2 :] = 0
    names.clear()
    found = fit.fit(noisy.rows(rows), replace(grid, height=32), settled, rows=rows)
    assert found.volume.attenuation.any() == bool(names) == bool(density)
    assert found.projections.shape == (21, 32, 32)


def test_what_blocks_take_over_holds_no_matrices_of_tiles_and_still_projects():
    _, noisy = scene("shells", 32, 6.0)
    fit = JointReconstructor(weight=4.0, num_steps=10, noise_model=Gaussian)
    settled = fit.settle(noisy, VolumeGrid.of(noisy))
    gc.collect()
    kept = [each for each in gc.get_objects() if isinstance(each, Tile)]
    assert not kept
    model = settled.signal_model
    said = model.signal()  # makes them again
    model.let_go()
    assert torch.equal(model.signal(), said)


@pytest.mark.slow
def test_a_killed_worker_changes_not_a_bit(tmp_path):
    dask = pytest.importorskip("dask.distributed")
    _, noisy = scene("shells", 32, 6.0)
    options = {"method": "l2", "weight": 0.5, "num_steps": 60, "slices_at_once": 8}
    volumes = []
    for kill in (False, True):
        with (
            dask.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster,
            dask.Client(cluster, set_as_default=False) as client,
        ):
            journal = Journal(tmp_path / f"kept-{kill}", {})
            if kill:
                victim = next(iter(client.run(os.getpid).values()))
                watch = _kill_once(victim, journal.keep())
            found = reconstruct(noisy, scratch=tmp_path / f"{kill}.npy", keep=journal.keep, client=client, **options)
            if kill:
                watch.join(60)
                assert victim not in client.run(os.getpid).values()
            volumes.append(np.array(found.volume.attenuation))
    np.testing.assert_array_equal(*volumes)


def _kill_once(process: int, folder: Path):
    """Kill a worker once the first block is whole and others are being fitted."""
    import threading
    import time

    def watch() -> None:
        for _ in range(6000):
            if list(folder.glob("projections-*.npy")):
                break
            time.sleep(0.01)
        os.kill(process, signal.SIGKILL)

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


def _die(series, block):
    os.kill(os.getpid(), signal.SIGKILL)


def test_workers_that_all_die_are_one_line(tmp_path):
    """As where their memory is short: the error names that, and no fault of the library."""
    dask = pytest.importorskip("dask.distributed")
    from dask import config

    _, noisy = scene("shells", 16, 30.0)
    grid, blockwise = VolumeGrid.of(noisy), Blockwise(_die, lambda *_: None)
    options = {"scratch": tmp_path / "v.npy", "folder": None, "slices_at_once": 8}
    local = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": 50}
    with (
        config.set({"distributed.scheduler.allowed-failures": 0}),
        dask.LocalCluster(**local) as cluster,
        dask.Client(cluster, set_as_default=False) as client,
        pytest.raises(ConnectionError, match=r"died.*fewer workers"),
    ):
        reconstruct_in_blocks(blockwise, noisy, grid, client=client, **options)


def test_an_unreachable_scheduler_is_one_line():
    pytest.importorskip("dask.distributed")
    from dask import config

    with (
        config.set({"distributed.comm.timeouts.connect": "500ms"}),
        pytest.raises(ConnectionError, match=r"no Dask scheduler at tcp://127.0.0.1:9"),
        client_of(None, "tcp://127.0.0.1:9"),
    ):
        pass


@pytest.mark.parametrize(("limit", "left"), [("8000\n", 8000 - (7500 - 6000)), ("max\n", None)])
def test_files_that_were_read_do_not_count_against_the_memory_of_a_container(tmp_path, limit, left):
    (tmp_path / "memory.max").write_text(limit)
    (tmp_path / "memory.current").write_text("7500\n")
    (tmp_path / "memory.stat").write_text("anon 1000\nfile 6500\ninactive_file 6000\nactive_file 500\n")
    assert _group_available(tmp_path) == left
    assert _group_available(tmp_path / "none") is None


def test_slices_are_chosen_by_the_memory_that_is_free():

    class Virtual(TiltSeries):  # of 79 images of 1000², without their pixels
        def __init__(self):
            object.__setattr__(self, "images", np.broadcast_to(np.float32(1), (79, 1000, 1000)))
            object.__setattr__(self, "mask", None)
            object.__setattr__(self, "tilt_angles", np.arange(79.0))

    series, grid = Virtual(), VolumeGrid(1000, 1000, 1000)
    assert choose_slices(series, grid, 2**40) is None
    slices = choose_slices(series, grid, 12 * 2**30)
    assert slices is not None
    assert needed_memory(*block_memory(series, grid, slices, fitted=True)) < 12 * 2**30
    assert choose_slices(series, grid, 24 * 2**30, workers=2) == slices
    assert choose_slices(series, grid, 2**40, plenty=4 * 2**30) == 64
    lower = choose_slices(series, grid, 22 * 2**30)  # 64 slices would fit, and take more than half
    assert 32 <= lower < 64
    assert needed_memory(*block_memory(series, grid, lower, fitted=True)) < 11 * 2**30
    with pytest.raises(MemoryError, match="--thickness"):
        choose_slices(series, grid, 2**30)
