"""Many series: one table, and one that fails stops no other."""

import csv

import numpy as np
import pytest

from noiseflow import io
from noiseflow.runs.ownership import is_own
from recon.scale.many import Job, finished, jobs_of, read_table, write_table
from recon.series.files import write_tilt_series
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from tests.commands import run_command


@pytest.fixture
def folder(tmp_path):
    """Two sound series, a damaged one between them, and a volume, which is no series."""
    density = make_phantom("shells", 24, generator=np.random.default_rng(1), count=6)
    clean, unit = clean_tilt_series(density, np.arange(-60, 61, 8.0))
    folder = tmp_path / "series"
    folder.mkdir()
    for seed, name in enumerate(("a", "b", "c")):
        write_tilt_series(folder / f"{name}.mrc", add_noise(clean, ACQUISITIONS["skewed"].noise(), seed=seed))
    whole = (folder / "b.mrc").read_bytes()
    (folder / "b.mrc").write_bytes(whole[:3000])
    io.write(folder / "truth.mrc", density * unit)
    (folder / "notes").mkdir()
    (folder / "one of many").mkdir()
    (folder / "one of many" / "tilts.mrc").write_bytes(whole)
    return folder, whole


def test_a_series_that_fails_stops_no_other_and_is_tried_again(folder, tmp_path):
    series, whole = folder
    words = ["batch", series, "-o", tmp_path / "out", "--options", "--method wbp --window hann", "--workers", 2]
    with pytest.raises(ValueError, match="1 of 3 series failed"):
        run_command(*words)
    rows = read_table(tmp_path / "out" / "batch.csv")
    assert [row["status"] for row in rows] == ["done", "failed", "done"]
    assert "truncated" in rows[1]["error"]
    assert all(row["verdict"] in ("good", "doubtful", "bad") and row["reason"] for row in (rows[0], rows[2]))
    assert io.read(tmp_path / "out" / "c.mrc").data.shape == (24, 24, 24)
    assert not (tmp_path / "out" / "truth.mrc").exists()
    written = (tmp_path / "out" / "a.mrc").stat().st_mtime_ns
    (series / "b.mrc").write_bytes(whole)
    found = run_command(*words, "--resume")
    assert [row["status"] for row in found["series"]] == ["done"] * 3
    assert found["left_out"] == ["truth.mrc", "one of many/"]
    assert (tmp_path / "out" / "a.mrc").stat().st_mtime_ns == written


def test_volumes_made_with_other_options_are_not_finished(tmp_path):
    volume, words = tmp_path / "a.mrc", ("--method", "sirt", "--resume")
    volume.touch()
    write_table(tmp_path / "t.csv", [{"volume": str(volume), "status": "done", "options": "--method sirt"}])
    rows = read_table(tmp_path / "t.csv")
    assert finished(rows, [Job(tmp_path / "tilts.mrc", volume, words)]) == rows == finished(rows, [])
    assert finished(rows, [Job(tmp_path / "tilts.mrc", volume, ("--method", "wbp"))]) == []
    assert is_own(tmp_path / "t.csv")
    volume.unlink()
    assert finished(rows, []) == []


@pytest.mark.usefixtures("folder")
def test_a_table_gives_each_series_its_own_options(tmp_path):
    with (tmp_path / "list.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["tilts", "out", "thickness", "invert-tilt"])
        writer.writerow(["series/a.mrc", "special.mrc", "10", "yes"])
        writer.writerow(["series/c.mrc", "", "", ""])
    first, second = jobs_of(tmp_path / "list.csv", tmp_path / "out", ["--method", "sirt"])
    assert first.out == tmp_path / "special.mrc"
    assert first.words == ("--method", "sirt", "--thickness", "10", "--invert-tilt")
    assert (second.out, second.words) == (tmp_path / "out" / "c.mrc", ("--method", "sirt"))


def test_sources_without_series_and_series_of_one_name_are_refused(folder, tmp_path):
    series, _ = folder
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", tmp_path / "missing"):
        with pytest.raises(FileNotFoundError, match=r"series|angles"):
            jobs_of(source, tmp_path)
    (series / "a.st").write_bytes((series / "a.mrc").read_bytes())
    with pytest.raises(ValueError, match="two series"):
        jobs_of(series, tmp_path)


def test_a_cluster_reconstructs_whole_series(folder, tmp_path):
    distributed = pytest.importorskip("dask.distributed")
    series, _ = folder
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:
        words = ["batch", series, "-o", tmp_path / "out", "--options", "--method wbp --window hann"]
        with pytest.raises(ValueError, match="1 of 3 series failed"):
            run_command(*words, "--scheduler", cluster.scheduler_address, "--table", tmp_path / "t.json")
    assert [row["status"] for row in read_table(tmp_path / "t.json")] == ["done", "failed", "done"]
